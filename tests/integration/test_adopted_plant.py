"""A plain node of others behind our rules: adopted, with an intruder at its efforts, driven, e-stopped, and killed.

One robot and its adopter for most of it; in the end the robot dies, and then the adopter is ended.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message, trajectory_to_message
from pendulum_testing.fixtures import PROJECT, own_domain
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from pendulum_testing.trajectories import from_points
from tests.integration.adopting import EFFORTS, adopt, start_robot


class Peer(PlantPeer):
    """Controller and listener in the adopted plant's namespace; hears what the robot is sent, too."""

    def __init__(self) -> None:
        super().__init__("/sim")
        self.sent: list[float] = []
        self.program: RunningProgram | None = None
        self.moves = self.node.create_publisher(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self.node.create_subscription(Float64MultiArray, EFFORTS, lambda message: self.sent.append(message.data[1]), 10)

    def known(self) -> str:
        said = "" if self.program is None else f"; it said:\n{self.program.output[-2000:]}"
        return f"{super().known()}, sent {self.sent[-3:]}{said}"


@pytest.fixture
def peer(domain_id: int) -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


class Pair:
    """A robot with its adopter, and who speaks to it."""

    def __init__(self, processes: ProcessGroup) -> None:
        self.processes = processes
        self.robot = start_robot(processes)
        self.adopter = adopt(processes, "/sim")
        self.peer = Peer()
        self.peer.program = self.adopter


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    folder = tmp_path_factory.mktemp("pair")
    processes = ProcessGroup(folder / "processes", cwd=PROJECT)
    with own_domain(folder):
        pair = Pair(processes)
        peer = pair.peer
        try:
            peer.until(lambda: peer.states and peer.sent and peer.diagnostics.get("mode"), "the adopted plant")
            yield pair
        finally:
            peer.close()
            leftovers = processes.close()
    assert leftovers == []


@pytest.fixture
def adopted(pair: Pair) -> Peer:
    """Bring the plant back to how it started, disarmed."""
    peer = pair.peer
    peer.torque = None
    peer.spin(0.2)  # no plant arms while a large torque is still fresh
    peer.ask("e_stop_reset")
    assert peer.arm(False).success
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "a disarmed plant")
    peer.sent.clear()
    peer.until(lambda: peer.sent, "efforts")
    return peer


def test_somebody_else_at_its_efforts_is_refused_and_faults(adopted: Peer) -> None:
    peer = adopted
    assert peer.arm().success
    intruder = peer.node.create_publisher(Float64MultiArray, EFFORTS, 10)
    peer.until(lambda: peer.diagnostics["mode"] == "fault", "the fault")
    assert peer.diagnostics["reason"].startswith("1 other publishers on /robot/effort_controller/commands")
    assert peer.arm(False).success
    assert "expected none" in peer.arm().message
    peer.node.destroy_publisher(intruder)
    peer.until(lambda: peer.arm().success, "it to be armed again")


def test_it_is_stamped_armed_driven_limited_moved_and_stopped(adopted: Peer) -> None:
    peer = adopted
    first = peer.states[0]
    assert (list(first.name), first.position[0]) == ([names.JOINT], pytest.approx(0.0, abs=1e-6))
    assert stamp_from_message(first.header.stamp) > 1e18
    # The robot measures no torque, and what it was sent is not taken for one.
    assert all(math.isnan(state.effort[0]) for state in peer.states)
    assert "have no effort: measured torque is NaN" in peer.program.output  # type: ignore[union-attr]
    # Commands before arming move nothing.
    peer.torque = 1.0
    peer.until(lambda: int(peer.diagnostics.get("effort_command.accepted", 0)) > 20, "commands")
    assert set(peer.sent) == {0.0}
    peer.torque = None
    peer.spin(0.2)
    assert peer.arm().success

    peer.torque = 0.5
    # Our counter-clockwise is their other way round.
    peer.until(lambda: peer.sent[-1] == -0.5, "torque")
    peer.until(lambda: peer.states[-1].position[0] > 0.01, "a move counter-clockwise")
    peer.torque = 99.0
    peer.until(lambda: peer.sent[-1] == -13.0, "the limit")
    peer.torque = None
    peer.until(lambda: peer.sent[-1] == 0.0, "zero torque without commands")

    start = peer.states[-1].position[0]
    peer.moves.publish(trajectory_to_message(from_points([0.0, 4.0], [start, 2.2], [0.0, 0.0])))
    peer.until(lambda: "holding" in peer.diagnostics["reason"], "the end of the move")
    # Past a right angle, where theirs wraps; slow enough for 13 N m against 11.77 N m s/rad. A robot that a busy
    # machine keeps waiting is behind.
    peer.until(lambda: abs(peer.states[-1].position[0] - 2.2) < 0.05, "the place")
    assert peer.ask("e_stop").success
    peer.until(lambda: peer.sent[-1] == 0.0, "zero torque after the e-stop")
    count = len(peer.sent)
    peer.torque = 1.0
    peer.until(lambda: len(peer.sent) > count + 30, "more efforts")
    assert set(peer.sent[count:]) == {0.0}
    assert all(math.isnan(state.effort[0]) for state in peer.states)
    assert not peer.arm().success


