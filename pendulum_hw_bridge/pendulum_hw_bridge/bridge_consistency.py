"""Parameters that are allowed one by one and wrong together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.errors import ParameterError

__all__ = ["check_consistency"]

_LEAST_RATE = 20.0
"""Feedback rate below which a pendulum falls between two records [Hz]."""
_SLOWEST = 1.0
"""Longest time that anything may take to be noticed, on an emulator on a busy machine [s]."""
_SLOWEST_ON_HARDWARE = 0.1
"""The same where somebody can be hurt [s]."""


def check_consistency(values: Mapping[str, Any], limits: PlantLimits) -> None:
    """Refuse parameters with which a fault would act too long, or commands would lapse between two cycles.

    Args:
        values: Parameters of the bridge.
        limits: Limits of the plant.

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
    if hardware:
        _check_hardware(values["backend"], limits)


def _check_hardware(backend: str, limits: PlantLimits) -> None:
    for name, value in (
        ("velocity_limit", limits.velocity),
        ("effort_slew_limit", limits.slew),
        ("start_effort_limit", limits.start_effort),
        ("starvation_limit", limits.starvation),
        ("position_window", limits.position_max[0] - limits.position_min[0]),
    ):
        if math.isinf(value):
            raise ParameterError(f"{name} is none; expected one with backend {backend!r}")
