"""Sensors of the emulated actuator: noise, resolution and firmware flags."""

from __future__ import annotations

import math

import numpy as np

from pendulum_hw_bridge.emulation.firmware import Array
from pendulum_hw_bridge.emulation.parameters import EmulatorParameters
from pendulum_hw_bridge.port.actuator import Feedback, HardwareLimits, LimitState, TemperatureState
from pendulum_msgs_py.dynamics.series_elastic import spring_torque

__all__ = ["measure"]

_BOARD_RISE = 5.0
_PROCESSOR_RISE = 8.0


def measure(
    state: Array,
    setpoints: Array,
    parameters: EmulatorParameters,
    limits: HardwareLimits,
    voltage: float,
    random: np.random.Generator,
) -> Feedback:
    """Return a feedback record of a kernel state, without times, senders and buttons.

    ``setpoints`` are position, velocity and effort (or PWM); ``voltage`` in [V]. Each record takes the same number of
    draws from ``random``.
    """
    drive, sensors = parameters.drivetrain, parameters.sensors
    motor_position, motor_velocity, position, velocity, _, winding, housing, body, pwm, current = state.tolist()[:10]
    noise = sensors.velocity_noise * float(random.standard_normal())
    deflection_noise = sensors.effort_noise / drive.stiffness * float(random.uniform(-1.0, 1.0))
    deflection = position - motor_position + deflection_noise
    return Feedback(
        stamp_ns=0,
        hardware_ns=0,
        sequence=0,
        position=_step(position, sensors.position_step),
        velocity=velocity + noise,
        # The sensor is the spring without its hysteresis, which makes loading and unloading differ.
        effort=spring_torque(-deflection, 0.0, drive.stiffness, drive.stiffness_hardening, 0.0),
        position_command=float(setpoints[0]),
        velocity_command=float(setpoints[1]),
        effort_command=float(setpoints[2]),
        pwm_command=_step(pwm, sensors.pwm_step),
        motor_current=_step(sensors.idle_current + pwm * current, sensors.motor_current_step),
        winding_current=current,
        motor_position=_step(motor_position * drive.gear_ratio, sensors.motor_position_step),
        motor_velocity=motor_velocity * drive.gear_ratio,
        deflection=deflection,
        deflection_velocity=velocity - motor_velocity,
        voltage=_step(voltage, sensors.voltage_step),
        winding_temperature=winding,
        housing_temperature=housing,
        motor_sensor_temperature=housing,
        board_temperature=body + _BOARD_RISE,
        processor_temperature=body + _PROCESSOR_RISE,
        temperature_state=_temperature_state(winding, parameters),
        position_limit=_limit_state(position, limits.position_min, limits.position_max),
    )


def _temperature_state(winding: float, parameters: EmulatorParameters) -> TemperatureState:
    if winding >= parameters.thermal.max_winding:
        return TemperatureState.EXCEED_MAX_MOTOR
    if winding >= parameters.thermal.critical_winding:
        return TemperatureState.CRITICAL
    return TemperatureState.NORMAL


def _step(value: float, step: float) -> float:
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


def _limit_state(value: float, low: float, high: float) -> LimitState:
    if value < low:
        return LimitState.BELOW
    return LimitState.ABOVE if value > high else LimitState.INSIDE