def test_a_robot_that_dies_is_a_fault_a_new_one_gets_no_torque_by_itself_and_the_adopters_end_leaves_none_behind(
    pair: Pair, adopted: Peer
) -> None:
    peer = adopted
    armed = peer.arm()
    assert armed.success, armed.message
    peer.torque = 0.5
    peer.until(lambda: peer.sent[-1] == -0.5, "torque")
    pair.robot.send_signal(signal.SIGKILL)
    peer.until(lambda: peer.diagnostics["mode"] == "fault", "the fault")
    assert "ms old; expected at most 500 ms" in peer.diagnostics["reason"]
    peer.until(lambda: peer.sent[-1] == 0.0, "zero torque")
    states, count = len(peer.states), len(peer.sent)
    start_robot(pair.processes, "robot again")
    peer.until(lambda: len(peer.states) > states + 30, "states of the new one")
    assert set(peer.sent[count:]) == {0.0}

    peer.torque = None
    assert peer.arm(False).success
    peer.until(lambda: peer.arm().success, "it to be armed again")
    peer.torque = 0.5
    peer.until(lambda: peer.sent[-1] == -0.5, "torque again")
    pair.adopter.send_signal(signal.SIGTERM)
    peer.until(lambda: pair.adopter.returncode is not None, "the end")
    assert pair.adopter.returncode == 0
    # It was sent before the end, and may be read here after it.
    peer.until(lambda: peer.sent[-1] == 0.0, "zero torque at last")


def test_states_of_another_joint_or_not_finite_are_refused_and_a_switch_is_asked_for(
    processes: ProcessGroup, peer: Peer
) -> None:
    robot = peer.node.create_publisher(JointState, "/robot/joint_states", 10)
    peer.node.create_subscription(Float64MultiArray, EFFORTS, lambda message: None, 10)
    adopt(processes, "/sim", joint="hip", command_index=0, sign=1, zero=0.0, state_timeout=2.0, enable_timeout=1.0)
    switch = peer.node.create_publisher(Bool, names.ENABLE_INPUT, 10)

    def speak(name: str, position: float, velocity: tuple[float, ...] = (0.0,)) -> None:
        robot.publish(JointState(name=[name], position=[position], velocity=velocity))

    def sound() -> bool:
        speak("hip", 0.1)
        return bool(peer.states)

    peer.until(sound, "a state")
    for name, position, velocity in (("knee", 0.0, (0.0,)), ("hip", 0.0, ())):
        count = len(peer.states)
        speak(name, position, velocity)
        speak("hip", 0.1)
        peer.until(lambda before=count: len(peer.states) > before, "the next sound state")  # type: ignore[misc]
        assert peer.states[-1].position[0] == 0.1
    assert peer.arm().message.startswith("enable switch is not held")

    def held() -> bool:
        switch.publish(Bool(data=True))
        speak("hip", 0.1)
        return bool(peer.arm().success)

    peer.until(held, "a switch that is held")
    switch.publish(Bool(data=True))
    speak("hip", math.nan)
    peer.until(lambda: peer.diagnostics.get("mode") == "fault", "the fault")
    assert peer.diagnostics["reason"] == "its state is not finite: nan rad, 0.0 rad/s"
    assert all(math.isfinite(state.position[0]) for state in peer.states)
