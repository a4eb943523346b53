"""Checks of setpoints before they are sent: the firmware accepts any number."""

from __future__ import annotations

import math

from pendulum_hw_bridge.port.actuator import MAX_COMMAND_LIFETIME, Command, HardwareLimits, Strategy
from pendulum_msgs_py.errors import ParameterError

__all__ = ["check_command", "check_lifetime"]


def check_lifetime(lifetime: float) -> float:
    """Return a command lifetime [s]; ParameterError if 0 (infinite to the firmware), negative, too long or NaN."""
    if not (math.isfinite(lifetime) and 0.0 < lifetime <= MAX_COMMAND_LIFETIME):
        raise ParameterError(
            f"command_lifetime is {lifetime} s; expected > 0 and <= {MAX_COMMAND_LIFETIME:g} s "
            "(0 would keep the last command for ever)"
        )
    return lifetime


def check_command(command: Command, strategy: Strategy, limits: HardwareLimits) -> tuple[Command, bool]:
    """Return the command within the firmware's limits, and whether that changed it.

    Raises:
        ParameterError: A setpoint is infinite, or does not exist under this strategy.
    """
    for name, unit in (("position", limits.joint.unit), *limits.units):
        if math.isinf(getattr(command, name)):
            raise ParameterError(f"{name} setpoint is {getattr(command, name)} {unit}; expected a finite number")
    direct = strategy is Strategy.DIRECT_PWM
    if not direct and not math.isnan(command.pwm):
        raise ParameterError(f"pwm setpoint under strategy {strategy.name}; expected one under DIRECT_PWM only")
    if direct and not (math.isnan(command.effort) and math.isnan(command.position) and math.isnan(command.velocity)):
        raise ParameterError("position, velocity or effort setpoint under DIRECT_PWM; expected pwm only")
    limited = Command(
        position=_clip(command.position, limits.position_min, limits.position_max),
        velocity=_clip(command.velocity, -limits.velocity, limits.velocity),
        effort=_clip(command.effort, -limits.effort, limits.effort),
        pwm=_clip(command.pwm, -limits.pwm, limits.pwm),
    )
    changed = any(
        getattr(limited, name) != getattr(command, name)
        for name in ("position", "velocity", "effort", "pwm")
        if not math.isnan(getattr(command, name))
    )
    return limited, changed


def _clip(value: float, low: float, high: float) -> float:
    # NaN ("loop off") passes unchanged: both comparisons are false.
    if value < low:
        return low
    if value > high:
        return high
    return value
