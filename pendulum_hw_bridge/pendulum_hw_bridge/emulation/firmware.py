"""Firmware of the X5-9: PID loops and control strategies 0 to 4, in cycles of 1 ms.

Scalar code on arrays, compiled by :mod:`.kernel`. Gains are rows of 14 numbers in the order of
:data:`pendulum_hw_bridge.port.gains.GAIN_FIELDS`; the memory of a loop is a row of 5. Source: HEBI documentation,
"Control strategies" and "Gains".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pendulum_hw_bridge.port.gains import GAIN_FIELDS, LOOPS, GainSet

__all__ = [
    "CONTROL_PERIOD",
    "EFFORT",
    "POSITION",
    "VELOCITY",
    "Array",
    "control_pwm",
    "gain_rows",
    "new_loop_memory",
    "pid_step",
]

Array = NDArray[np.float64]

CONTROL_PERIOD = 1e-3
"""Cycle of the firmware's loops [s]."""

POSITION, VELOCITY, EFFORT = 0, 1, 2
_KP, _KI, _KD, _FF, _DEAD_ZONE, _I_CLAMP, _PUNCH = 0, 1, 2, 3, 4, 5, 6
_MIN_TARGET, _MAX_TARGET, _TARGET_LP, _MIN_OUT, _MAX_OUT, _OUT_LP, _D_ON_ERROR = 7, 8, 9, 10, 11, 12, 13
_M_TARGET, _M_INTEGRAL, _M_PREVIOUS, _M_OUTPUT, _M_RUNNING = 0, 1, 2, 3, 4


def gain_rows(gains: GainSet) -> Array:
    """Return the gains of the three loops as an array (3, 14)."""
    return np.array([[float(getattr(gains.loop(loop), name)) for name in GAIN_FIELDS] for loop in LOOPS])


def new_loop_memory() -> Array:
    """Return the memory of three loops that have never run, (3, 5)."""
    return np.zeros((3, 5))


def pid_step(
    gains: Array, memory: Array, loop: int, target: float, measured: float, normaliser: float, period: float
) -> float:
    """Return the output of one PID loop after one cycle; a NaN target switches the loop off and resets it.

    out = kp e + ki int e + kd e' + ff target normaliser + punch sgn e, clamped, low-passed.

    Args:
        gains: (3, 14), see :func:`gain_rows`.
        memory: (3, 5), changed in place.
        loop: Row.
        target: Setpoint [input].
        measured: Measurement [input].
        normaliser: Output per input of the feed-forward.
        period: Cycle [s].
    """
    if math.isnan(target):
        for index in range(5):
            memory[loop, index] = 0.0
        return 0.0
    clamped = min(max(target, gains[loop, _MIN_TARGET]), gains[loop, _MAX_TARGET])
    running = memory[loop, _M_RUNNING] != 0.0
    if running:
        weight = gains[loop, _TARGET_LP]
        clamped = weight * clamped + (1.0 - weight) * memory[loop, _M_TARGET]
    memory[loop, _M_TARGET] = clamped
    error = clamped - measured
    if abs(error) <= gains[loop, _DEAD_ZONE]:
        error = 0.0
    integral = memory[loop, _M_INTEGRAL] + gains[loop, _KI] * error * period
    limit = gains[loop, _I_CLAMP]
    integral = min(max(integral, -limit), limit)
    memory[loop, _M_INTEGRAL] = integral
    changing = error if gains[loop, _D_ON_ERROR] != 0.0 else -measured
    derivative = (changing - memory[loop, _M_PREVIOUS]) / period if running else 0.0
    memory[loop, _M_PREVIOUS] = changing
    output = gains[loop, _KP] * error + integral + gains[loop, _KD] * derivative
    output += gains[loop, _FF] * clamped * normaliser
    if error > 0.0:
        output += gains[loop, _PUNCH]
    elif error < 0.0:
        output -= gains[loop, _PUNCH]
    output = min(max(output, gains[loop, _MIN_OUT]), gains[loop, _MAX_OUT])
    if running:
        weight = gains[loop, _OUT_LP]
        output = weight * output + (1.0 - weight) * memory[loop, _M_OUTPUT]
    memory[loop, _M_OUTPUT] = output
    memory[loop, _M_RUNNING] = 1.0
    return output


def control_pwm(
    strategy: int,
    gains: Array,
    memory: Array,
    setpoints: Array,
    position: float,
    velocity: float,
    effort: float,
    effort_normaliser: float,
    velocity_normaliser: float,
    period: float,
) -> float:
    """Return the PWM duty of a strategy, -1 to 1 [-].

    Args:
        strategy: 0 off; 1 direct PWM (``setpoints[EFFORT]`` is the duty); 2 effort loop around torque plus outputs of
            position and velocity loops; 3 three loops, each giving PWM, clipped and added; 4 effort loop around torque
            plus output of the position loop, plus a velocity loop giving PWM.
        gains: (3, 14).
        memory: (3, 5), changed in place.
        setpoints: Position [rad], velocity [rad/s], effort [N m] or PWM; NaN for a loop that is off.
        position: Measured [rad].
        velocity: Measured [rad/s].
        effort: Measured [N m].
        effort_normaliser: R / (N V K_t eta), PWM per torque [1/(N m)].
        velocity_normaliser: N / (K_v V), PWM per velocity [s/rad].
        period: Cycle [s].
    """
    pwm = 0.0
    if strategy == 1:
        pwm = 0.0 if math.isnan(setpoints[EFFORT]) else setpoints[EFFORT]
    elif strategy in (2, 4):
        from_position = pid_step(gains, memory, POSITION, setpoints[POSITION], position, 0.0, period)
        from_velocity = pid_step(gains, memory, VELOCITY, setpoints[VELOCITY], velocity, velocity_normaliser, period)
        all_off = math.isnan(setpoints[EFFORT]) and math.isnan(setpoints[POSITION])
        if strategy == 2:
            all_off = all_off and math.isnan(setpoints[VELOCITY])
        torque = 0.0 if math.isnan(setpoints[EFFORT]) else setpoints[EFFORT]
        torque += from_position
        if strategy == 2:
            torque += from_velocity
        target = math.nan if all_off else torque
        pwm = pid_step(gains, memory, EFFORT, target, effort, effort_normaliser, period)
        if strategy == 4:
            pwm += from_velocity
    elif strategy == 3:
        pwm = pid_step(gains, memory, POSITION, setpoints[POSITION], position, 0.0, period)
        pwm += pid_step(gains, memory, VELOCITY, setpoints[VELOCITY], velocity, velocity_normaliser, period)
        pwm += pid_step(gains, memory, EFFORT, setpoints[EFFORT], effort, effort_normaliser, period)
    return min(max(pwm, -1.0), 1.0)
