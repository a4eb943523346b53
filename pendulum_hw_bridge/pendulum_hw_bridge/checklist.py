"""The checklist that a lab goes through before it arms: every item measured or read back, none assumed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pendulum_hw_bridge.actuator import (
    ActuatorError,
    ActuatorInfo,
    ActuatorPort,
    Command,
    CommandLock,
    Feedback,
    Strategy,
    TemperatureState,
)
from pendulum_hw_bridge.bridge import BridgeSettings
from pendulum_hw_bridge.safety import SafetyLimits
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import PendulumError

__all__ = ["CheckItem", "run_checklist"]

_LISTEN = 1.0
_AT_REST = 0.05
_MAX_JITTER = 0.25


@dataclass(frozen=True)
class CheckItem:
    """One line of the checklist.

    Attributes:
        name: What was checked.
        passed: Whether it is as it should be.
        seen: What was seen, with unit.
        expected: What should be.
    """

    name: str
    passed: bool
    seen: str
    expected: str


def run_checklist(
    port: ActuatorPort,
    settings: BridgeSettings,
    limits: SafetyLimits,
    *,
    window: tuple[float, float] = (-math.inf, math.inf),
    progress: Callable[[str], None] = lambda text: None,
) -> list[CheckItem]:
    """Go through the checklist; the motor never gets another duty than zero, and is off at the end.

    Args:
        port: The actuator, not connected yet.
        settings: What the bridge would set.
        limits: Limits of the feedback.
        window: Angles between which the pendulum must be, in joint coordinates [rad].
        progress: Called with what is being done.
    """
    items: list[CheckItem] = []
    try:
        progress("connecting")
        info = port.connect()
        items.append(
            CheckItem("actuator answers", True, _identity(info), "one module of that family and name")
        )
        progress("setting and reading back")
        items += _settings(port, settings)
        progress(f"listening for {_LISTEN:g} s")
        records = _listen(port)
        items += _timing(records, settings)
        if records:
            items += _state(records, limits)
            items.append(_window(records[-1], settings, window))
        progress("trying the strategy at zero torque")
        items.append(_strategy(port))
    except PendulumError as error:
        fault = error.fault if isinstance(error, ActuatorError) else "parameter"
        items.append(CheckItem(fault, False, str(error), "no error"))
    finally:
        port.stop()
        port.close()
    return items


def _identity(info: ActuatorInfo) -> str:
    serial = f", serial {info.serial}" if info.serial else ""
    firmware = f", firmware {info.firmware}" if info.firmware else ""
    return f"{info.backend} {info.family}/{info.name}{serial}{firmware}"


def _settings(port: ActuatorPort, settings: BridgeSettings) -> list[CheckItem]:
    lifetime = port.set_command_lifetime(settings.command_lifetime)
    rate = port.set_feedback_rate(settings.feedback_rate)
    limits = port.set_limits(settings.limits)
    items = [
        _equal("command lifetime reads back", lifetime, settings.command_lifetime, "s"),
        _equal("feedback rate reads back", rate, settings.feedback_rate, "Hz"),
        _equal("effort limit reads back", limits.effort, settings.limits.effort, "N m"),
        _equal("velocity limit reads back", limits.velocity, settings.limits.velocity, "rad/s"),
        CheckItem(
            "motion stop does what it should",
            limits.m_stop is settings.limits.m_stop,
            limits.m_stop.value,
            settings.limits.m_stop.value,
        ),
    ]
    if settings.gains is not None:
        gains = port.set_gains(settings.gains)
        items.append(
            _equal("position gain reads back", gains.position.kp, settings.gains.position.kp, "1/rad")
        )
    off = port.set_strategy(Strategy.OFF)
    items.append(CheckItem("strategy off reads back", off is Strategy.OFF, off.name, "OFF"))
    return items


def _listen(port: ActuatorPort) -> list[Feedback]:
    records: list[Feedback] = []
    end = port.now_ns() + round(_LISTEN * NANOSECONDS)
    while port.now_ns() < end:
        record = port.read(0.1)
        if record is not None:
            records.append(record)
    return records


def _timing(records: list[Feedback], settings: BridgeSettings) -> list[CheckItem]:
    if len(records) < 2:
        return [
            CheckItem(
                "feedback flows",
                False,
                f"{len(records)} records in {_LISTEN:g} s",
                f"{settings.feedback_rate:g} Hz",
            )
        ]
    periods = np.diff([record.stamp_ns for record in records]) / NANOSECONDS
    rate, jitter = 1.0 / float(np.mean(periods)), float(np.std(periods)) * settings.feedback_rate
    worst = float(np.max(periods)) * settings.feedback_rate
    return [
        CheckItem(
            "feedback flows",
            abs(rate / settings.feedback_rate - 1.0) < 0.05,
            f"{rate:.1f} Hz",
            f"{settings.feedback_rate:g} Hz within 5 %",
        ),
        CheckItem(
            "feedback is regular",
            jitter < _MAX_JITTER and worst < 3.0,
            f"jitter {100.0 * jitter:.0f} % of the period, longest gap {worst:.1f} periods",
            f"jitter below {100.0 * _MAX_JITTER:.0f} %, no gap of 3 periods",
        ),
    ]


def _state(records: list[Feedback], limits: SafetyLimits) -> list[CheckItem]:
    last = records[-1]
    finite = all(
        math.isfinite(value)
        for record in records
        for value in (record.position, record.velocity, record.effort)
    )
    speed = max(abs(record.velocity) for record in records)
    effort = max(abs(record.effort) for record in records)
    return [
        CheckItem(
            "position, velocity, effort are numbers",
            finite,
            "all finite" if finite else "not all",
            "all finite",
        ),
        CheckItem(
            "pendulum is at rest", speed <= _AT_REST, f"{speed:.3f} rad/s", f"at most {_AT_REST:g} rad/s"
        ),
        CheckItem(
            "measured torque is plausible",
            effort <= 0.5 * limits.measured_effort,
            f"{effort:.2f} N m",
            f"at most {0.5 * limits.measured_effort:g} N m at rest",
        ),
        CheckItem(
            "motion stop is released", not last.m_stop, "pressed" if last.m_stop else "released", "released"
        ),
        CheckItem(
            "nobody else commands",
            last.lock != CommandLock.LOCKED_BY_OTHER,
            CommandLock(last.lock).name.lower(),
            "not locked_by_other",
        ),
        CheckItem(
            "supply voltage",
            limits.voltage_min <= last.voltage <= limits.voltage_max,
            f"{last.voltage:.1f} V",
            f"{limits.voltage_min:g} to {limits.voltage_max:g} V",
        ),
        CheckItem(
            "winding temperature",
            last.winding_temperature <= limits.winding_temperature,
            f"{last.winding_temperature:.0f} degC",
            f"at most {limits.winding_temperature:g} degC",
        ),
        CheckItem(
            "firmware's temperature state",
            last.temperature_state == TemperatureState.NORMAL,
            TemperatureState(last.temperature_state).name.lower(),
            "normal",
        ),
    ]


def _window(last: Feedback, settings: BridgeSettings, window: tuple[float, float]) -> CheckItem:
    angle = settings.joint_sign * last.position + settings.joint_offset
    return CheckItem(
        "angle is inside its window",
        window[0] <= angle <= window[1],
        f"{angle:.3f} rad",
        f"{window[0]:g} to {window[1]:g} rad; 0 hangs down: look at the pendulum",
    )


def _strategy(port: ActuatorPort) -> CheckItem:
    reads = port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.0))
    port.stop()
    return CheckItem("direct PWM can be set", reads is Strategy.DIRECT_PWM, reads.name, "DIRECT_PWM")


def _equal(name: str, seen: float, wanted: float, unit: str) -> CheckItem:
    return CheckItem(
        name, abs(seen - wanted) <= 1e-3 * max(1.0, abs(wanted)), f"{seen:g} {unit}", f"{wanted:g} {unit}"
    )
