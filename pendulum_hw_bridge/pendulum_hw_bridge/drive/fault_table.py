"""Names and meanings of the bridge's faults."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FAULTS", "Fault"]

FAULTS = {
    "feedback_lost": "no feedback for three cycles",
    "feedback_frozen": "records arrive, but their number, time or all measured values stand still for three cycles",
    "feedback_not_finite": "position, velocity or effort is NaN or infinite",
    "feedback_late": "records are older than three cycles when they arrive",
    "host_stalled": "the bridge itself did not run for three cycles: a busy or halted machine",
    "module_restarted": "the module's own clock or sequence number went back: it has lost its settings",
    "position_jump": "position changed by more than its velocity allows",
    "motion_disagreement": "position and velocity disagree over a fifth of a second (a stuck encoder)",
    "m_stop": "the motion stop is pressed",
    "over_temperature": "the firmware limits or cuts the output, or the winding is above its limit",
    "locked_by_other": "another sender holds the module",
    "voltage": "supply voltage outside its window, or a jump of it",
    "firmware_limit": "a safety limit of the firmware acts",
    "effort_measured": "measured torque above its limit",
    "motor_effort": "duty and speed of the motor make more torque than the effort limit",
    "command_not_in_force": "the module acts on something that was not sent",
    "output_disagreement": "the duty does not follow from setpoints and gains: stuck, runaway, other gains or strategy",
    "winding_current": "winding current does not fit PWM, velocity and resistance",
    "strategy": "the strategy does not read back",
    "settings": "a setting does not read back as it was written",
    "send_failed": "a command could not be sent",
    "no_acknowledgement": "a setting was not acknowledged",
    "stop_unacknowledged": "the module did not confirm that it is off; the stop is repeated until it does",
    "supervisor": "a limit that every plant has: velocity, position window, trajectory, age of the measurement",
    "exception": "an error in the bridge itself",
    "drive_error": "the drive reports an error of its own: it has switched itself off, or is about to",
    "module_lost": "the module is missing, ambiguous, or does not respond",
    "not_prepared": "the drive was released between preparing and arming; arm again",
    "not_connected": "the actuator is used before it is connected",
    "not_installed": "the vendor's library is not installed",
}


@dataclass(frozen=True)
class Fault:
    """Name of a fault in :data:`FAULTS`, and a sentence with the values."""

    name: str
    message: str
