"""Integrators by name, each one step of theta'' = a(theta, theta', tau) with a known torque.

A step gets the torque at its start, middle and end (exponential with an actuator lag), and the direction of dry
friction, fixed within a step by ``plant``. The exponential methods integrate the fast linear pole exactly: theta'' +
lambda theta' = N(theta, theta', tau) with lambda = b_c / M_c, 214 1/s for the thesis's pendulum. With z = -lambda h,
phi_0 = exp and phi_k+1(z) = (phi_k(z) - 1/k!) / z, the flow of a constant N is::

    theta'(h) = phi_0 theta'_0 + h phi_1 N,   theta(h) = theta_0 + h phi_1 theta'_0 + h^2 phi_2 N

All functions are scalar and use ``math`` only; :mod:`pendulum_sim.batches.compiling` compiles the same ones.

Sources: Cox and Matthews, "Exponential time differencing for stiff systems", J. Comput. Phys. 176, 2002, eq. 26 to 29
(``etd4``) and the exponential midpoint rule (``etd2``); Hairer, Norsett, Wanner, "Solving Ordinary Differential
Equations I", II.1 (RK4) and II.5 (DOP853).
"""

# ruff: noqa: ARG001  (all steps have one signature, and few need every argument)
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError

__all__ = ["INTEGRATORS", "METHODS", "Integrator", "PlantTuple", "get_integrator", "phi_functions"]

PlantTuple = tuple[float, ...]
"""Plant parameters for scalar functions, from ``plant.pack``."""
Coefficients = tuple[float, ...]
Acceleration = Callable[[float, float, float, float, PlantTuple], float]
"""a(theta, theta_dot, torque, direction, plant) [rad/s^2]."""
Step = Callable[
    [Acceleration, float, float, float, float, float, float, float, Coefficients, PlantTuple], tuple[float, float]
]


@dataclass(frozen=True)
class Integrator:
    """One method, with the order of its global error and one sentence of description.

    ``step(acceleration, theta, theta_dot, torque_0, torque_mid, torque_1, direction, h, c, plant)`` returns (theta,
    theta_dot) after h, ``coefficients(damping_rate, h)`` the numbers ``c``, which depend on the step only.
    """

    name: str
    order: int
    step: Step
    coefficients: Callable[[float, float], Coefficients]
    description: str


def phi_functions(z: float) -> tuple[float, float, float, float, float]:
    """Return phi_0 to phi_4 at z = -lambda h <= 0 to full precision.

    The recurrence loses digits near 0; there the series of phi_4 converges in a few terms, and the recurrence runs
    downwards.
    """
    if abs(z) < 1.0:
        term = 1.0 / 24.0
        phi_4 = term
        for n in range(5, 24):
            term *= z / n
            phi_4 += term
        phi_3 = z * phi_4 + 1.0 / 6.0
        phi_2 = z * phi_3 + 0.5
        phi_1 = z * phi_2 + 1.0
        return z * phi_1 + 1.0, phi_1, phi_2, phi_3, phi_4
    phi_0 = math.exp(z)
    phi_1 = (phi_0 - 1.0) / z
    phi_2 = (phi_1 - 1.0) / z
    phi_3 = (phi_2 - 0.5) / z
    return phi_0, phi_1, phi_2, phi_3, (phi_3 - 1.0 / 6.0) / z


def no_coefficients(damping_rate: float, h: float) -> Coefficients:
    """Return (lambda, h), for methods that need no others."""
    return (damping_rate, h)


def euler_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Explicit Euler, as the thesis integrates: both derivatives at the start of the step."""
    slope = acceleration(theta, theta_dot, torque_0, direction, plant)
    return theta + h * theta_dot, theta_dot + h * slope


def semi_implicit_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Semi-implicit Euler with implicit damping: stable at any h, and symplectic without friction."""
    damping_rate = c[0]
    undamped = acceleration(theta, theta_dot, torque_0, direction, plant) + damping_rate * theta_dot
    theta_dot = (theta_dot + h * undamped) / (1.0 + h * damping_rate)
    return theta + h * theta_dot, theta_dot


def rk4_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Classical Runge-Kutta of order four."""
    half = 0.5 * h
    a_1 = acceleration(theta, theta_dot, torque_0, direction, plant)
    v_2 = theta_dot + half * a_1
    a_2 = acceleration(theta + half * theta_dot, v_2, torque_mid, direction, plant)
    v_3 = theta_dot + half * a_2
    a_3 = acceleration(theta + half * v_2, v_3, torque_mid, direction, plant)
    v_4 = theta_dot + h * a_3
    a_4 = acceleration(theta + h * v_3, v_4, torque_1, direction, plant)
    sixth = h / 6.0
    return (theta + sixth * (theta_dot + 2.0 * (v_2 + v_3) + v_4), theta_dot + sixth * (a_1 + 2.0 * (a_2 + a_3) + a_4))


def etd2_coefficients(damping_rate: float, h: float) -> Coefficients:
    """Return lambda and the weights of half and full flow for :func:`etd2_step`."""
    half = 0.5 * h
    e_half, p1_half, p2_half, _, _ = phi_functions(-damping_rate * half)
    e_full, p1_full, p2_full, _, _ = phi_functions(-damping_rate * h)
    return (damping_rate, e_half, half * p1_half, half * half * p2_half, e_full, h * p1_full, h * h * p2_full)


def etd2_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Exponential midpoint rule: exact linear part, N taken in the middle of the step."""
    rate, e_half, p1_half, p2_half, e_full, p1_full, p2_full = c
    n_0 = acceleration(theta, theta_dot, torque_0, direction, plant) + rate * theta_dot
    theta_mid = theta + p1_half * theta_dot + p2_half * n_0
    v_mid = e_half * theta_dot + p1_half * n_0
    n_mid = acceleration(theta_mid, v_mid, torque_mid, direction, plant) + rate * v_mid
    return theta + p1_full * theta_dot + p2_full * n_mid, e_full * theta_dot + p1_full * n_mid


