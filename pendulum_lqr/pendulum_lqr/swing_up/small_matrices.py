"""Compiled algebra of matrices of a few rows, without the overhead of library calls."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from pendulum_msgs_py.loops.trees import WITHIN

__all__ = ["copy", "eliminate", "keep_convex", "newton", "product"]


@numba.njit(error_model="numpy", fastmath={"contract"}, **WITHIN)
def product(a: Any, b: Any, out: Any, transposed: bool, add: bool) -> None:
    """Fill ``out`` with a b or a' b, or add it."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = out[i, j] if add else 0.0
            for k in range(b.shape[0]):
                total += (a[k, i] if transposed else a[i, k]) * b[k, j]
            out[i, j] = total


@numba.njit(error_model="numpy", **WITHIN)
def copy(source: Any, target: Any) -> None:
    """Copy a matrix, without numpy's shape messages, which take seconds to compile."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@numba.njit(error_model="numpy", fastmath={"contract"}, **WITHIN)
def newton(H: Any, g: Any, low: Any, high: Any, step: Any, free: Any, work: Any) -> None:
    """Fill ``step`` with the minimiser of g' s + s' H s / 2 within limits, and ``free`` with its free entries.

    Entries that Newton's step drives beyond a limit are fixed there, and the others re-solved; exact for one effort.
    """
    m = g.shape[0]
    free[:] = True
    step[:] = 0.0
    for _ in range(m + 1):
        for j in range(m):
            work[j, m] = -g[j]
            for i in range(m):
                work[j, i] = H[j, i] if free[i] else 0.0
                if not free[i]:
                    work[j, m] -= H[j, i] * step[i]
            if not free[j]:
                for i in range(m):
                    work[j, i] = 1.0 if i == j else 0.0
                work[j, m] = step[j]
        eliminate(work, m)
        fixed = False
        for j in range(m):
            wanted = work[j, m]
            if free[j] and not low[j] <= wanted <= high[j]:
                step[j] = low[j] if wanted < low[j] else high[j]
                free[j] = False
                fixed = True
            elif free[j]:
                step[j] = wanted
        if not fixed:
            return


@numba.njit(error_model="numpy", fastmath={"contract"}, **WITHIN)
def eliminate(work: Any, m: int) -> None:
    """Solve a positive definite system, with right-hand sides in the columns from m on, in place."""
    for j in range(m):
        for i in range(m):
            if i != j:
                factor = work[i, j] / work[j, j]
                for c in range(work.shape[1]):
                    work[i, c] -= factor * work[j, c]
    for j in range(m):
        scale = work[j, j]
        for c in range(work.shape[1]):
            work[j, c] /= scale


@numba.njit(error_model="numpy", **WITHIN)
def keep_convex(M: Any, n: int) -> None:
    """Replace the first n rows and columns by the convex part of their symmetric part, in place.

    Of three and more rows the diagonal is raised instead, by what makes it dominant if no less is known (Gershgorin).
    """
    if n == 1:
        M[0, 0] = max(M[0, 0], 0.0)
    elif n > 2:
        lack = 0.0
        for i in range(n):
            rest = M[i, i]
            for j in range(n):
                if i != j:
                    M[i, j] = M[j, i] = 0.5 * (M[i, j] + M[j, i])
                    rest -= abs(M[i, j])
            lack = max(lack, -rest)
        for i in range(n):
            M[i, i] += lack
    else:
        a, b, c = M[0, 0], 0.5 * (M[0, 1] + M[1, 0]), M[1, 1]
        middle, radius = 0.5 * (a + c), np.sqrt((0.5 * (a - c)) ** 2 + b * b)
        high, low = max(middle + radius, 0.0), max(middle - radius, 0.0)
        if radius > 1e-15:
            mean, half = 0.5 * (high + low), 0.5 * (high - low)
            M[0, 0] = mean + half * 0.5 * (a - c) / radius
            M[1, 1] = mean - half * 0.5 * (a - c) / radius
            M[0, 1] = M[1, 0] = half * b / radius
        else:
            M[0, 0] = M[1, 1] = high
            M[0, 1] = M[1, 0] = 0.0
