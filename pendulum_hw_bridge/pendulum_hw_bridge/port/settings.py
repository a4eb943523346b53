"""Settings of the actuator: written, read back, and every one of them compared."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, EncoderPort, HardwareLimits
from pendulum_hw_bridge.port.command_check import check_lifetime
from pendulum_hw_bridge.port.gains import GainSet, differing_gain

__all__ = ["BridgeSettings", "expect_limits", "write_limits", "write_rate", "write_settings"]


@dataclass(frozen=True)
class BridgeSettings:
    """What the bridge sets in the actuator when it connects and each time it arms.

    Attributes:
        feedback_rate: [Hz].
        command_lifetime: [s]; a killed bridge drives for this long and no longer.
        limits: Limits of the firmware.
        gains: Gains of the loops, before they are limited.
        joint_offset: Joint angle where the actuator reads zero [rad].
        joint_sign: 1, or -1 for an actuator mounted the other way round.
        effort_tare: Torque that the sensor shows at the joint when nothing pulls [N m].
    """

    feedback_rate: float = 100.0
    command_lifetime: float = 0.05
    limits: HardwareLimits = field(default_factory=HardwareLimits)
    gains: GainSet | None = None
    joint_offset: float = 0.0
    joint_sign: int = 1
    effort_tare: float = 0.0


def write_settings(port: ActuatorPort, settings: BridgeSettings, gains: GainSet) -> None:
    """Write lifetime, rate, limits and gains, and refuse a module that does not keep each of them.

    Args:
        port: A connected actuator.
        settings: What to write.
        gains: Gains, their outputs limited.

    Raises:
        ActuatorError: Not acknowledged, or something reads back as another value.
    """
    write_limits(port, settings)
    differs = differing_gain(port.set_gains(gains), gains)
    if differs:
        raise ActuatorError("settings", differs)


def write_limits(port: ActuatorPort, settings: BridgeSettings) -> None:
    """Write lifetime, rate and limits, and refuse a module that does not keep each of them.

    Args:
        port: A connected actuator.
        settings: What to write.

    Raises:
        ActuatorError: Not acknowledged, or something reads back as another value.
    """
    lifetime = port.set_command_lifetime(check_lifetime(settings.command_lifetime))
    _expect("command lifetime", lifetime, settings.command_lifetime, "s")
    write_rate(port, settings)
    expect_limits(port.set_limits(settings.limits), settings.limits)


def write_rate(port: EncoderPort, settings: BridgeSettings) -> None:
    """Write the feedback rate, and refuse a module that does not keep it.

    Args:
        port: A connected module.
        settings: What to write.

    Raises:
        ActuatorError: Not acknowledged, or another rate reads back.
    """
    rate = port.set_feedback_rate(settings.feedback_rate)
    _expect("feedback rate", rate, settings.feedback_rate, "Hz")


def expect_limits(reads: HardwareLimits, wanted: HardwareLimits) -> None:
    """Refuse limits that are others than wanted.

    Args:
        reads: What a module tells.
        wanted: What it should tell.

    Raises:
        ActuatorError: Names the first that differs.
    """
    for what, unit in wanted.units:
        _expect(f"{what} limit", getattr(reads, what), getattr(wanted, what), unit)
    for what in ("position_min", "position_max"):
        _expect(what, getattr(reads, what), getattr(wanted, what), wanted.joint.unit)
    if reads.m_stop is not wanted.m_stop:
        raise ActuatorError(
            "settings",
            f"motion stop action reads back as {reads.m_stop.value}; expected {wanted.m_stop.value}",
        )


def _expect(what: str, reads: float, wanted: float, unit: str) -> None:
    # The module keeps single precision, and the lifetime whole milliseconds.
    if not math.isclose(reads, wanted, rel_tol=1e-5, abs_tol=6e-4 if unit == "s" else 1e-6):
        raise ActuatorError("settings", f"{what} reads back as {reads:g} {unit}; expected {wanted:g} {unit}")