def etd4_coefficients(damping_rate: float, h: float) -> Coefficients:
    """Return lambda, the weights of the half flow and of the final sum for :func:`etd4_step`.

    The top entry of phi_k(hL) [0, 1] is h phi_k+1(z): the angle has the velocity's weights with the next index.
    """
    half = 0.5 * h
    e_half, p1_half, p2_half, _, _ = phi_functions(-damping_rate * half)
    e_full, p_1, p_2, p_3, p_4 = phi_functions(-damping_rate * h)
    return (
        damping_rate,
        e_half,
        half * p1_half,
        half * half * p2_half,
        e_full,
        h * p_1,
        h * (p_1 - 3.0 * p_2 + 4.0 * p_3),
        2.0 * h * (p_2 - 2.0 * p_3),
        h * (4.0 * p_3 - p_2),
        h * h * (p_2 - 3.0 * p_3 + 4.0 * p_4),
        2.0 * h * h * (p_3 - 2.0 * p_4),
        h * h * (4.0 * p_4 - p_3),
    )


def etd4_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Exponential Runge-Kutta of order four (ETDRK4)."""
    rate, e_half, p1_half, p2_half, e_full, p1_full, w_0, w_m, w_1, s_0, s_m, s_1 = c
    n_0 = acceleration(theta, theta_dot, torque_0, direction, plant) + rate * theta_dot
    flow_theta = theta + p1_half * theta_dot
    flow_v = e_half * theta_dot
    theta_a = flow_theta + p2_half * n_0
    v_a = flow_v + p1_half * n_0
    n_a = acceleration(theta_a, v_a, torque_mid, direction, plant) + rate * v_a
    theta_b = flow_theta + p2_half * n_a
    v_b = flow_v + p1_half * n_a
    n_b = acceleration(theta_b, v_b, torque_mid, direction, plant) + rate * v_b
    n_late = 2.0 * n_b - n_0
    theta_c = theta_a + p1_half * v_a + p2_half * n_late
    v_c = e_half * v_a + p1_half * n_late
    n_c = acceleration(theta_c, v_c, torque_1, direction, plant) + rate * v_c
    return (
        theta + p1_full * theta_dot + s_0 * n_0 + s_m * (n_a + n_b) + s_1 * n_c,
        e_full * theta_dot + w_0 * n_0 + w_m * (n_a + n_b) + w_1 * n_c,
    )


def adaptive_step(
    acceleration: Acceleration, theta: float, theta_dot: float, torque_0: float, torque_mid: float, torque_1: float,
    direction: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Adaptive Runge-Kutta of order eight (DOP853) at a relative tolerance of 1e-12; the reference."""
    # Imported late: real-time stepping does not need scipy.
    from scipy.integrate import solve_ivp

    rise = torque_mid - torque_0
    # The torque over a step is constant or an exponential, which its values at three times determine.
    decay = (torque_1 - torque_mid) / rise if rise != 0.0 else 1.0

    def torque(t: float) -> float:
        if decay == 1.0 or decay <= 0.0:
            return torque_0 + rise * 2.0 * t / h
        return torque_0 + rise * (1.0 - decay ** (2.0 * t / h)) / (1.0 - decay)

    def derivative(t: float, x: list[float]) -> tuple[float, float]:
        return x[1], acceleration(x[0], x[1], torque(t), direction, plant)

    solution = solve_ivp(derivative, (0.0, h), [theta, theta_dot], method="DOP853", rtol=1e-12, atol=1e-14)
    return float(solution.y[0, -1]), float(solution.y[1, -1])


INTEGRATORS: Mapping[str, Integrator] = {
    integrator.name: integrator
    for integrator in (
        Integrator("euler", 1, euler_step, no_coefficients, "Explicit Euler, as the thesis integrates."),
        Integrator("semi_implicit", 1, semi_implicit_step, no_coefficients, "Semi-implicit Euler, implicit damping."),
        Integrator("rk4", 4, rk4_step, no_coefficients, "Classical Runge-Kutta of order four."),
        Integrator("etd2", 2, etd2_step, etd2_coefficients, "Exponential midpoint rule, exact linear part."),
        Integrator("etd4", 4, etd4_step, etd4_coefficients, "Exponential Runge-Kutta of order four."),
        Integrator("adaptive", 8, adaptive_step, no_coefficients, "DOP853 of scipy at 1e-12: the reference."),
    )
}
"""All methods; a new one is one step function and one row."""

METHODS = tuple(INTEGRATORS)


def get_integrator(name: str) -> Integrator:
    """Return a method by name; a ParameterError if unknown."""
    if name not in INTEGRATORS:
        raise ParameterError(f"method is {name!r}; expected one of {', '.join(METHODS)}")
    return INTEGRATORS[name]
