"""Tuning of the PID controller on the plant's model, for a fair comparison with LQR.

Numerical tuning minimises the LQR's cost over the three gains of a PID on the angle alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.analysis import last_to_hold
from pendulum_lqr.linear.design import DesignError, cost_matrices
from pendulum_lqr.linear.model import LinearModel, low_frequency
from pendulum_lqr.linear.sampled_design import discretise

__all__ = ["PidGains", "pid_cost", "pid_loop", "tune_numerically", "ultimate_gain", "ziegler_nichols"]

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PidGains:
    """Gains of u = -(k_p e + k_i integral of e + k_d de/dt) [N m/rad, N m/(rad s), N m s/rad]."""

    kp: float
    ki: float
    kd: float


def pid_loop(model: LinearModel, gains: PidGains, period: float, filter_time: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return (A, B, F) of the sampled closed loop z[k+1] = A z[k] + B w[k], u[k] = F z[k].

    The state is [that of the sampled plant, integral, previous angle, previous filtered derivative]; w is a disturbing
    torque, held like the controller's. ``period`` and ``filter_time`` of the derivative in [s].
    """
    sampled = discretise(model, period)
    pole = math.exp(-period / filter_time)
    slope = (1.0 - pole) / period
    # d[k] = pole d[k-1] + slope (e[k] - e[k-1]);  I[k] = I[k-1] + period e[k]
    n = sampled.A.shape[0]
    derivative, integral = np.zeros(n + 3), np.zeros(n + 3)
    derivative[[0, n + 1, n + 2]] = slope, -slope, pole
    integral[[0, n]] = period, 1.0
    F = -(gains.kp * np.eye(n + 3)[0] + gains.ki * integral + gains.kd * derivative)
    A = np.zeros((n + 3, n + 3))
    A[:n, :n] = sampled.A
    A[:n] += sampled.B @ F[None, :]
    A[n] = integral
    A[n + 1, 0] = 1.0
    A[n + 2] = derivative
    B = np.zeros((n + 3, 1))
    B[:n] = sampled.B
    return A, B, F


def pid_cost(model: LinearModel, gains: PidGains, period: float, filter_time: float, q: ArrayLike, r: float) -> float:
    """Return the LQR cost of a PID loop, for a release from 0.1 rad plus a step of 1 N m; inf if unstable or k_i = 0.

    Both count x' Q x + R (u - u_end)^2 per second with the final torque u_end: otherwise any integral action would cost
    infinitely much under a constant load.
    """
    Q, R = cost_matrices(q, r)
    A, B, F = pid_loop(model, gains, period, filter_time)
    if gains.ki <= 0.0 or float(np.max(np.abs(np.linalg.eigvals(A)))) >= 1.0 - 1e-9:
        return math.inf
    size = A.shape[0]
    weight = np.zeros((size, size))
    weight[:2, :2] = Q
    weight += R[0, 0] * np.outer(F, F)
    S = scipy.linalg.solve_discrete_lyapunov(A.T, weight) * period
    # The derivative starts at rest: the previous sample had the same angle.
    release = np.zeros(size)
    release[[0, size - 2]] = 0.1
    if "motor_angle" in model.states:
        release[model.states.index("motor_angle")] = 0.1
    rest = scipy.linalg.solve(np.eye(size) - A, B[:, 0])
    return float(release @ S @ release + rest @ S @ rest)


def tune_numerically(model: LinearModel, period: float, filter_time: float, q: ArrayLike, r: float) -> PidGains:
    """Return the gains of least :func:`pid_cost`, by Nelder and Mead on their logarithms from several starts.

    Raises:
        DesignError: No start leads to a stable loop.
    """

    def cost(logarithms: NDArray[np.float64]) -> float:
        if np.max(np.abs(logarithms)) > 25.0:
            return 1e12
        value = pid_cost(model, PidGains(*np.exp(logarithms)), period, filter_time, q, r)
        return value if math.isfinite(value) else 1e12

    inertia, own_damping, stiffness = low_frequency(model)
    lift = max(-stiffness, 0.0)
    starts = []
    for rate in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        damping = max(own_damping, 2.0 * inertia * rate)
        kp = lift + rate * damping
        # For an overdamped plant, start with a derivative far below its own damping.
        kd = max(damping - own_damping, 1e-3 * damping)
        starts.append(np.log([kp, 0.3 * rate * kp, kd]))
    start = min(starts, key=cost)
    best = scipy.optimize.minimize(
        cost, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-9, "maxiter": 1000}
    )
    if best.fun >= 1e12:
        raise DesignError(f"no stable PID found at a period of {period} s; expected a shorter period or a slower plant")
    return PidGains(*(float(value) for value in np.exp(best.x)))


def ultimate_gain(model: LinearModel, period: float) -> tuple[float, float]:
    """Return (K_u, T_u): the proportional gain at which the sampled loop oscillates persistently, and its period [s].

    Raises:
        DesignError: No proportional gain stabilises the plant, or none makes it oscillate.
    """
    sampled = discretise(model, period)
    size = sampled.A.shape[0]

    def poles(gain: float) -> NDArray[np.complex128]:
        return np.asarray(np.linalg.eigvals(sampled.A - gain * sampled.B @ np.eye(1, size)), dtype=np.complex128)

    def stable(gain: float) -> bool:
        return bool(np.max(np.abs(poles(gain))) < 1.0)

    low = max(-low_frequency(model)[2], 0.0) * 1.001 + 1e-9
    if not stable(low * 1.01):
        raise DesignError(
            f"no proportional gain stabilises the loop at a period of {period} s; expected a shorter period"
        )
    high = low * 1.01
    while stable(high):
        high *= 1.05
        if high > 1e9:
            raise DesignError("no proportional gain makes the loop oscillate; expected numerical tuning instead")
    _, high = last_to_hold(stable, high / 1.05, high)
    angle = abs(float(np.angle(poles(high)[np.argmax(np.abs(poles(high)))])))
    return high, 2.0 * math.pi * period / angle


def ziegler_nichols(model: LinearModel, period: float) -> PidGains:
    """Return the classic gains K_p = 0.6 K_u, T_i = T_u / 2, T_d = T_u / 8; DesignError as :func:`ultimate_gain`.

    Source: Ziegler and Nichols, Transactions of the ASME 64, 1942, p. 759.
    """
    gain, oscillation = ultimate_gain(model, period)
    kp = 0.6 * gain
    return PidGains(kp, kp / (0.5 * oscillation), kp * 0.125 * oscillation)
