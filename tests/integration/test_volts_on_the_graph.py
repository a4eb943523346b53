"""A rotary pendulum in volts on the graph: simulator, LQR, disturbance and recorder, and commands in another unit."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_msgs_py.ros import qos
from pendulum_rosbag.reader import read_bag
from tests.joints_peer import JointsPeer

QUBE = load_mechanism("qube_servo")


@pytest.fixture
def peer(domain_id: int) -> Iterator[JointsPeer]:
    with closing(JointsPeer(qos.STATE)) as peer:
        yield peer


def _start(processes, package: str, program: str, *parameters: str):
    arguments = [item for parameter in parameters for item in ("-p", parameter)]
    return processes.start(package, program, "--ros-args", "-r", "__ns:=/sim", *arguments)


def test_volts_hold_the_pendulum_upright_and_the_bag_has_them_beside_the_torque(
    peer: JointsPeer, processes, tmp_path: Path
) -> None:
    recorder = processes.start("pendulum_rosbag", "record", "-o", str(tmp_path / "bag"), "--regex", "^/sim/")
    recorder.wait_for_output("ready", 60)
    controller = _start(processes, "pendulum_lqr", "controller", "plant:=qube_servo", "use_sim_time:=true")
    signal_of = ("joints:=[arm]", "volts:=true", "amplitude:=1.0", "autostart:=true", "use_sim_time:=true")
    noise = _start(processes, "pendulum_lqr", "disturbance", *signal_of)
    plant = _start(
        processes, "pendulum_sim", "simulator", "plant:=qube_servo", "clock:=lockstep", "start:=top",
        "lockstep_inputs:=[effort_command, disturbance]", "lockstep_duration:=2.0", "lockstep_subscribers:=4",
    )  # fmt: skip
    peer.until(lambda: any(event["name"] == names.Event.LOCKSTEP_FINISHED for event in peer.events), "the end", 90.0)
    controller.wait_for_output(r"lqr for plant qube_servo: K = \[-19\.53.*limit 10 V", 10)
    for program in (noise, controller, plant, recorder):
        program.send_signal(signal.SIGINT)
        assert program.wait(20.0) == 0
    with read_bag(tmp_path / "bag") as bag:
        assert not {"/sim/effort_command", "/sim/disturbance"} & set(bag.topics)
        states, torque = bag.joints("/sim/joint_states"), bag.joints("/sim/applied_effort")
        command, push, applied = (bag.joints(f"/sim/{name}") for name in names.VOLTAGE_TOPICS)
    assert np.abs(states.position - [0.0, math.pi]).max() < 0.2
    assert np.abs(push.effort).max() == pytest.approx(1.0, rel=0.2)
    of_command, of_push, of_torque = (
        dict(zip(table.stamp_ns, table.effort[:, 0], strict=True)) for table in (command, push, torque)
    )
    velocities = dict(zip(states.stamp_ns, states.velocity, strict=True))
    checked = 0
    for stamp, volts in zip(applied.stamp_ns[:800], applied.effort[:800, 0], strict=True):
        if stamp in of_command and stamp in of_push and stamp in of_torque and stamp in velocities:
            assert volts == pytest.approx(np.clip(of_command[stamp] + of_push[stamp], -10.0, 10.0))
            # In newton metres, and less by the back EMF.
            expected = 0.005 * volts - 0.042**2 / 8.4 * velocities[stamp][0]
            assert of_torque[stamp] == pytest.approx(expected, abs=1e-12)
            checked += 1
    assert checked > 500
    # What is measured is the torque of the motor: 50 mN m at most at standstill.
    assert 0.0 < np.abs(states.effort[:, 0]).max() < 0.06
    assert not states.effort[:, 1].any()


@pytest.mark.parametrize(
    ("plant", "topic", "own"),
    [("qube_servo", "effort_command", "voltage_command in V"), ("furuta", "voltage_command", "effort_command in N m")],
)
def test_a_command_in_another_unit_moves_nothing_and_is_reported(
    peer: JointsPeer, processes, plant: str, topic: str, own: str
) -> None:
    wrong = peer.node.create_publisher(JointState, topic, qos.COMMAND)
    parameters = ("rate_hz:=100.0", "start_effort_limit:=0.0", "command_timeout:=1.0")
    program = _start(processes, "pendulum_sim", "simulator", f"plant:={plant}", *parameters)
    peer.until(lambda: len(peer.states) > 3, "states")

    def reported() -> bool:
        message = JointState(name=["arm"], effort=[0.05])
        message.header.stamp = peer.states[-1].header.stamp
        wrong.publish(message)
        peer.call(Trigger, "simulator/e_stop_reset", Trigger.Request())
        return topic in peer.diagnostics.get("commands_without_effect", "")

    peer.until(reported, f"{topic} reported")
    assert peer.diagnostics["commands_without_effect"].endswith(f"this plant is driven by {own}")
    assert not any(peer.diagnostics.get(f"{name}.accepted", "0") != "0" for name in (topic, own.split()[0]))
    assert {value for state in peer.states for value in (*state.position, *state.velocity, *state.effort)} == {0.0}
    program.wait_for_output(rf"{topic} without effect", 10)
    # The same value on the plant's own topic moves it.
    right = peer.node.create_publisher(JointState, own.split()[0], qos.COMMAND)

    def moved() -> bool:
        message = JointState(name=["arm"], effort=[0.05])
        message.header.stamp = peer.states[-1].header.stamp
        right.publish(message)
        return peer.states[-1].velocity[0] > 0.0

    peer.until(moved, "a motion")


def test_a_controller_in_volts_sends_nothing_to_an_effort_controller(domain_id: int, processes) -> None:
    refused = _start(processes, "pendulum_lqr", "controller", "plant:=qube_servo", "command_type:=multi_array")
    assert refused.wait(60.0) == 2
    assert "command_type is 'multi_array', of efforts, and plant 'qube_servo' is driven in volts" in refused.output
