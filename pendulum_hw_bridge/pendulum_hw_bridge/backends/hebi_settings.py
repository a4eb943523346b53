"""Conversion of settings to and from hebi-py's fields, for one module's command or info; nothing is sent here."""

from __future__ import annotations

import math
from typing import Any

from pendulum_hw_bridge.port.actuator import ActuatorError, HardwareLimits, MStopAction
from pendulum_hw_bridge.port.gains import GAIN_FIELDS, LOOPS, GainSet, PidGains

__all__ = ["LIMIT_DISABLED", "LIMIT_MOTOR_OFF", "M_STOPS", "fill_gains", "fill_limits", "gains_of", "limits_of"]

_PASCAL_M_STOP = {
    MStopAction.DISABLED: "Disabled",
    MStopAction.MOTOR_OFF: "MotorOff",
    MStopAction.HOLD_POSITION: "HoldPosition",
}
LIMIT_MOTOR_OFF, LIMIT_DISABLED = 2, 3
"""What a module does at an end of its position window, by hebi-py's numbers."""
_STRATEGIES = {LIMIT_MOTOR_OFF: "motor off", LIMIT_DISABLED: "disabled"}
M_STOPS = (MStopAction.DISABLED, MStopAction.MOTOR_OFF, MStopAction.HOLD_POSITION)
"""Actions of the motion stop, in the order of hebi-py's numbers."""


def fill_gains(command: Any, gains: GainSet) -> None:
    """Put the gains of all loops into a command; infinite clamps are left out."""
    for loop in LOOPS:
        for name in GAIN_FIELDS:
            value = getattr(gains.loop(loop), name)
            if math.isfinite(value):
                setattr(command, f"{loop}_{name}", bool(value) if name == "d_on_error" else value)


def gains_of(info: Any, wanted: GainSet) -> GainSet:
    """Return the gains that a module reports; infinite clamps, which are never written, are taken from ``wanted``.

    Raises:
        ActuatorError: The module does not report a gain.
    """
    loops: dict[str, PidGains] = {}
    for loop in LOOPS:
        read: dict[str, float] = {}
        for name in GAIN_FIELDS:
            asked = float(getattr(wanted.loop(loop), name))
            read[name] = float(getattr(info, f"{loop}_{name}")[0]) if math.isfinite(asked) else asked
            if math.isnan(read[name]):
                raise ActuatorError("settings", f"HEBI module does not tell its {loop} gain {name}")
        loops[loop] = PidGains(**read)
    return GainSet(wanted.strategy, **loops)


def fill_limits(command: Any, limits: HardwareLimits) -> None:
    """Put the safety parameters into a command, with open ends of the position window disabled.

    Left alone, the module might hold its position at a limit of its own there, with a torque that was not commanded.
    """
    command.effort_limit_min, command.effort_limit_max = -limits.effort, limits.effort
    command.velocity_limit_min, command.velocity_limit_max = -limits.velocity, limits.velocity
    for end, angle in _window(limits).items():
        if math.isfinite(angle):
            setattr(command, f"position_limit_{end}", angle)
        setattr(command, f"{end}_position_limit_strategy", "MotorOff" if math.isfinite(angle) else "Disabled")
    command.mstop_strategy = _PASCAL_M_STOP[limits.m_stop]


def limits_of(info: Any, wanted: HardwareLimits) -> HardwareLimits:
    """Return the safety parameters that a module reports; open ends of the position window are taken from ``wanted``.

    Raises:
        ActuatorError: A limit is not reported, an end of the window does not switch off, or an open end acts.
    """
    ends = _window(wanted)
    for end, angle in ends.items():
        number = LIMIT_MOTOR_OFF if math.isfinite(angle) else LIMIT_DISABLED
        strategy = int(getattr(info, f"{end}_position_limit_strategy")[0])
        if strategy != number:
            raise ActuatorError(
                "settings",
                f"strategy at the {end} position limit reads back as {strategy}; expected {number} "
                f"({_STRATEGIES[number]})",
            )
        if math.isfinite(angle):
            ends[end] = float(getattr(info, f"position_limit_{end}")[0])
    return HardwareLimits(
        effort=_wider(info.effort_limit_min[0], info.effort_limit_max[0], "effort"),
        velocity=_wider(info.velocity_limit_min[0], info.velocity_limit_max[0], "velocity"),
        position_min=ends["min"],
        position_max=ends["max"],
        pwm=wanted.pwm,
        m_stop=dict(enumerate(M_STOPS)).get(int(info.mstop_strategy[0]), MStopAction.DISABLED),
    )


def _window(limits: HardwareLimits) -> dict[str, float]:
    """Return the ends of the position window, infinite where open [rad]."""
    return {"min": limits.position_min, "max": limits.position_max}


def _wider(low: Any, high: Any, what: str) -> float:
    """Return the larger side of a symmetric limit."""
    if not (float(low) < 0.0 < float(high)):
        raise ActuatorError("settings", f"{what} limits read back as {low} and {high}; expected them around zero")
    return max(-float(low), float(high))
