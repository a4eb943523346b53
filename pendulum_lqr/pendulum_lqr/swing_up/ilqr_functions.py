"""Compiled dynamics and cost of a mechanism for iterative LQR, with derivatives, on given arrays.

Derivatives are by complex step; the Hessian of far(q) is by differences of its exact slope.
"""

from __future__ import annotations

import cmath
from types import FunctionType
from typing import Any

import numba
import numpy as np

from pendulum_lqr.swing_up.small_matrices import keep_convex
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.loops.trees import WITHIN, tuple_loader
from pendulum_msgs_py.mechanisms import Mechanism

__all__ = ["cost_functions", "step_functions"]

_SOFTNESS = 0.1
"""c: share of missing potential energy at which far(q) is about one half."""
_POWER_CORNER = 0.05
"""Rounding of the corner of |power| [W]."""
_TINY = 2.0**-64
"""Imaginary step."""


def step_functions(mechanism: Mechanism, driven: tuple[int, ...]) -> Any:
    """Return compiled (advance, derive): the next node from z and u, and the derivatives of that step.

    ``advance(z, u, h, p, work, out)`` fills ``out``; ``derive(z, u, h, p, work, zc, A, B)`` fills zeroed A, shape (2n +
    m, 2n + m), and B (2n + m, m). ``work``, shape (3, n), and ``zc`` are scratch, complex for ``derive``.
    """
    n, m = len(mechanism.joints), len(driven)
    size = 2 * n + m
    where = np.array(driven)
    along = numba.njit(along_functions(n), **WITHIN)
    pick = tuple_loader(n, 1)
    # Inlined: machine code without function arguments can be cached on disk.
    rk4 = numba.njit(_fresh(rk4_joints), forceinline=True, **WITHIN)
    forward = numba.njit(_fresh(mechanism.forward), error_model="numpy", **WITHIN)
    forward_c = numba.njit(in_arithmetic(mechanism.forward, cmath), error_model="numpy", **WITHIN)

    @numba.njit(error_model="numpy", **WITHIN)
    def advance(z: Any, u: Any, h: float, p: Any, work: Any, out: Any) -> None:
        for i in range(n):
            work[0, i] = 0.0
            work[1, i] = 0.0
        for j in range(m):
            work[0, where[j]] = z[2 * n + j]
            work[1, where[j]] = u[j]
        for i in range(n):
            work[2, i] = 0.5 * (work[0, i] + work[1, i])
        q, v = rk4(forward, along, pick(z, 0), pick(z, n), pick(work[0], 0), pick(work[2], 0), pick(work[1], 0), h, p)
        for i in range(n):
            out[i] = q[i]
            out[n + i] = v[i]
        for j in range(m):
            out[2 * n + j] = u[j]

    @numba.njit(error_model="numpy", **WITHIN)
    def derive(z: Any, u: Any, h: float, p: Any, work: Any, zc: Any, A: Any, B: Any) -> None:
        """Fill A (size, size) and B (size, m)."""
        for column in range(size + m):
            for i in range(size):
                zc[i] = z[i]
            for i in range(n):
                work[0, i] = 0.0
                work[1, i] = 0.0
            for j in range(m):
                work[1, where[j]] = u[j]
            if column < size:
                zc[column] += 1j * _TINY
            else:
                work[1, where[column - size]] += 1j * _TINY
            for j in range(m):
                work[0, where[j]] = zc[2 * n + j]
            for i in range(n):
                work[2, i] = 0.5 * (work[0, i] + work[1, i])
            q, v = rk4(
                forward_c, along, pick(zc, 0), pick(zc, n), pick(work[0], 0), pick(work[2], 0), pick(work[1], 0), h, p
            )
            for i in range(n):
                if column < size:
                    A[i, column] = q[i].imag / _TINY
                    A[n + i, column] = v[i].imag / _TINY
                else:
                    B[i, column - size] = q[i].imag / _TINY
                    B[n + i, column - size] = v[i].imag / _TINY
        for j in range(m):
            B[2 * n + j, j] = 1.0

    return advance, derive


