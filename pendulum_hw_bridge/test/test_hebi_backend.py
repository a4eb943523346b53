"""The HEBI backend on a group that answers as a module does: what is sent, copied, read back and refused.

No module is at hand where tests run, and hebi-py's imitation has no settings to read back; hebi-py's own command and
feedback objects are used, only the way to the module is ours.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_hw_bridge.backends.hebi import HebiBackend
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES
from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    Command,
    CommandLock,
    HardwareLimits,
    LimitState,
    MStopAction,
    Strategy,
    TemperatureState,
)
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GAIN_FIELDS, LOOPS
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, PlantLimits, PlantSupervisor

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")


def holds_strategy(command: Any) -> bool:
    """Tell whether a command carries a strategy: hebi-py reads "off" and "none given" both as 0."""
    probe = hebi.GroupCommand(1)
    probe.control_strategy = 0
    words = range(3)
    asked, given = (each.refs[0].message_bitfield_ for each in (probe, command))
    return all(given[word] & asked[word] == asked[word] for word in words)


class Module:
    """What a module remembers of the commands that reach it, and the group through which they come."""

    size = 1

    def __init__(self) -> None:
        self.command_lifetime = 250
        self.feedback_frequency = 100.0
        self.settings: dict[str, Any] = {"control_strategy": 3}
        self.sent: list[tuple[float, float, float]] = []
        self.hears = self.acknowledges = self.answers = self.flows = self.keeps = True
        self.asked = self.patience_ms = 0
        self.time_us = 1_000_000
        self.values: dict[str, float] = {}
        self.states = {
            "mstop_state": 1,
            "temperature_state": 0,
            "command_lifetime_state": 2,
            "position_limit_state": 2,
            "velocity_limit_state": 2,
            "effort_limit_state": 2,
        }

    def send_command(self, command: Any) -> bool:
        self.sent.append((float(command.position[0]), float(command.velocity[0]), float(command.effort[0])))
        return self.hears

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: int) -> bool:
        self.asked, self.patience_ms = self.asked + 1, timeout_ms
        if not (self.hears and self.acknowledges):
            return False
        self.send_command(command)
        if not self.keeps:
            return True
        names = [f"{loop}_{name}" for loop in LOOPS for name in GAIN_FIELDS]
        names += [f"{what}_limit_{end}" for what in ("effort", "velocity", "position") for end in ("min", "max")]
        for name in names:
            value = float(getattr(command, name)[0])
            if not math.isnan(value):
                self.settings[name] = value
        if holds_strategy(command):
            self.settings["control_strategy"] = int(command.control_strategy[0])
        for name in ("mstop_strategy", "min_position_limit_strategy", "max_position_limit_strategy"):
            if getattr(command, name)[0]:
                self.settings[name] = int(getattr(command, name)[0])
        return True

    def request_info(self, timeout_ms: int) -> Any:
        if not self.answers:
            return None
        known = {
            "family": "Lab",
            "name": "Pendulum",
            "serial": "X-1",
            "firmware_revision": "15",
            "mstop_strategy": 1,
            "min_position_limit_strategy": 0,
            "max_position_limit_strategy": 0,
        }
        module = self

        class Info:
            def __getattr__(self, name: str) -> list[Any]:
                return [module.settings.get(name, known.get(name, math.nan))]

        return Info()

    def get_next_feedback(self, timeout_ms: float, reuse: Any) -> Any:
        if not self.flows:
            return None
        self.time_us += 10_000
        quantities = {theirs: np.array([self.values.get(theirs, 0.5)]) for theirs in ATTRIBUTES.values()}
        times = {"receive_time_us": self.time_us, "hardware_transmit_time_us": self.time_us + 7}
        return SimpleNamespace(
            **quantities, **{name: np.array([value]) for name, value in {**times, **self.states}.items()}
        )


@pytest.fixture
def module() -> Module:
    return Module()


@pytest.fixture
def port(module: Module) -> HebiBackend:
    backend = HebiBackend(make_group=lambda: module)
    backend.connect()
    return backend


def test_it_says_who_it_is(port: HebiBackend) -> None:
    info = port.connect()
    assert (info.family, info.name, info.serial, info.firmware) == ("Lab", "Pendulum", "X-1", "15")
    assert info.strategy is Strategy.PARALLEL_PWM


def test_the_effort_field_carries_the_duty_under_direct_pwm(port: HebiBackend, module: Module) -> None:
    port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.25))
    assert module.sent[-1][2] == 0.25
    port.write(Command(pwm=-0.5))
    assert module.sent[-1][2] == -0.5
    assert math.isnan(module.sent[-1][0])


def test_settings_are_sent_and_read_back(port: HebiBackend, module: Module) -> None:
    assert port.set_command_lifetime(0.05) == 0.05
    assert module.command_lifetime == 50
    # The module keeps single precision.
    assert port.set_gains(DEFAULT_GAINS[3]).velocity.kp == pytest.approx(0.05, rel=1e-6)
    assert module.settings["position_kp"] == 1.5
    limits = HardwareLimits(
        effort=4.0, velocity=1.0, position_min=-3.0, position_max=3.0, m_stop=MStopAction.HOLD_POSITION
    )
    assert port.set_limits(limits) == limits
    module.settings["effort_limit_max"] = 9.0
    module.send_command_with_acknowledgement = lambda command, timeout: True  # type: ignore[method-assign]
    assert port.set_limits(limits).effort == 9.0


def test_feedback_is_copied_not_viewed(port: HebiBackend, module: Module) -> None:
    module.values = {"position": 1.25, "motor_winding_current": 0.3}
    first = port.read(0.1)
    module.values = {"position": 9.0}
    second = port.read(0.1)
    assert first is not None
    assert second is not None
    assert (first.position, first.winding_current, second.position) == (1.25, 0.3, 9.0)
    assert type(first.position) is float
    assert second.sequence == first.sequence + 1
    assert second.hardware_ns - first.hardware_ns == 10_000_000


def test_states_of_the_firmware_become_ours(port: HebiBackend, module: Module) -> None:
    module.states.update(mstop_state=0, temperature_state=2, command_lifetime_state=1, position_limit_state=4)
    record = port.read(0.1)
    assert record is not None
    assert record.m_stop
    assert record.temperature_state == TemperatureState.EXCEED_MAX_MOTOR
    assert record.lock == CommandLock.LOCKED_BY_OTHER
    assert record.position_limit == LimitState.ABOVE
    module.states.update(temperature_state=77)
    record = port.read(0.1)
    assert record is not None
    assert record.temperature_state == 77


def test_silence_is_no_feedback(port: HebiBackend, module: Module) -> None:
    module.flows = False
    assert port.read(0.01) is None


@pytest.mark.parametrize(
    ("defect", "act", "fault"),
    [
        ("hears", lambda port: port.write(Command()), "send_failed"),
        ("acknowledges", lambda port: port.set_strategy(Strategy.DIRECT_PWM), "no_acknowledgement"),
        ("acknowledges", lambda port: port.set_gains(DEFAULT_GAINS[3]), "no_acknowledgement"),
        ("answers", lambda port: port.connect(), "module_lost"),
    ],
)
def test_each_way_of_losing_the_module_has_its_name(
    port: HebiBackend, module: Module, defect: str, act: Callable[[HebiBackend], object], fault: str
) -> None:
    setattr(module, defect, False)
    with pytest.raises(ActuatorError) as caught:
        act(port)
    assert caught.value.fault == fault


def test_stop_sends_zero_then_strategy_off_and_hears_it_confirmed(port: HebiBackend, module: Module) -> None:
    port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.2))
    module.sent.clear()
    port.stop()
    assert module.sent[0][2] == 0.0
    assert math.isnan(module.sent[-1][2])
    assert module.settings["control_strategy"] == Strategy.OFF
    assert port.strategy is Strategy.OFF


def test_a_stop_that_nobody_confirms_is_an_error_and_the_next_one_asks_again(port: HebiBackend, module: Module) -> None:
    port.set_strategy(Strategy.DIRECT_PWM)
    module.acknowledges = False
    for _ in range(2):
        asked = module.asked
        with pytest.raises(ActuatorError, match="did not confirm that it is off") as caught:
            port.stop()
        assert caught.value.fault == "stop_unacknowledged"
        assert module.asked - asked == 3
    # Together no longer than the command lifetime, which ends the torque meanwhile.
    assert module.patience_ms == 15
    module.acknowledges = True
    port.stop()
    assert module.settings["control_strategy"] == Strategy.OFF
    module.acknowledges = False
    with pytest.raises(ActuatorError, match="did not confirm"):
        port.close()
    with pytest.raises(ActuatorError, match="not connected"):
        port.write(Command())


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("effort_limit_min", -9.0, None),
        ("effort_limit_min", math.nan, "effort limits read back as nan and 4.0"),
        ("velocity_limit_max", -1.0, "velocity limits read back as"),
        ("min_position_limit_strategy", 3, "strategy at the min position limit reads back as 3"),
        ("mstop_strategy", 77, None),
    ],
)
def test_limits_that_a_module_keeps_otherwise_are_seen(
    port: HebiBackend, module: Module, name: str, value: float, message: str | None
) -> None:
    limits = HardwareLimits(effort=4.0, velocity=1.0, position_min=-3.0, position_max=3.0)
    assert port.set_limits(limits) == limits
    module.settings[name] = value
    module.keeps = False
    if message is None:
        assert port.set_limits(limits) != limits
    else:
        with pytest.raises(ActuatorError, match=message):
            port.set_limits(limits)


def test_a_gain_that_a_module_does_not_tell_is_not_taken_for_kept(port: HebiBackend, module: Module) -> None:
    port.set_gains(DEFAULT_GAINS[3])
    module.settings["velocity_kp"] = math.nan
    module.keeps = False
    with pytest.raises(ActuatorError, match="does not tell its velocity gain kp"):
        port.set_gains(DEFAULT_GAINS[3])


def test_a_strategy_of_a_newer_firmware_is_refused_by_number(port: HebiBackend, module: Module) -> None:
    module.settings["control_strategy"] = 9
    assert port.connect().strategy is Strategy.OFF
    module.keeps = False
    with pytest.raises(ActuatorError, match=r"strategy reads back as 9; expected DIRECT_PWM \(1\)"):
        port.set_strategy(Strategy.DIRECT_PWM)


def test_a_bridge_drives_a_module_arms_it_and_leaves_it_off(module: Module) -> None:
    """The whole way of a bridge over this backend: settings, arming, a cycle, release."""
    # Time passes with the module's records alone, however long this machine takes.
    clock = SteppedClock(1_000_000_000)
    next_feedback = module.get_next_feedback

    def get_next_feedback(timeout_ms: float, reuse: Any) -> Any:
        clock.wait_until(clock.now_ns() + 10_000_000)
        return next_feedback(timeout_ms, reuse)

    module.get_next_feedback = get_next_feedback  # type: ignore[method-assign]
    port = HebiBackend(make_group=lambda: module, clock=clock)
    port.connect()
    drivetrain = load_emulator("thesis").drivetrain
    mapping = EffortMapping(EffortStrategy.DIRECT_PWM, drivetrain, effort_limit=2.0)
    supervisor = PlantSupervisor(PlantLimits(effort=(2.0,)))
    limits = HardwareLimits(effort=2.0, velocity=1.0, position_min=-3.0, position_max=3.0)
    driven = DrivenModule(
        port,
        mapping,
        SafetyMonitor(SafetyLimits(winding_current=0.0), 0.01, drivetrain),
        BridgeSettings(limits=limits),
    )
    bridge = Bridge([driven], supervisor)
    module.values = {"voltage": 36.0, "velocity": 0.0, "pwm_command": 0.0, "motor_winding_temperature": 25.0}
    bridge.connect()
    module.states.update(temperature_state=0)
    assert bridge.observe(0.1) is not None
    module.settings.clear()  # without power since: everything is forgotten
    assert bridge.prepare() == ""
    assert module.settings["effort_limit_max"] == 2.0
    assert module.settings["position_limit_min"] == -3.0
    assert module.settings["control_strategy"] == Strategy.DIRECT_PWM
    assert 0.0 < module.settings["position_max_output"] < 2.0 * mapping.pwm_per_torque(36.0)
    assert supervisor.arm(port.now_ns(), bridge.sample) == ""
    bridge.carry_out(Drive(DriveKind.EFFORT, effort=(1.0,)))
    assert module.sent[-1][2] == pytest.approx(mapping.pwm_per_torque(36.0), rel=1e-6)
    bridge.close()
    assert module.settings["control_strategy"] == Strategy.OFF
    assert math.isnan(module.sent[-1][2])


def test_a_group_of_several_modules_is_refused() -> None:
    backend = HebiBackend(make_group=lambda: hebi.util.create_imitation_group(2), imitation=True)
    with pytest.raises(ActuatorError, match="HEBI group has 2 modules; expected 1"):
        backend.connect()


def test_the_librarys_group_is_released_under_a_guard_since_its_thread_may_never_end(
    port: HebiBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[bool] = []

    @contextmanager
    def guard() -> Iterator[None]:
        held.append(port._group is not None)
        yield
        held.append(port._group is not None)

    monkeypatch.setattr("pendulum_hw_bridge.backends.hebi.hang_guard", guard)
    port.close()
    assert held == [True, False]
