"""Mapping of joint torque to firmware setpoints, by the parameter ``effort_strategy``.

``direct_pwm``
    u = tau R / (eta N V K_t): feed-forward only. Back-EMF stays in the plant as damping, as in the thesis's b_c.
``direct_pwm_compensated``
    u = (tau R / (eta N K_t) + c K_e N q') / V: back-EMF is fed forward too, which removes most of b_c.
``effort_loop``
    The firmware's torque loop (strategy 3, effort setpoint alone), which removes most of b_c by feedback.

V is the measured supply voltage. :meth:`EffortMapping.bounded` limits setpoints and :meth:`EffortMapping.limited_gains`
the firmware's loops to the effort limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.port.actuator import PEAK_EFFORT, Command, Feedback, Strategy
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet, limit_output
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["EffortMapping", "EffortStrategy"]

_START_SHARE = 0.3
"""Share of the effort limit that position control may spend on a speed not reached yet [-]."""
_DITHER = 4.5e-4
"""Amplitude of the alternating duty of position control: two firmware steps, 0.02 N m of an X5-9 [-]."""


class EffortStrategy(str, Enum):
    """Values of the parameter ``effort_strategy``."""

    DIRECT_PWM = "direct_pwm"
    DIRECT_PWM_COMPENSATED = "direct_pwm_compensated"
    EFFORT_LOOP = "effort_loop"


@dataclass(frozen=True)
class EffortMapping:
    """Torque to setpoint and back.

    Args:
        kind: Strategy.
        drivetrain: Constants of motor and gears.
        efficiency: eta, assumed share of the motor's torque that reaches the output [-].
        compensation: c, share of the back-EMF that is compensated; 1 overcompensates on a hot winding [-].
        gains: Gains of the firmware's loops under strategy 3.
        effort_limit: Largest torque of a setpoint [N m].
        velocity_limit: Largest speed setpoint of position control [rad/s].
        joint: Actuated joint, for the units in messages.
    """

    kind: EffortStrategy
    drivetrain: SeriesElasticParameters
    efficiency: float = 1.0
    compensation: float = 0.9
    gains: GainSet = DEFAULT_GAINS[3]
    effort_limit: float = PEAK_EFFORT
    velocity_limit: float = 1.5
    joint: Joint = field(default=ONE_JOINT.joints[0], compare=False, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.efficiency <= 1.0:
            raise ParameterError(f"effort_efficiency is {self.efficiency}; expected > 0 and <= 1")
        if not 0.0 <= self.compensation <= 1.0:
            raise ParameterError(f"back_emf_compensation is {self.compensation}; expected 0 to 1")
        if not (math.isfinite(self.effort_limit) and self.effort_limit > 0.0):
            unit = self.joint.effort_unit
            raise ParameterError(f"effort_limit is {self.effort_limit} {unit}; expected a finite number > 0")

    @property
    def strategy(self) -> Strategy:
        """Firmware strategy that produces the torque."""
        return Strategy.PARALLEL_PWM if self.kind is EffortStrategy.EFFORT_LOOP else Strategy.DIRECT_PWM

    def pwm_per_torque(self, voltage: float | None = None) -> float:
        """Return the duty for 1 N m at standstill, R / (eta N V K_t), by default at nominal voltage [1/(N m)]."""
        drive = self.drivetrain
        supply = drive.supply_voltage if voltage is None else voltage
        return drive.winding_resistance / (self.efficiency * drive.gear_ratio * supply * drive.torque_constant)

    def back_emf_pwm(self, velocity: float, voltage: float) -> float:
        """Return the duty that cancels the back-EMF at an output speed, K_e N q' / V [-]."""
        return self.drivetrain.back_emf_constant * self.drivetrain.gear_ratio * velocity / voltage

    def motor_effort(self, pwm: float, velocity: float, voltage: float) -> float:
        """Return the joint torque of a duty at a motor speed, (u V - K_e N q') K_t N eta / R [N m]."""
        return (pwm - self.back_emf_pwm(velocity, voltage)) / self.pwm_per_torque(voltage)

    def largest_effort(self, speed: float) -> float:
        """Return the largest motor torque at a joint speed [rad/s]: effort limit plus back-EMF braking [N m].

        No setpoint removes the braking torque, and a duty that opposes the motion adds to it.
        """
        return self.effort_limit + abs(self.motor_effort(0.0, speed, self.drivetrain.supply_voltage))

    def command(self, effort: float, motor: MotorState) -> Command:
        """Return the setpoints for a wanted torque [N m]."""
        if self.kind is EffortStrategy.EFFORT_LOOP:
            return Command(effort=effort)
        return Command(pwm=effort * self.pwm_per_torque(motor.voltage) + self._compensated_pwm(motor))

    def effort_of(self, command: Command, motor: MotorState, pwm_in_force: float) -> float:
        """Return the torque of setpoints, the inverse of :meth:`command` after limits [N m].

        Under position control, the firmware's reported duty ``pwm_in_force`` [-] counts.
        """
        if math.isfinite(command.effort):
            return command.effort
        if math.isfinite(command.pwm):
            compensated = 0.0 if command.pwm == 0.0 else self._compensated_pwm(motor)
            return (command.pwm - compensated) / self.pwm_per_torque(motor.voltage)
        if not (math.isfinite(command.position) and math.isfinite(pwm_in_force)):
            return 0.0
        return (pwm_in_force - self._compensated_pwm(motor)) / self.pwm_per_torque(motor.voltage)

    def _compensated_pwm(self, motor: MotorState) -> float:
        if self.kind is not EffortStrategy.DIRECT_PWM_COMPENSATED:
            return 0.0
        return self.compensation * self.back_emf_pwm(motor.velocity, motor.voltage)

    def bounded(self, command: Command, motor: MotorState) -> Command:
        """Return setpoints that stay within the torque limit as long as one speed sensor is right."""
        limit = self.effort_limit
        duty = limit * self.pwm_per_torque(motor.voltage)
        emf = self.back_emf_pwm(1.0, motor.voltage) if self.kind is not EffortStrategy.DIRECT_PWM else 0.0
        low, high = max(-1.0, -duty + emf * motor.lowest), min(1.0, duty + emf * motor.highest)
        # A velocity setpoint costs duty, which a blocked link would receive as torque: limit how far it may lead the
        # speed.
        start = self._start_velocity(motor.voltage)
        return replace(
            command,
            effort=_clip(command.effort, -limit, limit),
            pwm=_clip(command.pwm, low, high),
            velocity=_clip(command.velocity, motor.lowest - start, motor.highest + start),
        )

    def limited_gains(self, voltage: float) -> GainSet:
        """Return gains whose outputs stay within the torque limit at standstill, at a supply voltage [V].

        The velocity loop may add the duty for a speed up to the limit; the position loop has what :meth:`bounded`
        leaves. The torque loop has the limit alone, so it reaches no speed that direct PWM would not.
        """
        duty = self.effort_limit * self.pwm_per_torque(voltage)
        moving = _START_SHARE * duty + self.back_emf_pwm(self.velocity_limit, voltage)
        gains = self.gains
        return replace(
            gains,
            position=limit_output(gains.position, (1.0 - _START_SHARE) * duty),
            velocity=limit_output(gains.velocity, moving),
            effort=limit_output(gains.effort, duty),
        )

    def _start_velocity(self, voltage: float) -> float:
        """Return the speed setpoint at which the velocity loop spends its share of the limit at standstill [rad/s]."""
        # The firmware may normalise with nominal or present voltage: assume the lower, which gives more duty.
        forward = self.back_emf_pwm(1.0, min(voltage, self.drivetrain.supply_voltage))
        slope = self.gains.velocity.feed_forward * forward + self.gains.velocity.kp
        share = _START_SHARE * self.effort_limit * self.pwm_per_torque(voltage)
        return share / slope if slope > 0.0 else math.inf

    def follow(self, command: Command, feedback: Feedback) -> tuple[Strategy, Command]:
        """Return strategy and setpoints of position control: strategy 3, as in the thesis."""
        return Strategy.PARALLEL_PWM, command

    @property
    def dither(self) -> float:
        """Alternating move of the position setpoint: visible in the duty of a working loop only [rad]."""
        return _DITHER / self.gains.position.kp if self.gains.position.kp > 0.0 else 0.0

    def handover(self, effort: float, pwm: float, velocity: float, motor: MotorState) -> tuple[float, float]:
        """Return offset of position [rad] and velocity setpoint [rad/s] with which strategy 3 takes over a duty.

        Strategy 3 has no PWM feed-forward: its position loop takes over the torque, its velocity loop the back-EMF.
        Effort [N m] and duty [-] are those in force; ``velocity`` is the link's [rad/s].
        """
        gains = self.gains
        if gains.position.kp <= 0.0 or not math.isfinite(pwm):
            return 0.0, 0.0
        duty = (1.0 - _START_SHARE) * self.effort_limit * self.pwm_per_torque(motor.voltage)
        by_position = _clip(effort * self.pwm_per_torque(motor.voltage), -duty, duty)
        slope = gains.velocity.feed_forward * self.back_emf_pwm(1.0, self.drivetrain.supply_voltage)
        total = slope + gains.velocity.kp
        by_velocity = (pwm - by_position + gains.velocity.kp * velocity) / total if total > 0.0 else 0.0
        return by_position / gains.position.kp, by_velocity


def _clip(value: float, low: float, high: float) -> float:
    # NaN ("loop off") passes unchanged.
    return value if math.isnan(value) else min(high, max(low, value))
