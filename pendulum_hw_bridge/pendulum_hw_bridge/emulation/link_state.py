"""What link and motor of an emulated actuator really do."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["LinkState"]


@dataclass(frozen=True)
class LinkState:
    """The truth behind the feedback.

    Attributes:
        time_ns: Actuator time [ns].
        position: Link angle [rad].
        velocity: [rad/s].
        motor_position: Motor angle at the output side [rad].
        motor_velocity: [rad/s].
        spring_torque: Torque on the link [N m].
        motor_torque: Electromagnetic torque at the output side [N m].
        pwm: Duty on the motor [-].
        winding_temperature: [degC].
    """

    time_ns: int
    position: float
    velocity: float
    motor_position: float
    motor_velocity: float
    spring_torque: float
    motor_torque: float
    pwm: float
    winding_temperature: float
