"""An emulated machine of two modules on the graph: whoever of its commanders freezes or dies, no effort outlives it.

All is judged by stamps of the plant's own clock, so that a busy machine makes the test slower and nothing else. The
cart has no window, and a commander may begin with any effort: a pole that falls, since a process had to wait, changes
nothing. A bridge that had to wait for longer than its watchdog faults, rightly, and is started again.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import psutil
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import plant_mode, stamp_from_message
from pendulum_testing.graph_peer import GraphPeer

_LIFETIME_NS = NANOSECONDS // 20
"""Age at which the plant no longer believes a command, and the drive no longer acts on one [ns]."""
_SLACK_NS = NANOSECONDS // 100
_MEASURED_AFTER_NS = NANOSECONDS // 5
"""When no measured effort may be left: two lifetimes, and the lag of drive and record [ns]."""
_NOISE = 0.2
"""Measured effort of a drive that makes none, ten standard deviations [N]."""
_JUDGED = 40
"""Samples that must be seen in each state of affairs, a period of 20 ms each."""


class Machine(GraphPeer):
    """Hears all that is said of the efforts of one plant."""

    patience = 60.0

    def __init__(self, processes: Any) -> None:
        super().__init__("witness", namespace="hw")
        self.bridge: Any = None
        self._processes = processes
        self.states: list[JointState] = []
        self.mode = ""
        self.efforts: dict[str, list[tuple[int, float]]] = {}
        self.named: dict[str, set[tuple[str, ...]]] = {}
        self.node.create_subscription(JointState, names.JOINT_STATES, self.states.append, qos.STATE)
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        for topic in (names.APPLIED_EFFORT, names.EFFORT_COMMAND, names.DISTURBANCE):
            self.efforts[topic], self.named[topic] = [], set()
            self.node.create_subscription(JointState, topic, self._receiver(topic), qos.COMMAND)

    def _receiver(self, topic: str) -> Callable[[JointState], None]:
        def receive(message: JointState) -> None:
            self.named[topic].add(tuple(message.name))
            self.efforts[topic].append((stamp_from_message(message.header.stamp), message.effort[0]))

        return receive

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.mode = plant_mode(message, "/hw") or self.mode

    def known(self) -> str:
        newest = {topic: heard[-1:] for topic, heard in self.efforts.items()}
        return f"; mode {self.mode!r}, {len(self.states)} states, newest efforts {newest}"

    def start(self, package: str, program: str, *parameters: str) -> Any:
        """Start a program of the plant's namespace."""
        given = [item for parameter in parameters for item in ("-p", parameter)]
        return self._processes.start(package, program, "--ros-args", "-r", "__ns:=/hw", *given)

    def start_bridge(self) -> None:
        """Start the plant upright, and arm it as soon as it lets itself be armed."""
        self.bridge = self.start(
            "pendulum_hw_bridge",
            "bridge",
            "plant:=cart_pole",
            "backend:=emulator",
            "feedback_rate:=50.0",
            "initial_positions:=[0.0, 3.141592653589793]",
            "position_window:=[-100.0, 100.0, 0.0, 0.0]",
            "feedback_watchdog:=50",
            "effort_slew_limit:=0.0",
            "start_effort_limit:=0.0",
        )
        request = SetBool.Request(data=True)
        self.until(lambda: self.call(SetBool, "bridge/arm", request).success, "the plant to arm")
        # What the one before said last may have come in the meantime.
        self.mode = ""

    def end_bridge(self) -> None:
        """End the plant as Ctrl-C does."""
        self.bridge.send_signal(signal.SIGINT)
        assert self.bridge.wait(60.0) == 0

    def applied_after(self, begin_ns: int, end_ns: int | None = None) -> list[tuple[int, float]]:
        """Return what was applied from states after one time, and up to another."""
        heard = self.efforts[names.APPLIED_EFFORT]
        return [each for each in heard if begin_ns < each[0] and (end_ns is None or each[0] <= end_ns)]

    def wait_while_armed(self, predicate: Callable[[], bool], what: str) -> None:
        """Wait for something that only an armed plant does; start it again where it has faulted."""

        def seen() -> bool:
            if self.mode == "fault":
                self.end_bridge()
                self.start_bridge()
            return predicate()

        self.until(seen, what)

    def flows(self, begin_ns: int) -> None:
        """Wait until effort flows from states after a time on."""
        self.wait_while_armed(lambda: any(each for _, each in self.applied_after(begin_ns)), "effort to flow")

    def is_the_controllers(self, sample: tuple[int, float]) -> bool:
        """Tell whether an effort is none, or one that the controller asked for lately."""
        stamp_ns, effort = sample
        earliest = stamp_ns - _LIFETIME_NS - _SLACK_NS
        asked = [each for at, each in self.efforts[names.EFFORT_COMMAND] if earliest <= at <= stamp_ns]
        return effort == 0.0 or any(abs(effort - each) < 1e-9 for each in asked)

    def all_is_zero_after(self, end_ns: int) -> None:
        """Wait for samples after the end of all commands, and demand that no effort is in them [ns]."""
        begin_ns = end_ns + _LIFETIME_NS + _SLACK_NS
        self.until(lambda: len(self.applied_after(begin_ns)) >= _JUDGED, "what is applied without commands")
        late = [(at - end_ns, effort) for at, effort in self.applied_after(begin_ns) if effort != 0.0]
        assert not late, f"efforts later than {_LIFETIME_NS} ns after the last command: {late[:5]}"
        measured_from = end_ns + _MEASURED_AFTER_NS

        def measured() -> list[float]:
            return [state.effort[0] for state in self.states if stamp_from_message(state.header.stamp) > measured_from]

        self.until(lambda: len(measured()) >= _JUDGED, "measured efforts")
        assert max(map(abs, measured())) < _NOISE


