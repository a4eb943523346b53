"""The bridge as a process, on real DDS, with an emulated actuator that outlives it: signals, lifecycle, lockstep."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message
from pendulum_testing.fixtures import PROJECT, own_domain
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from pendulum_testing.udp_address import free_udp_address

RELEASED_AT_ONCE = 0.15
"""Several times what it takes, and less than a plant waits for its last words to be heard [s]."""


class Lab(GraphPeer):
    """An emulator process, bridge processes, and us, who command them.

    Attributes:
        effort: What each state is answered with [N m]; None for nothing.
        running: The bridge that was started last.
        commands: Publisher of all that we command.
    """

    def __init__(self, processes: ProcessGroup) -> None:
        super().__init__("observer")
        self.processes = processes
        self.address = free_udp_address()
        processes.folder.mkdir(parents=True, exist_ok=True)
        self.motor = processes.folder / "motor.csv"
        self.emulator = processes.start(
            "pendulum_hw_bridge", "emulator", "--address", self.address, "--truth", self.motor
        )
        self.emulator.wait_for_output("listens on", 60.0)
        self.truth = EmulatorProcessBackend(self.address)
        self.truth.connect()
        self.effort: float | None = None
        self.states: list[JointState] = []
        self.full: list[JointState] = []
        self.commands = self.node.create_publisher(JointState, "effort_command", qos.COMMAND)
        self.node.create_subscription(JointState, "joint_states", self._on_state, qos.STATE)
        self.node.create_subscription(JointState, "actuator/feedback", self.full.append, qos.STATE)

    def _on_state(self, state: JointState) -> None:
        self.states.append(state)
        if self.effort is not None:
            command = JointState(name=[JOINT], effort=[self.effort])
            command.header.stamp, command.header.frame_id = state.header.stamp, "observer"
            self.commands.publish(command)

    def bridge(self, *parameters: str) -> RunningProgram:
        arguments = ["-p", "backend:=emulator_process", "-p", f"emulator_address:='{self.address}'"]
        for parameter in parameters:
            arguments += ["-p", parameter]
        self.running = self.processes.start("pendulum_hw_bridge", "bridge", "--ros-args", *arguments, alone=True)
        return self.running

    def drive(self) -> None:
        """Arm the bridge that runs, and command a torque until the motor is driven."""
        self.states.clear()
        self.until(lambda: self.states, "states", 60.0)
        self.until(self.armed, "an armed bridge", 30.0)
        self.effort = 0.5
        self.until(self.driven, "torque", 60.0)

    def armed(self) -> bool:
        """Arm; a bridge that a busy machine has put into a fault is asked to forget it."""
        if self.call(SetBool, "bridge/arm", SetBool.Request(data=True)).success:
            return True
        self.call(SetBool, "bridge/arm", SetBool.Request(data=False))
        return False

    def driven(self) -> bool:
        """Tell whether the motor is driven; a bridge that is not armed any more is armed again."""
        if self.truth.status()["link"]["pwm"] != 0.0:
            return True
        self.armed()
        return False

    def lifecycle_state(self) -> int:
        return self.call(GetState, "bridge/get_state", GetState.Request()).current_state.id

    def change(self, transition: int) -> bool:
        return self.call(
            ChangeState, "bridge/change_state", ChangeState.Request(transition=Transition(id=transition))
        ).success

    def duties(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times [ns] and duties of the motor by its own clock, each millisecond."""
        # The last line may still be written.
        rows = [line.split(",") for line in self.motor.read_text(encoding="ascii").split("\n")[1:-1]]
        return np.array([int(row[0]) for row in rows]), np.array([float(row[-1]) for row in rows])

    def close(self) -> None:
        self.truth.close()
        super().close()


@contextlib.contextmanager
def laboratory(folder: Path) -> Iterator[Lab]:
    """Start an emulator that several tests share, in a domain of its own.

    Args:
        folder: For output and logs.
    """
    processes = ProcessGroup(folder / "processes", cwd=PROJECT)
    with own_domain(folder), contextlib.closing(Lab(processes)) as lab:
        try:
            yield lab
        finally:
            leftovers = processes.close()
    assert leftovers == []


@pytest.fixture(scope="module")
def running_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with laboratory(tmp_path_factory.mktemp("lab")) as lab:
        yield lab


@pytest.fixture
def lab(running_lab: Lab) -> Lab:
    """Forget what the bridge of before has said; its motor is off or, where it was killed, without a command."""
    running_lab.effort = None
    running_lab.spin(0.1)
    running_lab.states.clear()
    running_lab.full.clear()
    return running_lab


@pytest.fixture(scope="module")
def bridge_alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningProgram]:
    """Start a bridge without its actuator, before all others: it waits for ten seconds before it gives up."""
    folder = tmp_path_factory.mktemp("alone")
    processes = ProcessGroup(folder, cwd=PROJECT)
    parameters = ("-p", "backend:=emulator_process", "-p", "emulator_address:='127.0.0.1:9'")
    with reserve_domain() as domain:
        environment = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder)}
        yield processes.start("pendulum_hw_bridge", "bridge", "--ros-args", *parameters, env=environment)
        leftovers = processes.close()
    assert leftovers == []


