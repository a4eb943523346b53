"""How a wanted joint torque becomes a setpoint of the firmware: the strategy is part of the plant.

Three ways, by the parameter ``effort_strategy``:

``direct_pwm``
    u = tau R / (eta N V K_t): feed-forward only, the duty that makes the torque at standstill. The motor's back-EMF
    stays in the plant as its damping; the thesis's b_c holds for this one.
``direct_pwm_compensated``
    u = (tau R / (eta N K_t) + c K_e N q') / V: the back-EMF is fed forward too, and with it most of b_c is gone.
``effort_loop``
    The firmware's own torque loop (strategy 3, effort setpoint alone) takes most of b_c away by feedback.

V is the measured supply voltage. Whatever the way, :meth:`EffortMapping.bounded` keeps what is sent inside the effort
limit, and :meth:`EffortMapping.limited_gains` the firmware's own loops.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.port.actuator import PEAK_EFFORT, Command, Strategy
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet, limit_output
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["EffortMapping", "EffortStrategy"]

_START_SHARE = 0.3
"""Share of the effort limit that position control may spend on a speed which is not there yet [-]."""
_DITHER = 4.5e-4
"""Duty that position control adds and takes away in turn, two of the firmware's steps: 0.02 N m of an X5-9 [-]."""


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
        gains: Gains of the firmware's loops under strategy 3.
        effort_limit: Largest torque that a setpoint may stand for [N m].
        velocity_limit: Largest speed that position control may be asked for [rad/s].
        joint: The joint that is moved, whose units messages have.
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
        """Refuse constants that would make the torque meaningless."""
        if not 0.0 < self.efficiency <= 1.0:
            raise ParameterError(f"effort_efficiency is {self.efficiency}; expected > 0 and <= 1")
        if not 0.0 <= self.compensation <= 1.0:
            raise ParameterError(f"back_emf_compensation is {self.compensation}; expected 0 to 1")
        if not (math.isfinite(self.effort_limit) and self.effort_limit > 0.0):
            unit = self.joint.effort_unit
            raise ParameterError(f"effort_limit is {self.effort_limit} {unit}; expected a finite number > 0")

    @property
    def strategy(self) -> Strategy:
        """Strategy of the firmware under which the torque is made."""
        return Strategy.PARALLEL_PWM if self.kind is EffortStrategy.EFFORT_LOOP else Strategy.DIRECT_PWM

    def pwm_per_torque(self, voltage: float | None = None) -> float:
        """Return the duty for one newton metre at standstill, R / (eta N V K_t) [1/(N m)].

        Args:
            voltage: Supply voltage V; None for the drivetrain's nominal one [V].
        """
        drive = self.drivetrain
        supply = drive.supply_voltage if voltage is None else voltage
        return drive.winding_resistance / (self.efficiency * drive.gear_ratio * supply * drive.torque_constant)

    def back_emf_pwm(self, velocity: float, voltage: float) -> float:
        """Return the duty that a speed at the output takes up, K_e N q' / V [-]."""
        return self.drivetrain.back_emf_constant * self.drivetrain.gear_ratio * velocity / voltage

    def motor_effort(self, pwm: float, velocity: float, voltage: float) -> float:
        """Return the torque at the joint that a duty makes at a motor speed, (u V - K_e N q') K_t N eta / R [N m]."""
        return (pwm - self.back_emf_pwm(velocity, voltage)) / self.pwm_per_torque(voltage)

    def largest_effort(self, speed: float) -> float:
        """Return the largest torque of the motor at a speed of the joint [rad/s]: limit and braking [N m].

        It drives with the limit at most. A motor that turns brakes without any duty, and a duty that opposes the motion
        adds to that; no setpoint takes it away.
        """
        return self.effort_limit + abs(self.motor_effort(0.0, speed, self.drivetrain.supply_voltage))

    # --- effort control -------------------------------------------------------------------------------------

    def command(self, effort: float, motor: MotorState) -> Command:
        """Return the setpoints for a wanted torque [N m]."""
        if self.kind is EffortStrategy.EFFORT_LOOP:
            return Command(effort=effort)
        return Command(pwm=effort * self.pwm_per_torque(motor.voltage) + self._compensated_pwm(motor))

    def effort_of(self, command: Command, motor: MotorState, pwm_in_force: float) -> float:
        """Return the torque that setpoints stand for: the inverse of :meth:`command`, after limits [N m].

        Args:
            command: The setpoints.
            motor: As they were made for.
            pwm_in_force: Duty that the firmware reports; what counts under position control [-].
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

    # --- limits ---------------------------------------------------------------------------------------------

    def bounded(self, command: Command, motor: MotorState) -> Command:
        """Return setpoints that make no more torque than the limit, as far as one sensor at least tells the truth.

        Args:
            command: The setpoints.
            motor: Supply and motor speed.
        """
        limit = self.effort_limit
        duty = limit * self.pwm_per_torque(motor.voltage)
        emf = self.back_emf_pwm(1.0, motor.voltage) if self.kind is not EffortStrategy.DIRECT_PWM else 0.0
        low, high = max(-1.0, -duty + emf * motor.lowest), min(1.0, duty + emf * motor.highest)
        # A speed costs duty. Given in advance, a blocked link would get it as torque: only so much more than there is.
        start = self._start_velocity(motor.voltage)
        return replace(
            command,
            effort=_clip(command.effort, -limit, limit),
            pwm=_clip(command.pwm, low, high),
            velocity=_clip(command.velocity, motor.lowest - start, motor.highest + start),
        )

    def limited_gains(self, voltage: float) -> GainSet:
        """Return the gains with outputs that make no more torque than the limit at standstill, at a supply voltage [V].

        The position loop has what :meth:`bounded` leaves it beside the velocity loop, which may add what a speed up
        to the limit takes. The torque loop has the limit, and so reaches no speed that direct PWM would not.
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
        """Return the speed for which the velocity loop puts out its share of the limit at standstill [rad/s]."""
        # The firmware may normalise with the nominal voltage or with the present one: the lower makes more duty.
        forward = self.back_emf_pwm(1.0, min(voltage, self.drivetrain.supply_voltage))
        slope = self.gains.velocity.feed_forward * forward + self.gains.velocity.kp
        share = _START_SHARE * self.effort_limit * self.pwm_per_torque(voltage)
        return share / slope if slope > 0.0 else math.inf

    @property
    def dither(self) -> float:
        """Move of the position setpoint that shows in the duty of a loop that works, and nowhere else [rad]."""
        return _DITHER / self.gains.position.kp if self.gains.position.kp > 0.0 else 0.0

    # --- hand-over ------------------------------------------------------------------------------------------

    def handover(self, effort: float, pwm: float, velocity: float, motor: MotorState) -> tuple[float, float]:
        """Return offsets of position [rad] and velocity setpoint [rad/s] with which strategy 3 begins at a duty.

        Strategy 3 has no input for a feed-forward of PWM: its position loop takes the torque, its velocity loop what
        the speed adds to it.

        Args:
            effort: Torque in force [N m].
            pwm: Duty in force [-].
            velocity: Measured speed of the link [rad/s].
            motor: Supply and motor speed.
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
    # NaN ("loop off") stays what it is.
    return value if math.isnan(value) else min(high, max(low, value))
