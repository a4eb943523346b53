"""The e-stop of the bridge answers whatever else is said to the node, as another process sees it over DDS.

One bridge for all; at the end its actuator dies.
"""

from __future__ import annotations

import contextlib
import signal
import struct
import time
from collections.abc import Iterator

import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration as RclpyDuration
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.ros import qos
from tests.integration.test_bridge_processes import Lab, laboratory

POINTS = 200_000
LATEST = 2.0
"""Far more than the answer takes, even on a busy machine; reading the points in one call takes 6 s [s]."""


@pytest.fixture(scope="module")
def running_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with laboratory(tmp_path_factory.mktemp("lab")) as lab:
        lab.bridge("feedback_watchdog:=50")
        lab.until(lambda: lab.states, "states", 60.0)
        yield lab


@pytest.fixture
def lab(running_lab: Lab) -> Lab:
    """Bring the bridge back to how it started, disarmed."""
    lab = running_lab
    lab.effort = None
    lab.call(Trigger, "bridge/e_stop_reset", Trigger.Request())
    assert lab.call(SetBool, "bridge/arm", SetBool.Request(data=False)).success
    lab.until(lambda: lab.truth.status()["strategy"] == 0, "a drive that is off")
    lab.states.clear()
    lab.until(lambda: lab.states, "states")
    return lab


def of_many_points(count: int) -> bytes:
    """Return the bytes of a trajectory of many equal points, which rclpy takes seconds to make."""
    name = JOINT.encode() + b"\0"
    head = struct.pack("<iIIB3xII", 0, 0, 1, 0, 1, len(name)) + name
    head += b"\0" * (-len(head) % 4) + struct.pack("<I", count)
    assert len(head) % 8 == 4  # so that no number of a point needs to be moved
    return b"\x00\x01\x00\x00" + head + struct.pack("<IdIIIiI", 1, 0.0, 0, 0, 0, 0, 0) * count


def press(lab: Lab) -> float:
    """Press the e-stop; return how long its answer took [s]."""
    client = lab.node.create_client(Trigger, "bridge/e_stop")
    lab.until(client.service_is_ready, "the e-stop")
    begin = time.monotonic()
    future = client.call_async(Trigger.Request())
    lab.until(future.done, "the answer of the e-stop")
    assert future.result().success
    return time.monotonic() - begin


def refused(diagnostics: dict[str, str]) -> int:
    """Return how many trajectories the bridge has found invalid."""
    return int(diagnostics.get("joint_trajectory.refused.invalid", 0))


def armed(lab: Lab) -> None:
    response = lab.call(SetBool, "bridge/arm", SetBool.Request(data=True))
    assert response.success, response.message


def test_a_trajectory_of_200_000_points_keeps_neither_e_stop_nor_states(lab: Lab) -> None:
    armed(lab)
    publisher = lab.node.create_publisher(JointTrajectory, "joint_trajectory", qos.TRAJECTORY)
    lab.until(publisher.get_subscription_count, "the bridge")
    publisher.publish(of_many_points(POINTS))
    waited = press(lab)
    print(f"e-stop answered after {1e3 * waited:.1f} ms")
    assert waited < LATEST
    lab.until(lambda: lab.truth.status()["strategy"] == 0, "a drive that is off")
    response = lab.call(SetBool, "bridge/arm", SetBool.Request(data=True))
    assert "e-stop is latched" in response.message


def test_the_e_stop_answers_while_the_bridge_waits_for_a_module_that_does_not_answer(lab: Lab) -> None:
    arm = lab.node.create_client(SetBool, "bridge/arm")
    lab.until(arm.service_is_ready, "the service")
    lab.emulator.send_signal(signal.SIGSTOP)
    try:
        arming = arm.call_async(SetBool.Request(data=True))
        waited = press(lab)
        assert waited < LATEST
    finally:
        lab.emulator.send_signal(signal.SIGCONT)
    lab.until(arming.done, "the answer to arming")
    assert not arming.result().success
    assert not lab.call(SetBool, "bridge/arm", SetBool.Request(data=True)).success
    lab.until(lambda: lab.truth.status()["strategy"] == 0, "a drive that is off")


def test_a_trajectory_that_comes_while_the_bridge_arms_is_refused_and_moves_nothing(lab: Lab) -> None:
    told: list[dict[str, str]] = []
    lab.node.create_subscription(
        DiagnosticArray,
        names.DIAGNOSTICS,
        lambda message: told.extend({pair.key: pair.value for pair in each.values} for each in message.status),
        qos.DIAGNOSTICS,
    )
    began_ns = lab.truth.status()["link"]["time_ns"]
    publisher = lab.node.create_publisher(JointTrajectory, "joint_trajectory", qos.TRAJECTORY)
    arm = lab.node.create_client(SetBool, "bridge/arm")
    lab.until(lambda: arm.service_is_ready() and publisher.get_subscription_count(), "the bridge", 60.0)
    move = JointTrajectory(joint_names=[names.JOINT])
    move.points = [JointTrajectoryPoint(positions=[-0.15], time_from_start=Duration(sec=1))]
    lab.until(lambda: told, "diagnostics")
    before = refused(told[-1])

    def came_while_it_armed() -> bool:
        lab.call(SetBool, "bridge/arm", SetBool.Request(data=False))
        count = len(lab.states)
        lab.until(lambda: len(lab.states) > count + 2, "states")
        # A module that does not answer: the bridge waits for it, and what comes meanwhile waits for the bridge.
        lab.emulator.send_signal(signal.SIGSTOP)
        try:
            arming = arm.call_async(SetBool.Request(data=True))
            lab.spin(0.02)
            publisher.publish(move)
            assert publisher.wait_for_all_acked(RclpyDuration(seconds=10.0))
            waits = not arming.done()
        finally:
            lab.emulator.send_signal(signal.SIGCONT)
        lab.until(arming.done, "the answer to arming")
        told.clear()
        lab.until(lambda: told, "diagnostics")
        assert told[-1]["mode"] != "armed_position", "the bridge follows a trajectory of before it was armed"
        # Before the request was read it is one for a plant that is not armed, and a busy machine loses the module.
        return waits and bool(arming.result().success) and refused(told[-1]) > before

    lab.until(came_while_it_armed, "a trajectory that comes while the bridge arms", 90.0)
    lab.spin(0.3)
    # A busy machine may keep the bridge waiting for so long that it goes into a fault.
    assert told[-1]["mode"] in {"armed_effort", "fault"}
    times, duties = lab.duties()
    assert not duties[times >= began_ns].any()