@pytest.fixture
def machine(domain_id: int, processes: Any) -> Iterator[Machine]:
    machine = Machine(processes)
    yield machine
    machine.close()


def test_no_effort_outlives_its_commander_and_a_passive_joint_never_has_any(machine: Machine) -> None:
    controller = machine.start("pendulum_lqr", "controller", "plant:=cart_pole")
    disturbance = machine.start(
        "pendulum_lqr", "disturbance", "joints:=[cart]", "amplitude:=0.3", "hold_time:=0.01", "autostart:=true"
    )
    machine.start_bridge()
    machine.flows(0)
    commanded, disturbed = machine.efforts[names.EFFORT_COMMAND], machine.efforts[names.DISTURBANCE]
    machine.until(lambda: len(commanded) > _JUDGED < len(disturbed), "controller and disturbance")
    machine.wait_while_armed(
        lambda: any(not machine.is_the_controllers(each) for each in machine.applied_after(0, commanded[-1][0])),
        "a disturbance that is added to the command",
    )

    disturbance.send_signal(signal.SIGKILL)
    assert disturbance.wait(60.0) == -signal.SIGKILL
    killed_ns = time.time_ns()
    begin_ns = killed_ns + _LIFETIME_NS + _SLACK_NS

    def judged() -> list[tuple[int, float]]:
        # Commands come in their order: once a later one is there, all that may have acted are.
        return machine.applied_after(begin_ns, commanded[-1][0])

    machine.wait_while_armed(
        lambda: sum(effort != 0.0 for _, effort in judged()) >= _JUDGED, "the controller's own efforts"
    )
    assert [each for each in judged() if not machine.is_the_controllers(each)] == []

    controller.send_signal(signal.SIGSTOP)
    frozen = psutil.Process(controller.pid)
    try:
        machine.until(lambda: frozen.status() == psutil.STATUS_STOPPED, "the controller to stand still")
        machine.all_is_zero_after(time.time_ns())
    finally:
        controller.send_signal(signal.SIGCONT)
    machine.flows(time.time_ns())

    controller.send_signal(signal.SIGKILL)
    assert controller.wait(60.0) == -signal.SIGKILL
    machine.all_is_zero_after(time.time_ns())

    assert {tuple(state.name) for state in machine.states} == {("cart", "pole")}
    assert {state.effort[1] for state in machine.states} == {0.0}
    assert set.union(*machine.named.values()) == {("cart",)}
    machine.end_bridge()