def cost_functions(mechanism: Mechanism, driven: tuple[int, ...]) -> Any:
    """Return compiled (stage, expand, final, final_slopes): the cost of an interval and of the end, and derivatives.

    Weights ``w`` are in the order of ``IlqrWeights``; ``scale`` is the potential energy hanging, and its increase to
    upright [J].
    """
    n, m = len(mechanism.joints), len(driven)
    turns = np.array([joint.turns for joint in mechanism.joints])
    where = np.array(driven)
    pick = tuple_loader(n, 1)
    potential = numba.njit(_fresh(mechanism.potential), error_model="numpy", **WITHIN)
    potential_c = numba.njit(in_arithmetic(mechanism.potential, cmath), error_model="numpy", **WITHIN)

    @numba.njit(error_model="numpy", **WITHIN)
    def missing(q: Any, p: Any, goal: Any, scale: Any) -> float:
        e = 1.0 - (potential(pick(q, 0), p) - scale[0]) / scale[1]
        for i in range(n):
            if not turns[i]:
                e += (q[i] - goal[i]) ** 2
        return e

    @numba.njit(error_model="numpy", **WITHIN)
    def far_slope(q: Any, p: Any, goal: Any, scale: Any, qc: Any, out: Any) -> None:
        outer = (1.0 + _SOFTNESS) * _SOFTNESS / (missing(q, p, goal, scale) + _SOFTNESS) ** 2
        for i in range(n):
            for j in range(n):
                qc[j] = q[j]
            qc[i] += 1j * _TINY
            slope = -potential_c(pick(qc, 0), p).imag / _TINY / scale[1]
            if not turns[i]:
                slope += 2.0 * (q[i] - goal[i])
            out[i] = outer * slope

    @numba.njit(error_model="numpy", **WITHIN)
    def stage(z: Any, u: Any, h: float, p: Any, goal: Any, scale: Any, w: Any) -> float:
        power, squares, change, speed = 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            power += abs(np.sqrt((z[2 * n + j] * z[n + where[j]]) ** 2 + _POWER_CORNER**2) - _POWER_CORNER)
            squares += z[2 * n + j] ** 2
            change += (u[j] - z[2 * n + j]) ** 2
        for i in range(n):
            speed += z[n + i] ** 2
        e = missing(z, p, goal, scale)
        far = (1.0 + _SOFTNESS) * e / (e + _SOFTNESS)
        return h * (w[0] * far + w[1] * power + w[2] * squares + w[4] * speed) + w[3] * change / h

    @numba.njit(error_model="numpy", **WITHIN)
    def deviation(z: Any, goal: Any, out: Any) -> None:
        for i in range(n):
            out[i] = z[i] - goal[i]
            if turns[i]:
                out[i] -= 2.0 * np.pi * np.rint(out[i] / (2.0 * np.pi))
            out[n + i] = z[n + i]

    @numba.njit(error_model="numpy", **WITHIN)
    def final(z: Any, goal: Any, S: Any, w: Any, d: Any) -> float:
        deviation(z, goal, d)
        total = 0.0
        for i in range(2 * n):
            for j in range(2 * n):
                total += d[i] * S[i, j] * d[j]
        return w[5] * total

    @numba.njit(error_model="numpy", **WITHIN)
    def final_slopes(z: Any, goal: Any, S: Any, w: Any, d: Any, Vz: Any, Vzz: Any) -> None:
        deviation(z, goal, d)
        Vz[:] = 0.0
        Vzz[:] = 0.0
        for i in range(2 * n):
            for j in range(2 * n):
                Vz[i, 0] += 2.0 * w[5] * S[i, j] * d[j]
                Vzz[i, j] = 2.0 * w[5] * S[i, j]

    @numba.njit(error_model="numpy", **WITHIN)
    def expand(
        z: Any, u: Any, h: float, p: Any, goal: Any, scale: Any, w: Any, qc: Any, slopes: Any, lz: Any, lu: Any,
        lzz: Any, luu: Any, luz: Any,
    ) -> None:  # fmt: skip
        lz[:] = 0.0
        lzz[:] = 0.0
        luz[:] = 0.0
        luu[:] = 0.0
        far_slope(z, p, goal, scale, qc, slopes[0])
        for i in range(n):
            lz[i, 0] = h * w[0] * slopes[0, i]
        # Hessian of far by differences of its exact slope, then its convex part.
        for i in range(n):
            keep = z[i]
            z[i] = keep + 1e-5
            far_slope(z, p, goal, scale, qc, slopes[1])
            z[i] = keep - 1e-5
            far_slope(z, p, goal, scale, qc, slopes[2])
            z[i] = keep
            for j in range(n):
                lzz[i, j] = h * w[0] * (slopes[1, j] - slopes[2, j]) / 2e-5
        keep_convex(lzz, n)
        for i in range(n):
            lz[n + i, 0] = 2.0 * h * w[4] * z[n + i]
            lzz[n + i, n + i] = 2.0 * h * w[4]
        for j in range(m):
            e, s = 2 * n + j, n + where[j]
            product = z[e] * z[s]
            root = np.sqrt(product * product + _POWER_CORNER**2)
            lz[e, 0] = h * w[1] * product / root * z[s] + 2.0 * h * w[2] * z[e] - 2.0 * w[3] * (u[j] - z[e]) / h
            lz[s, 0] += h * w[1] * product / root * z[e]
            # For |power|, the convex part of the product's square.
            lzz[e, e] = h * w[1] * z[s] * z[s] / root + 2.0 * h * w[2] + 2.0 * w[3] / h
            lzz[s, s] += h * w[1] * z[e] * z[e] / root
            lzz[e, s] += h * w[1] * product / root
            lzz[s, e] += h * w[1] * product / root
            lu[j, 0] = 2.0 * w[3] * (u[j] - z[e]) / h
            luu[j, j] = 2.0 * w[3] / h
            luz[j, e] = -2.0 * w[3] / h

    return stage, expand, final, final_slopes


def _fresh(function: Any) -> Any:
    """Return a copy of a function, so that numba's cache of it is this kernel's own."""
    return FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__)