def test_the_e_stop_answers_in_a_flood_of_commands_and_trajectories(lab: Lab) -> None:
    armed(lab)
    commands = lab.commands
    trajectories = lab.node.create_publisher(JointTrajectory, "joint_trajectory", qos.TRAJECTORY)
    lab.until(lambda: commands.get_subscription_count() and trajectories.get_subscription_count(), "the bridge")
    move = of_many_points(2000)
    command = serialize_message(JointState(name=[JOINT], effort=[1.0]))
    for _ in range(20):
        for _ in range(200):
            commands.publish(command)
        trajectories.publish(move)
    assert press(lab) < LATEST
    lab.until(lambda: lab.truth.status()["strategy"] == 0, "a drive that is off")


def test_bytes_of_many_points_are_a_trajectory() -> None:
    expected = JointTrajectory(joint_names=[JOINT])
    expected.points = [JointTrajectoryPoint(positions=[0.0]) for _ in range(5)]
    assert deserialize_message(of_many_points(5), JointTrajectory) == expected


@contextlib.contextmanager
def frozen(lab: Lab) -> Iterator[None]:
    """Let the bridge stand still, longer than its watchdog and than the command lifetime."""
    lab.running.send_signal(signal.SIGSTOP)
    try:
        lab.until(lambda: lab.truth.status()["link"]["pwm"] == 0.0, "the end of the command lifetime")
        began = time.monotonic()
        lab.until(lambda: time.monotonic() - began > 1.0, "a pause beyond the watchdog")
        yield
    finally:
        lab.running.send_signal(signal.SIGCONT)


def is_mode(lab: Lab, told: list[str], mode: str) -> bool:
    lab.spin(0.05)
    return bool(told) and told[-1] == mode


def modes(lab: Lab) -> list[str]:
    """Return a list to which the bridge's modes are appended as they are published."""
    told: list[str] = []
    lab.node.create_subscription(
        DiagnosticArray,
        names.DIAGNOSTICS,
        lambda message: told.extend(
            pair.value for each in message.status for pair in each.values if pair.key == "mode"
        ),
        qos.DIAGNOSTICS,
    )
    return told


def stays_off(lab: Lab, since_ns: int) -> None:
    """Expect that the motor has had no duty since an instant, with commands coming all the while."""
    count = len(lab.states)
    lab.until(lambda: len(lab.states) > count + 100, "states with commands")
    times, duties = lab.duties()
    assert not duties[times > since_ns].any()


def test_an_e_stop_that_waits_for_a_frozen_bridge_is_honoured_when_it_goes_on(lab: Lab) -> None:
    told = modes(lab)
    lab.drive()
    client = lab.node.create_client(Trigger, "bridge/e_stop")
    lab.until(client.service_is_ready, "the e-stop")
    with frozen(lab):
        pressed = client.call_async(Trigger.Request())
        lab.spin(0.2)
        assert not pressed.done()
        since_ns = lab.truth.status()["link"]["time_ns"]
    lab.until(pressed.done, "the answer of the e-stop")
    assert pressed.result().success
    lab.until(lambda: is_mode(lab, told, "e_stop"), "the e-stop in diagnostics")
    stays_off(lab, since_ns)
    assert not lab.call(SetBool, "bridge/arm", SetBool.Request(data=True)).success


def test_a_stop_that_cannot_be_delivered_says_so_and_the_bridge_does_not_drive_when_it_goes_on(lab: Lab) -> None:
    told = modes(lab)
    lab.drive()
    with frozen(lab):
        stop = lab.processes.start("pendulum_bags", "move", "stop", "--namespace", "/", alone=True)
        stop.wait(90.0)
        since_ns = lab.truth.status()["link"]["time_ns"]
    assert stop.returncode == 2, stop.output
    assert "e-stop is not confirmed yet; stop the machine by its own means" in stop.output
    assert "was not confirmed, and may not act" in stop.output
    assert "latched" not in stop.output
    told.clear()
    lab.until(lambda: told, "diagnostics")
    # A request that reached its socket while it stood still is honoured; without one, its own stop holds.
    lab.until(lambda: told[-1] in {"fault", "e_stop"}, "a bridge that has noticed its pause")
    stays_off(lab, since_ns)
    assert told[-1] in {"fault", "e_stop"}


def test_an_emulator_that_dies_puts_the_bridge_into_its_fault_state(lab: Lab) -> None:
    lab.drive()
    lab.emulator.send_signal(signal.SIGKILL)
    lab.running.wait_for_output(r"fault: feedback_lost", 15.0)
    lab.emulator.wait(20.0)