@pytest.mark.usefixtures("bridge_alone")
def test_lifecycle_moves_states_and_torque_and_a_signal_ends_torque_at_once_and_the_process_cleanly(lab: Lab) -> None:
    bridge = lab.bridge("autostart:=false", "command_lifetime:=2.0", "command_timeout:=1.0")
    assert lab.lifecycle_state() == State.PRIMARY_STATE_UNCONFIGURED
    _is_refused_as_inactive(lab)
    assert lab.change(Transition.TRANSITION_CONFIGURE)
    assert lab.lifecycle_state() == State.PRIMARY_STATE_INACTIVE
    _is_refused_as_inactive(lab)
    assert not lab.states
    assert lab.change(Transition.TRANSITION_ACTIVATE)
    lab.until(lambda: len(lab.states) > 20, "states", 30.0)
    lab.until(lambda: lab.armed() and lab.truth.status()["strategy"] == Strategy.DIRECT_PWM, "an armed bridge")
    assert lab.change(Transition.TRANSITION_DEACTIVATE)
    assert lab.truth.status()["strategy"] == Strategy.OFF
    _is_refused_as_inactive(lab)
    assert lab.change(Transition.TRANSITION_CLEANUP)
    assert lab.change(Transition.TRANSITION_CONFIGURE)
    assert lab.change(Transition.TRANSITION_ACTIVATE)
    lab.states.clear()
    lab.full.clear()
    lab.until(lambda: len(lab.full) >= 50 and len(lab.states) >= 50, "states and feedback again", 60.0)
    names = list(lab.full[-1].name)
    for quantity in (
        "pwm_command",
        "motor_current",
        "winding_current",
        "winding_temperature",
        "effort_command",
    ):
        assert quantity in names
    stamps = {stamp_from_message(message.header.stamp) for message in lab.full}
    # One of the middle: of the newest, one of both may not have been read yet.
    assert stamp_from_message(lab.states[25].header.stamp) in stamps

    lab.drive()
    expiries = lab.truth.status()["lifetime_expiries"]
    bridge.send_signal(signal.SIGINT)
    lab.until(lambda: bridge.returncode is not None, "the end of the bridge", 15.0)
    assert bridge.returncode == 0
    _is_off(lab, expiries)


def _is_refused_as_inactive(lab: Lab) -> None:
    refused = lab.call(SetBool, "bridge/arm", SetBool.Request(data=True))
    assert not refused.success
    assert "not active" in refused.message


def _is_off(lab: Lab, expiries: int) -> None:
    """Demand that the drive was switched off, not left to run out."""
    status = lab.truth.status()
    assert status["strategy"] == Strategy.OFF
    assert status["link"]["pwm"] == 0.0
    assert status["lifetime_expiries"] == expiries


def test_who_has_not_heard_the_last_words_does_not_keep_a_signal_from_releasing_the_drive(lab: Lab) -> None:
    listener = lab.processes.start("pendulum_bags", "record", "-o", lab.processes.folder / "bag", "/diagnostics")
    took: list[float] = []
    # A busy machine may take its time to see the signal; who waits for the listener first takes 0.2 s each time.
    while len(took) < 3 and min(took, default=1.0) > RELEASED_AT_ONCE:
        lab.states.clear()
        bridge = lab.bridge("command_lifetime:=2.0", "feedback_watchdog:=50")
        lab.until(lambda: lab.states, "states", 60.0)
        lab.until(lambda: lab.armed() and lab.truth.status()["strategy"] == Strategy.DIRECT_PWM, "an armed bridge")
        lab.until(lambda: lab.node.count_subscribers("/diagnostics"), "the listener", 60.0)
        lab.spin(1.0)
        expiries = lab.truth.status()["lifetime_expiries"]
        listener.send_signal(signal.SIGSTOP)
        begin = time.monotonic()
        bridge.send_signal(signal.SIGTERM)
        lab.until(lambda: lab.truth.status()["strategy"] == Strategy.OFF, "a drive that is off")
        took.append(time.monotonic() - begin)
        listener.send_signal(signal.SIGCONT)
        assert bridge.wait(15.0) == 0
        _is_off(lab, expiries)
    print(f"the drive was off {took} s after the signal")
    assert min(took) <= RELEASED_AT_ONCE


def test_after_sigkill_the_command_lifetime_ends_torque(lab: Lab) -> None:
    # A commander that a busy machine keeps waiting, this process, is not to end torque before.
    bridge = lab.bridge("command_timeout:=1.0", "feedback_watchdog:=50")
    lab.drive()
    before = lab.truth.status()
    assert before["strategy"] == Strategy.DIRECT_PWM
    assert before["command_lifetime"] == 0.05
    bridge.send_signal(signal.SIGKILL)
    bridge.wait(20.0)
    killed_ns = lab.truth.status()["link"]["time_ns"]
    lab.until(lambda: lab.truth.status()["link"]["time_ns"] > killed_ns + 300_000_000, "0.3 s of the motor's time")
    after = lab.truth.status()
    assert after["lifetime_expiries"] > before["lifetime_expiries"]
    assert after["strategy"] == Strategy.DIRECT_PWM
    times, duties = lab.duties()
    end_ns = times[1:][np.diff(duties) != 0.0][-1]
    assert 49e6 <= end_ns - after["last_command_ns"] <= 52e6  # the truth has a row for each millisecond
    assert not duties[times >= end_ns].any()


def test_a_missing_actuator_is_one_sentence_and_exit_code_2(bridge_alone: RunningProgram) -> None:
    assert bridge_alone.wait(60.0) == 2
    assert "does not answer; start it with: python -m pendulum_hw_bridge emulator" in bridge_alone.output
    assert "Traceback" not in bridge_alone.output
