"""How a wanted joint torque becomes a setpoint of the firmware: the strategy is part of the plant.

Three ways, by the parameter ``effort_strategy``:

``direct_pwm``
    u = tau R / (eta N V K_t): feed-forward only, the duty that makes the torque at standstill. The motor's back-EMF
    stays in the plant as its damping; the thesis's b_c holds for this one.
``direct_pwm_compensated``
    u = (tau R / (eta N K_t) + c K_e N q') / V: the back-EMF is fed forward too, and with it most of b_c is gone.
``effort_loop``
    The firmware's own torque loop (strategy 3, effort setpoint alone) takes most of b_c away by feedback.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from pendulum_hw_bridge.actuator import Command, Feedback, Strategy
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import SeriesElasticParameters

__all__ = ["EffortMapping", "EffortStrategy"]


class EffortStrategy(str, Enum):
    """Ways to make a torque; the value is that of the parameter."""

    DIRECT_PWM = "direct_pwm"
    DIRECT_PWM_COMPENSATED = "direct_pwm_compensated"
    EFFORT_LOOP = "effort_loop"


@dataclass(frozen=True)
class EffortMapping:
    """Torque to setpoint and back.

    Args:
        kind: Which way.
        drivetrain: Constants of motor and gears.
        efficiency: eta, share of the motor's torque that is believed to reach the output [-].
        compensation: c, share of the back-EMF that is compensated; 1 leaves no margin for a hot winding, on which
            the compensation is too strong [-].
        position_gain: Position gain of the strategy for trajectories, for a hand-over without a jump [1/rad].
    """

    kind: EffortStrategy
    drivetrain: SeriesElasticParameters
    efficiency: float = 1.0
    compensation: float = 0.9
    position_gain: float = 1.5

    def __post_init__(self) -> None:
        """Refuse constants that would make the torque meaningless."""
        if not 0.0 < self.efficiency <= 1.0:
            raise ParameterError(f"effort_efficiency is {self.efficiency}; expected > 0 and <= 1")
        if not 0.0 <= self.compensation <= 1.0:
            raise ParameterError(f"back_emf_compensation is {self.compensation}; expected 0 to 1")

    @property
    def strategy(self) -> Strategy:
        """Strategy of the firmware under which the torque is made."""
        return Strategy.PARALLEL_PWM if self.kind is EffortStrategy.EFFORT_LOOP else Strategy.DIRECT_PWM

    @property
    def pwm_per_torque(self) -> float:
        """Duty for one newton metre at standstill, R / (eta N V K_t) [1/(N m)]."""
        drive = self.drivetrain
        return drive.winding_resistance / (
            self.efficiency * drive.gear_ratio * drive.supply_voltage * drive.torque_constant
        )

    def _back_emf_pwm(self, feedback: Feedback) -> float:
        if self.kind is not EffortStrategy.DIRECT_PWM_COMPENSATED or not math.isfinite(
            feedback.motor_velocity
        ):
            return 0.0
        return (
            self.compensation
            * self.drivetrain.back_emf_constant
            * feedback.motor_velocity
            / self.drivetrain.supply_voltage
        )

    def command(self, effort: float, feedback: Feedback) -> Command:
        """Return the setpoints for a wanted torque.

        Args:
            effort: Wanted torque at the joint [N m].
            feedback: Newest feedback.
        """
        if self.kind is EffortStrategy.EFFORT_LOOP:
            return Command(effort=effort)
        pwm = effort * self.pwm_per_torque + self._back_emf_pwm(feedback)
        return Command(pwm=min(1.0, max(-1.0, pwm)))

    def effort_of(self, command: Command, feedback: Feedback) -> float:
        """Return the torque that setpoints stand for: the inverse of :meth:`command`, after limits [N m]."""
        if math.isfinite(command.effort):
            return command.effort
        pwm = command.pwm if math.isfinite(command.pwm) else feedback.pwm_command
        if not math.isfinite(pwm):
            return 0.0
        return (pwm - self._back_emf_pwm(feedback)) / self.pwm_per_torque

    def handover_offset(self, effort: float) -> float:
        """Return by how far to move the position setpoint so that its loop starts with the duty of a torque [rad].

        Strategy 3 has no input for a feed-forward of PWM; its proportional position loop makes one of an offset.

        Args:
            effort: Torque to hand over [N m].
        """
        return effort * self.pwm_per_torque / self.position_gain if self.position_gain > 0.0 else 0.0
