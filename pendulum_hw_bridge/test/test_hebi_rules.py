"""What the HEBI backend sends, waits for and refuses, rule by rule, on hebi-py's own commands and a clock of ours."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_hw_bridge.backends import hebi as backend_module
from pendulum_hw_bridge.backends.hebi import HebiBackend, connect_group
from pendulum_hw_bridge.backends.hebi_discovery import ModuleSelection
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES
from pendulum_hw_bridge.backends.hebi_settings import fill_limits
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, HardwareLimits, MStopAction, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GAIN_FIELDS, LOOPS
from pendulum_msgs_py.errors import ParameterError

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")

MILLISECOND = 1_000_000
WINDOW = HardwareLimits(effort=4.0, velocity=1.0, position_min=-3.0, position_max=2.0)


class Group:
    """A group of one module that keeps what is sent, and answers what a test wants."""

    size = 1

    def __init__(self, **info: Any) -> None:
        self.command_lifetime = 250
        self.feedback_frequency = 100.0
        self.sent: list[Any] = []
        self.works = self.acknowledges = self.flows = True
        self.waits: list[float] = []
        self.buffers: list[Any] = []
        self.receive_us = 0
        self.mstop_state = 1
        self.logs: list[str] = []
        self.asked = 0
        self.info = {"control_strategy": 0, "mstop_strategy": 1, **info}

    def send_command(self, command: Any) -> bool:
        sent = hebi.GroupCommand(1)
        sent.copy_from(command)
        self.sent.append(sent)
        return self.works

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: int) -> bool:
        self.send_command(command)
        self.info["control_strategy"] = int(command.control_strategy[0])
        return self.acknowledges

    def request_info(self, timeout_ms: int) -> Any:
        self.asked += 1
        names = ["family", "name", "serial", "firmware_revision", "control_strategy"]
        names += [f"{loop}_{name}" for loop in LOOPS for name in GAIN_FIELDS]
        return SimpleNamespace(**{name: ["?"] for name in names} | {name: [value] for name, value in self.info.items()})

    def get_next_feedback(self, timeout_ms: float, reuse: Any) -> Any:
        self.waits.append(timeout_ms)
        self.buffers.append(reuse)
        if not self.flows:
            return None
        values = dict.fromkeys(ATTRIBUTES.values(), 0.5) | {
            "receive_time_us": self.receive_us,
            "hardware_transmit_time_us": 7,
            "mstop_state": self.mstop_state,
            "temperature_state": 0,
            "command_lifetime_state": 0,
            "position_limit_state": 2,
            "velocity_limit_state": 2,
            "effort_limit_state": 2,
        }
        return SimpleNamespace(**{name: np.array([value]) for name, value in values.items()})

    def start_log(self, folder: str, name: str) -> None:
        self.logs.append(name)

    def stop_log(self) -> None:
        self.logs.append("stopped")


def port_on(group: Group, **options: Any) -> tuple[HebiBackend, SteppedClock]:
    clock = SteppedClock()
    port = HebiBackend(make_group=lambda: group, clock=clock, **options)
    assert port.strategy is Strategy.OFF
    port.connect()
    return port, clock


LIMITS_READ = {
    "effort_limit_min": -4.0,
    "effort_limit_max": 4.0,
    "velocity_limit_min": -1.0,
    "velocity_limit_max": 1.0,
    "position_limit_min": -3.0,
    "position_limit_max": 2.0,
    "min_position_limit_strategy": 2,
    "max_position_limit_strategy": 2,
}
CALLS: dict[str, Callable[[HebiBackend], object]] = {
    "read": lambda port: port.read(0.01),
    "write": lambda port: port.write(Command()),
    "set_strategy": lambda port: port.set_strategy(Strategy.OFF),
    "set_gains": lambda port: port.set_gains(DEFAULT_GAINS[3]),
    "set_limits": lambda port: port.set_limits(WINDOW),
    "set_command_lifetime": lambda port: port.set_command_lifetime(0.05),
    "set_feedback_rate": lambda port: port.set_feedback_rate(50.0),
}


def from_another_thread(call: Callable[[], object]) -> BaseException | None:
    """Return what a call raises when another thread makes it."""
    caught: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except ActuatorError as error:
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return caught[0] if caught else None


# --- who may call ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(CALLS))
def test_each_call_is_refused_before_connecting_and_from_a_second_thread(name: str) -> None:
    group = Group()
    with pytest.raises(ActuatorError, match="not connected"):
        CALLS[name](HebiBackend(make_group=lambda: group))
    port, _ = port_on(group, imitation=True)
    assert "second thread" in str(from_another_thread(lambda: CALLS[name](port)))
    assert group.sent == group.waits == []
    assert (group.command_lifetime, group.feedback_frequency) == (250, 100.0)


def test_connecting_again_or_stopping_from_a_second_thread_does_nothing_to_the_module() -> None:
    group = Group()
    port, _ = port_on(group)
    assert "second thread" in str(from_another_thread(port.connect))
    assert from_another_thread(port.stop) is None
    assert group.sent == []
    port.stop()
    assert len(group.sent) == 1


def test_a_stop_without_a_module_asks_nobody() -> None:
    HebiBackend(make_group=Group).stop()


def test_a_group_that_was_refused_is_not_taken_for_connected_afterwards() -> None:
    group = Group()
    group.size = 2
    port = HebiBackend(make_group=lambda: group)
    for _ in range(2):
        with pytest.raises(ActuatorError, match="HEBI group has 2 modules; expected 1"):
            port.connect()
    with pytest.raises(ActuatorError, match="not connected"):
        port.write(Command())


def test_a_log_that_cannot_begin_is_no_connection(tmp_path: Path) -> None:
    path = tmp_path / "run.hebilog"
    path.touch()
    port = HebiBackend(make_group=Group, log=path)
    for _ in range(2):
        with pytest.raises(ActuatorError, match="is there already"):
            port.connect()


def test_a_log_lasts_from_connecting_to_closing(tmp_path: Path) -> None:
    group = Group()
    port, _ = port_on(group, log=tmp_path / "run.hebilog")
    assert group.logs == ["run.hebilog"]
    port.close()
    assert group.logs == ["run.hebilog", "stopped"]
    port.close()
    HebiBackend(make_group=Group, log=tmp_path / "other.hebilog").close()
    group = Group()
    port_on(group)[0].close()
    assert group.logs == []


def test_it_tells_time_and_lifetime_in_its_own_units() -> None:
    port, clock = port_on(Group())
    clock.wait_until(5)
    assert port.now_ns() == 5
    assert port.connect().command_lifetime == 0.25


def test_the_parameters_name_the_log_or_none() -> None:
    values = dict.fromkeys(("family", "name", "mac_address", "serial", "module_type", "interface"), "")
    for log, path in (("", None), ("a.hebilog", Path("a.hebilog"))):
        port = HebiBackend.from_parameters({**values, "plant": "thesis", "hebi_log": log}, SteppedClock())
        assert port._log == path


# --- feedback --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_us", [0, 1])
def test_the_first_record_has_number_one_and_the_same_record_again_is_none(first_us: int) -> None:
    group = Group()
    group.receive_us = first_us
    port, clock = port_on(group)
    record = port.read(0.02)
    assert record is not None
    assert record.sequence == 1
    assert not record.m_stop
    assert clock.now_ns() == 0
    # It waits no less for what comes again, so that nobody spins.
    assert port.read(0.02) is None
    assert clock.now_ns() == 20 * MILLISECOND
    group.receive_us += 1
    again = port.read(0.02)
    assert again is not None
    assert again.sequence == 2
    assert all(type(reuse) is hebi.GroupFeedback for reuse in group.buffers)


def test_it_waits_for_a_record_as_long_as_it_was_asked_to_and_a_millisecond_at_least() -> None:
    group = Group()
    group.flows = False
    port, clock = port_on(group)
    assert port.read(0.02) is None
    assert clock.now_ns() == 20 * MILLISECOND
    assert port.read(0.0) is None
    assert clock.now_ns() == 20 * MILLISECOND
    assert group.waits == [20.0, 1.0]


def test_the_imitation_has_a_pace_of_its_own_and_no_settings_or_motion_stop() -> None:
    group = Group()
    group.mstop_state = 0
    port, clock = port_on(group, imitation=True)
    assert group.asked == 0
    record = port.read(0.1)
    assert record is not None
    assert not record.m_stop
    assert clock.now_ns() == 0
    assert port.read(0.1) is not None
    assert clock.now_ns() == 10 * MILLISECOND
    assert port.read(0.005) is None
    assert clock.now_ns() == 15 * MILLISECOND
    assert len(group.waits) == 2
    assert port.read(0.005) is not None
    assert clock.now_ns() == 20 * MILLISECOND
    assert port.set_limits(WINDOW) == WINDOW
    assert group.asked == 0


# --- commands --------------------------------------------------------------------------------------------------


def given(command: Any) -> set[str]:
    """Return which setpoints and settings a command carries."""
    names = ["position", "velocity", "effort", *(f"{loop}_{name}" for loop in LOOPS for name in ("kp", "max_output"))]
    names += [f"{what}_limit_{end}" for what in ("effort", "velocity", "position") for end in ("min", "max")]
    return {name for name in names if _holds(command, name) and not math.isnan(float(getattr(command, name)[0]))}


def _holds(command: Any, name: str) -> bool:
    """Whether a command carries a field: hebi-py reads an angle that is not given as one that was given before."""
    probe = hebi.GroupCommand(1)
    setattr(probe, name, 1.0)
    asked, held = (each.refs[0].message_bitfield_ for each in (probe, command))
    return all(held[word] & asked[word] == asked[word] for word in range(3))


def test_each_packet_carries_what_it_is_for_and_nothing_of_those_before() -> None:
    group = Group(**LIMITS_READ)
    port, _ = port_on(group, imitation=True)
    port.set_limits(WINDOW)
    limits = {f"{what}_limit_{end}" for what in ("effort", "velocity", "position") for end in ("min", "max")}
    port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.25))
    port.set_gains(DEFAULT_GAINS[3])
    port.write(Command(pwm=0.5))
    port.set_limits(WINDOW)
    port.stop()
    port.set_gains(DEFAULT_GAINS[3])
    port.stop()
    gains = {f"{loop}_{name}" for loop in LOOPS for name in ("kp", "max_output")}
    expected = [limits, {"effort"}, gains, {"effort"}, limits, {"effort"}, set(), gains, set()]
    assert [given(sent) for sent in group.sent] == expected


def test_what_was_written_is_returned_with_its_time_and_strategy() -> None:
    port, clock = port_on(group := Group(), imitation=True)
    assert port.set_strategy(Strategy.PARALLEL_PWM) is Strategy.PARALLEL_PWM
    clock.wait_until(5)
    applied = port.write(Command(velocity=0.5))
    assert (applied.command.velocity, applied.strategy, applied.limited, applied.sent_ns) == (
        0.5,
        Strategy.PARALLEL_PWM,
        False,
        5,
    )
    assert given(group.sent[-1]) == {"velocity"}
    assert group.sent[-1].velocity[0] == 0.5


def setpoints(command: Any) -> Command:
    """Return the setpoints that a packet carries, the effort field as the effort."""
    held = {name: _holds(command, name) for name in ("position", "velocity", "effort")}
    assert all(held.values()), "a field that is left out may keep its last setpoint"
    return Command(**{name: float(getattr(command, name)[0]) for name in held})


@pytest.mark.parametrize(
    ("strategy", "setpoint"),
    [
        (Strategy.DIRECT_PWM, Command(pwm=0.25)),
        (Strategy.TORQUE_CASCADE, Command(position=1.0)),
        (Strategy.PARALLEL_PWM, Command(position=1.0)),
        (Strategy.PARALLEL_PWM, Command(effort=1.0)),
        (Strategy.MIXED, Command(position=1.0)),
    ],
)
def test_a_stop_begins_with_no_torque_where_an_effort_of_zero_would_wake_the_torque_loop(
    strategy: Strategy, setpoint: Command
) -> None:
    port, _ = port_on(group := Group(), imitation=True)
    port.set_strategy(strategy, setpoint)
    port.stop()
    effort = setpoints(group.sent[-2]).effort
    assert effort == 0.0 if strategy is Strategy.DIRECT_PWM else math.isnan(effort)
    assert given(group.sent[-2]) == ({"effort"} if strategy is Strategy.DIRECT_PWM else set())
    assert given(group.sent[-1]) == set()
    # Off already, there is nothing that a zero could end.
    count = len(group.sent)
    port.stop()
    assert len(group.sent) == count + 1


@pytest.mark.parametrize("first", [Strategy.DIRECT_PWM, Strategy.PARALLEL_PWM])
def test_a_stop_wakes_no_loop_where_the_acknowledgement_of_the_strategy_was_lost(first: Strategy) -> None:
    other = Strategy.PARALLEL_PWM if first is Strategy.DIRECT_PWM else Strategy.DIRECT_PWM
    port, _ = port_on(group := Group(), imitation=True)
    port.set_strategy(first)
    group.acknowledges = False
    with pytest.raises(ActuatorError, match="did not acknowledge its strategy"):
        port.set_strategy(other)
    group.acknowledges = True
    port.stop()
    assert math.isnan(setpoints(group.sent[-2]).effort)
    # Off is confirmed, and so are the next strategies: a duty of zero is certain to be one.
    port.set_strategy(Strategy.PARALLEL_PWM)
    port.set_strategy(Strategy.DIRECT_PWM)
    port.stop()
    assert setpoints(group.sent[-2]).effort == 0.0


@pytest.mark.parametrize(("number", "effort"), [(1, 0.0), (3, math.nan)])
def test_a_module_that_drives_when_it_is_found_is_stopped_in_its_own_strategy(number: int, effort: float) -> None:
    port, _ = port_on(group := Group(control_strategy=number))
    port.stop()
    assert setpoints(group.sent[0]).effort == pytest.approx(effort, nan_ok=True)
    assert len(group.sent) == 2


def test_after_a_stop_that_nobody_confirmed_no_duty_can_be_written() -> None:
    port, _ = port_on(group := Group(), imitation=True)
    port.set_strategy(Strategy.DIRECT_PWM)
    group.acknowledges = False
    with pytest.raises(ActuatorError, match="did not confirm"):
        port.stop()
    with pytest.raises(ParameterError, match="pwm setpoint under strategy OFF"):
        port.write(Command(pwm=0.1))


# --- settings --------------------------------------------------------------------------------------------------


def test_the_shortest_command_lifetime_is_a_millisecond_and_never_for_ever() -> None:
    port, _ = port_on(group := Group())
    assert port.set_command_lifetime(1e-4) == 1e-3
    assert group.command_lifetime == 1
    assert port.set_command_lifetime(0.05) == 0.05


def test_a_feedback_rate_is_above_0_and_up_to_1000_hz() -> None:
    port, _ = port_on(group := Group())
    for rate in (0.5, 1000.0):
        assert port.set_feedback_rate(rate) == rate
        assert group.feedback_frequency == rate
    for rate in (0.0, -1.0, 1000.1, math.nan, math.inf):
        with pytest.raises(ParameterError, match="feedback_rate is"):
            port.set_feedback_rate(rate)
    assert group.feedback_frequency == 1000.0


@pytest.mark.parametrize(
    ("action", "number"), [(MStopAction.DISABLED, 0), (MStopAction.MOTOR_OFF, 1), (MStopAction.HOLD_POSITION, 2)]
)
def test_what_the_motion_stop_shall_do_is_written_as_hebi_numbers_it(action: MStopAction, number: int) -> None:
    command = hebi.GroupCommand(1)
    fill_limits(command, replace(WINDOW, m_stop=action))
    assert int(command.mstop_strategy[0]) == number


@pytest.mark.parametrize("low", [-3.0, -math.inf])
@pytest.mark.parametrize("high", [2.0, math.inf])
def test_each_end_of_a_position_window_is_written_and_read_back_and_disabled_where_it_is_open(
    low: float, high: float
) -> None:
    ends = {"min": low, "max": high}
    # As hebi-py numbers them: 2 switches the motor off, 3 does nothing; 0 holds the position, with a torque of its own.
    numbers = {end: 2 if math.isfinite(angle) else 3 for end, angle in ends.items()}
    strategies = {f"{end}_position_limit_strategy": number for end, number in numbers.items()}
    group = Group(**{**LIMITS_READ, "position_limit_min": -2.5, "position_limit_max": 1.5, **strategies})
    port, _ = port_on(group)
    read = port.set_limits(replace(WINDOW, position_min=low, position_max=high))
    closed = {end for end, number in numbers.items() if number == 2}
    assert (read.position_min, read.position_max) == (
        -2.5 if "min" in closed else low,
        1.5 if "max" in closed else high,
    )
    assert given(group.sent[-1]) == {
        f"{what}_limit_{end}" for what in ("effort", "velocity") for end in ("min", "max")
    } | {f"position_limit_{end}" for end in closed}
    for end, number in numbers.items():
        assert int(getattr(group.sent[-1], f"{end}_position_limit_strategy")[0]) == number
        for other in {0, 1, 2, 3} - {number}:
            group.info.update({**strategies, f"{end}_position_limit_strategy": other})
            with pytest.raises(
                ActuatorError, match=f"strategy at the {end} position limit reads back as {other}; expected {number}"
            ):
                port.set_limits(replace(WINDOW, position_min=low, position_max=high))


@pytest.mark.parametrize("name", ["effort_limit_min", "effort_limit_max", "velocity_limit_min", "velocity_limit_max"])
def test_a_limit_that_reads_back_as_zero_is_refused(name: str) -> None:
    port, _ = port_on(Group(**{**LIMITS_READ, name: 0.0}))
    with pytest.raises(ActuatorError, match="expected them around zero"):
        port.set_limits(WINDOW)


# --- looking for the module ------------------------------------------------------------------------------------


def test_the_module_is_looked_for_patiently_and_connected_by_its_address(monkeypatch: pytest.MonkeyPatch) -> None:
    patiences: list[float] = []
    asked: list[tuple[list[str], int]] = []
    group: Any = object()

    class Lookup:
        def get_group_from_macs(self, addresses: list[str], timeout_ms: int) -> Any:
            asked.append((addresses, timeout_ms))
            return group

    def discover(_: Any, *, look_time: float, patience: float) -> list[Any]:
        patiences.append(patience)
        return []

    module = SimpleNamespace(mac_address="08:00:27:00:00:01")
    monkeypatch.setattr(backend_module, "open_lookup", lambda interface: Lookup())
    monkeypatch.setattr(backend_module, "discover", discover)
    monkeypatch.setattr(backend_module, "select_module", lambda *_, **__: module)
    for look_time in (1.0, 2.0, 9.0):
        assert connect_group(ModuleSelection(), look_time=look_time) is group
    assert patiences == [3.0, 5.0, 9.0]
    assert asked[0] == (["08:00:27:00:00:01"], 5000)
    group = None
    with pytest.raises(ActuatorError, match="was seen but does not connect"):
        connect_group(ModuleSelection())
