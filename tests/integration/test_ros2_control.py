"""ros2_control's messages against our plants: our controller through an effort controller's topic, and its hardware."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree import ElementTree

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.exports.model_files import urdf
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup

IN_SIM = ("--ros-args", "-r", "__ns:=/sim")
PATIENT = ("-p", "command_timeout:=1.0")
"""What is tested is who is heard, not how fast a shared machine is."""


class Watcher(GraphPeer):
    """Sees the plant, and commands it as hardware of ros2_control does."""

    def __init__(self, domain: int) -> None:
        super().__init__("watcher", domain=domain)
        self.theta = self.applied = math.nan
        self.adapter: dict[str, str] = {}
        self.node.create_subscription(JointState, "/sim/joint_states", self._on_state, 1)
        self.node.create_subscription(JointState, "/sim/applied_effort", self._on_applied, 1)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_state(self, message: JointState) -> None:
        self.theta = message.position[0]

    def _on_applied(self, message: JointState) -> None:
        self.applied = message.effort[0]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("effort adapter"):
                self.adapter = {"message": status.message, **{pair.key: pair.value for pair in status.values}}


@pytest.fixture
def watcher(domain_id: int) -> Iterator[Watcher]:
    """Watch the domain of the test."""
    watcher = Watcher(domain_id)
    yield watcher
    watcher.close()


def test_our_controller_brings_our_plant_upright_through_an_effort_controllers_topic(
    processes: ProcessGroup, watcher: Watcher
) -> None:
    # Without torque it falls away from upright, so that an upright pendulum proves the loop.
    plant = processes.start(
        "pendulum_sim", "simulator", *IN_SIM, *PATIENT, "-p", "initial_theta:=3.3", "-p", "start_effort_limit:=0.0"
    )
    adapter = processes.start("pendulum_lqr", "effort_adapter", *IN_SIM, *PATIENT)
    adapter.wait_for_output("ready", 40.0)
    processes.start(
        "pendulum_lqr",
        "controller",
        *(*IN_SIM, "-r", "~/commands:=/sim/effort_controller/commands", "-p", "command_type:=multi_array"),
        *("-p", "state_timeout:=1.0"),
    )
    plant.wait_for_output("commanded by /sim/effort_controller", 40.0)
    watcher.until(lambda: abs(math.remainder(watcher.theta - math.pi, math.tau)) < 0.02, "an upright pendulum")
    watcher.until(lambda: watcher.adapter.get("message") == "passing commands on", "diagnostics of the adapter")
    assert int(watcher.adapter["answers"]) > 0
    adapter.interrupt()
    assert adapter.wait(10.0) == 0
    watcher.until(lambda: watcher.applied == 0.0, "zero torque after the adapter")


def test_hardware_of_ros2_control_moves_our_plant_and_a_second_commander_nobody(
    processes: ProcessGroup, watcher: Watcher
) -> None:
    processes.start("pendulum_sim", "simulator", *IN_SIM, *PATIENT)
    adapter = processes.start("pendulum_lqr", "effort_adapter", *IN_SIM, *PATIENT, "-p", "command_type:=joint_state")
    adapter.wait_for_output("ready", 40.0)
    publishers = [watcher.node.create_publisher(JointState, "/sim/joint_commands", 1)]
    command = JointState(name=["gripper", names.JOINT], effort=[9.0, 1.25])

    def say() -> None:
        for publisher in publishers:
            publisher.publish(command)

    timer = watcher.node.create_timer(0.02, say)
    watcher.until(lambda: watcher.applied == 1.25, "the torque of our joint")

    publishers.append(watcher.node.create_publisher(JointState, "/sim/joint_commands", 1))
    watcher.until(lambda: "2 publishers on /sim/joint_commands" in watcher.adapter.get("message", ""), "a refusal")
    watcher.until(lambda: watcher.applied == 0.0, "zero torque while there are two")
    watcher.node.destroy_publisher(publishers.pop())
    watcher.until(lambda: watcher.applied == 1.25, "the torque of the one that is left")

    command.effort = [9.0, math.nan]
    watcher.until(lambda: "finite" in watcher.adapter.get("message", ""), "a refusal of NaN")
    watcher.until(lambda: watcher.applied == 0.0, "zero torque without a command")
    watcher.node.destroy_timer(timer)


@pytest.mark.parametrize("hardware", ["gz", "topic_based"])
def test_the_urdf_offers_torque_and_reads_the_state(hardware: str) -> None:
    robot = ElementTree.fromstring(urdf(load_plant("thesis"), ros2_control=hardware, namespace="/hw"))
    joint = robot.find("ros2_control/joint")
    assert joint is not None
    assert joint.get("name") == names.JOINT
    assert [it.get("name") for it in joint.findall("command_interface")] == ["effort"]
    assert [it.get("name") for it in joint.findall("state_interface")] == ["position", "velocity", "effort"]
    parameters = {it.get("name"): it.text for it in robot.findall("ros2_control/hardware/param")}
    mounted = [it.find("parent").get("link") for it in robot.findall("joint") if it.get("type") == "fixed"]  # type: ignore[union-attr]
    if hardware == "topic_based":
        assert parameters["joint_states_topic"] == "/hw/joint_states"
        assert parameters["joint_commands_topic"] == "/hw/joint_commands"
        assert float(parameters["trigger_joint_command_threshold"] or "nan") < 0.0
        assert mounted == []
    else:
        assert mounted == ["world"]
        file = robot.findtext("gazebo/plugin/parameters") or ""
        assert (PROJECT / file.replace("$(find pendulum_lqr)", "pendulum_lqr")).is_file()
    with pytest.raises(ParameterError, match="expected one of none, gz, topic_based"):
        urdf(load_plant("thesis"), ros2_control="ignition")


def test_the_controller_of_the_example_commands_the_joint_of_the_urdf_by_torque() -> None:
    path = PROJECT / "pendulum_lqr" / "config" / "ros2_control_controllers.yaml"
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    managed = content["controller_manager"]["ros__parameters"]
    assert managed["effort_controller"]["type"] == "effort_controllers/JointGroupEffortController"
    assert managed["joint_state_broadcaster"]["type"] == "joint_state_broadcaster/JointStateBroadcaster"
    assert content["effort_controller"]["ros__parameters"]["joints"] == [names.JOINT]
