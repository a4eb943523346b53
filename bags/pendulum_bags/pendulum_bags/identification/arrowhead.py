"""The linear algebra of a damped Gauss-Newton step on an arrowhead: windows' states eliminated, and found again.

Compiled, since a search takes thousands of steps and each window has blocks of 2 x 2 only: calls of a library cost more
than the arithmetic.

Source: Triggs et al., "Bundle adjustment", 2000, sec. 6 (Schur complement).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pendulum_bags.arrays import Array

__all__ = ["bounded_step", "eliminate", "find_states"]


def bounded_step(system: Array, gradient: Array, values: Array, low: Array, high: Array | float) -> Array:
    """Return the step of a quadratic model within bounds: what would leave them stops there, the others solve again.

    Args:
        system: Damped matrix, shape (k, k).
        gradient: Half of the cost's derivative, shape (k,).
        values: Where the step begins, shape (k,).
        low: Lower bounds, shape (k,).
        high: Upper bounds.
    """
    step = np.linalg.solve(system, -gradient)
    active = np.zeros(step.size, dtype=bool)
    for _ in range(step.size):
        reached = values + step
        outside = ((reached < low) | (reached > high)) & ~active
        if not outside.any():
            break
        step[outside] = np.clip(reached, low, high)[outside] - values[outside]
        active |= outside
        idle = np.flatnonzero(~active)
        right = -(gradient + system @ np.where(active, step, 0.0))[idle]
        step[idle] = np.linalg.solve(system[np.ix_(idle, idle)], right)
    return np.asarray(step)


@njit(cache=True)
def eliminate(
    h_pp: Array, h_px: Array, h_xx: Array, g_p: Array, g_x: Array, damping: float
) -> tuple[Array, Array, Array]:
    """Return the reduced matrix (k, k), the reduced gradient (k,) and the inverse damped state blocks (w, 2, 2).

    Args:
        h_pp: Parameters with parameters, shape (k, k).
        h_px: Parameters with states, shape (w, k, 2).
        h_xx: States with states, shape (w, 2, 2).
        g_p: Gradient of the parameters, shape (k,).
        g_x: Gradient of the states, shape (w, 2).
        damping: Share of the diagonal of the state blocks that is added to it.
    """
    k = g_p.size
    reduced, gradient = h_pp.copy(), g_p.copy()
    inverses = np.zeros(h_xx.shape)
    for n in range(h_xx.shape[0]):
        a = h_xx[n, 0, 0] + damping * (h_xx[n, 0, 0] + 1e-12)
        d = h_xx[n, 1, 1] + damping * (h_xx[n, 1, 1] + 1e-12)
        b = h_xx[n, 0, 1]
        determinant = a * d - b * b
        inverses[n, 0, 0] = d / determinant
        inverses[n, 1, 1] = a / determinant
        inverses[n, 0, 1] = inverses[n, 1, 0] = -b / determinant
        for i in range(k):
            left_0 = h_px[n, i, 0] * inverses[n, 0, 0] + h_px[n, i, 1] * inverses[n, 1, 0]
            left_1 = h_px[n, i, 0] * inverses[n, 0, 1] + h_px[n, i, 1] * inverses[n, 1, 1]
            gradient[i] -= left_0 * g_x[n, 0] + left_1 * g_x[n, 1]
            for j in range(k):
                reduced[i, j] -= left_0 * h_px[n, j, 0] + left_1 * h_px[n, j, 1]
    return reduced, gradient, inverses


@njit(cache=True)
def find_states(h_px: Array, h_xx: Array, g_x: Array, inverses: Array, d_p: Array) -> tuple[Array, float]:
    """Return the step of the states (w, 2) that belongs to one of the parameters, and the decrease it adds.

    Args:
        h_px: Parameters with states, shape (w, k, 2).
        h_xx: States with states, undamped, shape (w, 2, 2).
        g_x: Gradient of the states, shape (w, 2).
        inverses: Of the damped state blocks, shape (w, 2, 2).
        d_p: Step of the parameters, shape (k,).
    """
    steps = np.zeros(g_x.shape)
    decrease = 0.0
    for n in range(g_x.shape[0]):
        coupled_0, coupled_1 = 0.0, 0.0
        for i in range(d_p.size):
            coupled_0 += h_px[n, i, 0] * d_p[i]
            coupled_1 += h_px[n, i, 1] * d_p[i]
        right_0, right_1 = -(g_x[n, 0] + coupled_0), -(g_x[n, 1] + coupled_1)
        s_0 = inverses[n, 0, 0] * right_0 + inverses[n, 0, 1] * right_1
        s_1 = inverses[n, 1, 0] * right_0 + inverses[n, 1, 1] * right_1
        steps[n, 0], steps[n, 1] = s_0, s_1
        decrease -= 2.0 * ((g_x[n, 0] + coupled_0) * s_0 + (g_x[n, 1] + coupled_1) * s_1)
        decrease -= h_xx[n, 0, 0] * s_0 * s_0 + 2.0 * h_xx[n, 0, 1] * s_0 * s_1 + h_xx[n, 1, 1] * s_1 * s_1
    return steps, decrease
