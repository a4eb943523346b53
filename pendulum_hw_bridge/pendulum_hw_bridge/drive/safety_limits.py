"""Limits of the checks of feedback."""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError

__all__ = ["SafetyLimits"]


@dataclass(frozen=True)
class SafetyLimits:
    """Limits of :class:`SafetyMonitor`.

    Attributes:
        winding_temperature: Largest winding temperature [degC].
        voltage_min: [V].
        voltage_max: [V].
        measured_effort: Largest torque measured by the spring [N m].
        position_jump: Largest change of position beyond that of the velocity, in one cycle [rad].
        position_disagreement: Largest disagreement of position and integrated velocity in 0.2 s [rad].
        winding_current: Largest disagreement of the winding current; 0 disables the check [A].
        command_tolerance: Largest difference between setpoint sent and in force [rad or N m].
        pwm_tolerance: The same for a duty; firmware steps are 2.4e-4 [-].
        feedback_cycles: Feedback periods without a record after which feedback counts as lost [-].
    """

    winding_temperature: float = 120.0
    voltage_min: float = 22.0
    voltage_max: float = 50.0
    measured_effort: float = 14.0
    position_jump: float = 0.1
    position_disagreement: float = 0.01
    winding_current: float = 0.15
    command_tolerance: float = 2e-3
    pwm_tolerance: float = 5e-4
    feedback_cycles: int = 3

    def __post_init__(self) -> None:
        for name, unit in (
            ("winding_temperature", "degC"),
            ("measured_effort", "N m"),
            ("position_jump", "rad"),
            ("position_disagreement", "rad"),
        ):
            if not getattr(self, name) > 0.0:
                raise ParameterError(f"{name} limit is {getattr(self, name)} {unit}; expected > 0")
        if not self.voltage_min < self.voltage_max:
            raise ParameterError(f"voltage window is [{self.voltage_min}, {self.voltage_max}] V; expected min < max")
