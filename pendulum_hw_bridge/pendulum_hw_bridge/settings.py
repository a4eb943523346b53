"""Settings of the actuator: written, read back, and every one of them compared."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pendulum_hw_bridge.actuator import ActuatorError, ActuatorPort, check_lifetime
from pendulum_hw_bridge.gains import GainSet, differing_gain

if TYPE_CHECKING:
    from pendulum_hw_bridge.bridge import BridgeSettings

__all__ = ["write_settings"]


def write_settings(port: ActuatorPort, settings: BridgeSettings, gains: GainSet) -> None:
    """Write lifetime, rate, limits and gains, and refuse a module that does not keep each of them.

    Args:
        port: A connected actuator.
        settings: What to write.
        gains: Gains, their outputs limited.

    Raises:
        ActuatorError: Not acknowledged, or something reads back as another value.
    """
    lifetime = port.set_command_lifetime(check_lifetime(settings.command_lifetime))
    _expect("command lifetime", lifetime, settings.command_lifetime, "s")
    rate = port.set_feedback_rate(settings.feedback_rate)
    _expect("feedback rate", rate, settings.feedback_rate, "Hz")
    wanted = settings.limits
    reads = port.set_limits(wanted)
    for what, unit in (("effort", "N m"), ("velocity", "rad/s"), ("pwm", "of the supply")):
        _expect(f"{what} limit", getattr(reads, what), getattr(wanted, what), unit)
    for what in ("position_min", "position_max"):
        _expect(what, getattr(reads, what), getattr(wanted, what), "rad")
    if reads.m_stop is not wanted.m_stop:
        raise ActuatorError(
            "settings",
            f"motion stop action reads back as {reads.m_stop.value}; expected {wanted.m_stop.value}",
        )
    differs = differing_gain(port.set_gains(gains), gains)
    if differs:
        raise ActuatorError("settings", differs)


def _expect(what: str, reads: float, wanted: float, unit: str) -> None:
    # The module keeps single precision, and the lifetime whole milliseconds.
    if not math.isclose(reads, wanted, rel_tol=1e-5, abs_tol=6e-4 if unit == "s" else 1e-6):
        raise ActuatorError("settings", f"{what} reads back as {reads:g} {unit}; expected {wanted:g} {unit}")
