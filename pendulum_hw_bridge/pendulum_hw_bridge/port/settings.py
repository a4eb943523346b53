"""Settings of the actuator: written, read back and compared."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, EncoderPort, HardwareLimits
from pendulum_hw_bridge.port.command_check import check_lifetime
from pendulum_hw_bridge.port.gains import GainSet, differing_gain

__all__ = ["BridgeSettings", "expect_limits", "write_limits", "write_rate", "write_settings"]


@dataclass(frozen=True)
class BridgeSettings:
    """Settings that the bridge writes when it connects and each time it arms.

    Attributes:
        feedback_rate: [Hz].
        command_lifetime: Longest time that a killed bridge keeps driving [s].
        limits: Limits of the firmware.
        gains: Gains of the loops, before they are limited.
        joint_offset: Joint angle where the actuator reads zero [rad].
        joint_sign: 1, or -1 for an actuator mounted the other way round.
        effort_tare: Torque that the sensor shows at the joint without load [N m].
    """

    feedback_rate: float = 100.0
    command_lifetime: float = 0.05
    limits: HardwareLimits = field(default_factory=HardwareLimits)
    gains: GainSet | None = None
    joint_offset: float = 0.0
    joint_sign: int = 1
    effort_tare: float = 0.0


def write_settings(port: ActuatorPort, settings: BridgeSettings, gains: GainSet) -> None:
    """Write lifetime, rate, limits and (limited) gains; ActuatorError unless each reads back."""
    write_limits(port, settings)
    differs = differing_gain(port.set_gains(gains), gains)
    if differs:
        raise ActuatorError("settings", differs)


def write_limits(port: ActuatorPort, settings: BridgeSettings) -> None:
    """Write lifetime, rate and limits; ActuatorError unless each reads back."""
    lifetime = port.set_command_lifetime(check_lifetime(settings.command_lifetime))
    _expect("command lifetime", lifetime, settings.command_lifetime, "s")
    write_rate(port, settings)
    expect_limits(port.set_limits(settings.limits), settings.limits)


def write_rate(port: EncoderPort, settings: BridgeSettings) -> None:
    """Write the feedback rate; ActuatorError unless it reads back."""
    rate = port.set_feedback_rate(settings.feedback_rate)
    _expect("feedback rate", rate, settings.feedback_rate, "Hz")


def expect_limits(reads: HardwareLimits, wanted: HardwareLimits) -> None:
    """Raise ActuatorError for the first limit that reads back differently."""
    for what, unit in wanted.units:
        _expect(f"{what} limit", getattr(reads, what), getattr(wanted, what), unit)
    for what in ("position_min", "position_max"):
        _expect(what, getattr(reads, what), getattr(wanted, what), wanted.joint.unit)
    if reads.m_stop is not wanted.m_stop:
        raise ActuatorError(
            "settings", f"motion stop action reads back as {reads.m_stop.value}; expected {wanted.m_stop.value}"
        )


def _expect(what: str, reads: float, wanted: float, unit: str) -> None:
    # The module stores single precision, and the lifetime in whole milliseconds.
    if not math.isclose(reads, wanted, rel_tol=1e-5, abs_tol=6e-4 if unit == "s" else 1e-6):
        raise ActuatorError("settings", f"{what} reads back as {reads:g} {unit}; expected {wanted:g} {unit}")
