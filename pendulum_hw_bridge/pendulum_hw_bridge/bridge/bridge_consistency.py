"""Checks of parameters that are valid alone but wrong together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS, Bounds
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.port.actuator import MStopAction
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.errors import ParameterError

__all__ = ["check_consistency"]

_LEAST_RATE = 20.0
"""Feedback rate below which a pendulum falls between two records [Hz]."""
_SLOWEST = 1.0
"""Longest detection time of any fault, on an emulator on a busy machine [s]."""
_SLOWEST_ON_HARDWARE = 0.1
"""The same where people can be hurt [s]."""
_MEASURED_MARGIN = 2.0
"""Largest limit of the measured torque, above the peak of the actuator: noise and a tare [N m]."""
_E_STOP_INPUT = (0.05, 1.0)
"""Silence that counts as a press [s]: at 20 Hz, below this range one late message is one; above, a cut cable is noticed
late.
"""


def check_consistency(values: Mapping[str, Any], limits: PlantLimits) -> None:
    """Refuse parameters with which a fault would act too long, or commands would expire between two cycles.

    Raises:
        ParameterError: Names the parameter, its value and what the others allow.
    """
    rate, hardware = values["feedback_rate"], BACKENDS[values["backend"]].is_machine
    period = 1.0 / rate
    if rate < _LEAST_RATE:
        raise ParameterError(f"feedback_rate is {rate:g} Hz; expected at least {_LEAST_RATE:g} Hz")
    slowest = _SLOWEST_ON_HARDWARE if hardware else _SLOWEST
    where = f"at {rate:g} Hz with backend {values['backend']!r}"
    watchdog = values["feedback_watchdog"] * period
    if watchdog > slowest:
        raise ParameterError(
            f"feedback_watchdog is {values['feedback_watchdog']} periods, {watchdog:g} s; "
            f"expected at most {math.floor(slowest * rate + 1e-9)} {where}"
        )
    if values["command_lifetime"] < 2.0 * period:
        raise ParameterError(
            f"command_lifetime is {values['command_lifetime']:g} s; expected at least two periods, "
            f"{2.0 * period:g} s {where}: a command would lapse before the next"
        )
    if hardware and values["command_lifetime"] > slowest:
        raise ParameterError(
            f"command_lifetime is {values['command_lifetime']:g} s; expected at most {slowest:g} s {where}: "
            "so long a dead bridge drives"
        )
    if not period <= limits.command_timeout <= slowest:
        raise ParameterError(
            f"command_timeout is {limits.command_timeout:g} s; expected {period:g} to {slowest:g} s {where}"
        )
    if limits.stop_time and values["effort_strategy"] == EffortStrategy.EFFORT_LOOP.value:
        raise ParameterError(
            f"stop_time is {limits.stop_time:g} s; expected 0 with effort_strategy {values['effort_strategy']!r}: "
            "its torque loop, woken by a stop, makes more torque than acted"
        )
    if hardware:
        _check_hardware(values, limits, BACKENDS[values["backend"]].bounds)


def _check_hardware(values: Mapping[str, Any], limits: PlantLimits, bounds: Bounds) -> None:
    """Refuse limits too large to protect the machine; too small ones only stop it early, which is safe."""
    where = f"with backend {values['backend']!r}"
    width = max(high - low for low, high in zip(limits.position_min, limits.position_max, strict=True))
    for name, value, largest, unit, why in (
        ("effort_limit", max(limits.effort), bounds.effort, "N m", f"the peak of {bounds.actuator}"),
        (
            "velocity_limit",
            limits.velocity,
            bounds.velocity,
            "rad/s",
            "twice what the motor can do, so that it limits nothing",
        ),
        ("effort_slew_limit", limits.slew, 26e3, "N m/s", "from -13 to 13 N m in one cycle at 1 kHz"),
        ("start_effort_limit", limits.start_effort, 5.0, "N m", "a commander would begin with a blow"),
        ("starvation_limit", limits.starvation, 120.0, "s", "an armed plant would be forgotten"),
        ("position_window", width, 64.0, "rad", "from end to end, ten turns"),
        ("handover_time", limits.handover_time, 1.0, "s", "a torque without a commander would last"),
        ("handover_effort_limit", limits.handover_effort, 5.0, "N m", "a commander would take over with a blow"),
        ("tracking_error_limit", limits.tracking_error, 1.0, "rad", "so far off it follows no trajectory"),
    ):
        if math.isinf(value):
            raise ParameterError(f"{name} is none; expected one {where}")
        if value > largest:
            raise ParameterError(f"{name} is {value:g} {unit}; expected at most {largest:g} {unit} {where}: {why}")
    if values["measured_effort_limit"] > bounds.effort + _MEASURED_MARGIN:
        raise ParameterError(
            f"measured_effort_limit is {values['measured_effort_limit']:g} N m; expected at most "
            f"{bounds.effort + _MEASURED_MARGIN:g} N m {where}: the actuator makes {bounds.effort:g} N m"
        )
    if bounds.m_stop and values["m_stop_action"] == MStopAction.DISABLED.value:
        raise ParameterError(
            f"m_stop_action is {MStopAction.DISABLED.value}; expected {MStopAction.MOTOR_OFF.value} or "
            f"{MStopAction.HOLD_POSITION.value} {where}: the motion stop would stop nothing"
        )
    low, high = bounds.supply
    if not all(low <= voltage <= high for voltage in values["voltage_window"]):
        raise ParameterError(
            f"voltage_window is {values['voltage_window']} V; expected inside {low:g} to {high:g} V {where}: "
            f"the range of {bounds.actuator}"
        )
    low, high = _E_STOP_INPUT
    silence = values["e_stop_input_timeout"]
    if silence and not low <= silence <= high:
        raise ParameterError(
            f"e_stop_input_timeout is {silence:g} s; expected {low:g} to {high:g} s, or 0 for no such input {where}: "
            "shorter, any late message is a press; longer, a lost button is none"
        )
