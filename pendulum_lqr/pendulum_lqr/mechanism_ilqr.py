"""Iterative LQR for any mechanism, compiled: optimises the efforts over a horizon, with limits, in milliseconds.

The efforts are linear between nodes h apart, and the effort before is part of the state, so that its changes cost::

    z_k = (q_k, v_k, u_k),   q, v by one step of Runge-Kutta from u_k to u_(k+1),   |u| <= limit
    J   = sum h (w_0 far(q) + w_1 |u . v_driven| + w_2 |u|^2 + w_4 |v|^2) + w_3 |u_(k+1) - u_k|^2 / h  +  w_5 dx' S dx

far(q) rises from 0 at the goal to 1: the potential energy that is missing, e, as (1 + c) e / (e + c); joints that slide
add their distance. S is the LQR's, dx the last deviation from the goal, wrapped.

Derivatives of the dynamics come by complex step. Sources: Tassa, Erez and Todorov, Synthesis and stabilization of
complex behaviors through online trajectory optimization, IROS 2012; Tassa, Mansard and Todorov, Control-limited
differential dynamic programming, ICRA 2014.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.small_matrices import copy, eliminate, newton, product
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["IlqrPlan", "IlqrProblem", "IlqrWeights"]

Array = NDArray[np.float64]

_SOFTNESS = 0.1
"""c: share of the potential energy that may be missing where far(q) is half way."""
_POWER_CORNER = 0.05
"""Rounding of the corner of |power| [W]."""


class IlqrWeights(NamedTuple):
    """Weights of the cost.

    Attributes:
        far: Of being away from upright [1/s].
        energy: Of the amount of power [1/J].
        effort: Of squared efforts [1/(N^2 m^2 s)].
        rate: Of squared slopes of the efforts [s/(N^2 m^2)].
        velocity: Of squared velocities [s/rad^2].
        terminal: Of the LQR's cost of the last deviation.
    """

    far: float = 1.0
    energy: float = 0.0
    effort: float = 0.01
    rate: float = 1e-4
    velocity: float = 1e-3
    terminal: float = 1.0


class IlqrPlan(NamedTuple):
    """What iterations made of a guess.

    Attributes:
        states: (q, v, u) at the nodes, shape (N + 1, 2n + m).
        efforts: Efforts at the ends of the intervals, shape (N, m).
        gains: K of the efforts' feedback from (q, v, u), shape (N, m, 2n + m); 0 where nothing was iterated.
        cost: J.
        iterations: Iterations taken.
        converged: Whether the last of them changed J by less than a share of 1e-6.
    """

    states: Array
    efforts: Array
    gains: Array
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class IlqrProblem:
    """The problem of one plant.

    Attributes:
        plant: The plant; dry friction, stops, lag and delay are left out.
        step: Length of an interval, h [s].
        weights: Of the cost.
        terminal: S, shape (2n, 2n).
        limit: Share of the effort limits that may be used.
    """

    plant: MechanismParameters
    step: float
    weights: IlqrWeights
    terminal: Array
    limit: float = 1.0

    def solve(
        self, q: Vector, v: Vector, u: Vector, efforts: Array, iterations: int, around: IlqrPlan | None = None
    ) -> IlqrPlan:
        """Improve a guess.

        Args:
            q: Positions to start from [rad or m].
            v: Velocities.
            u: Efforts at the start, m values.
            efforts: The guess, shape (N, m); not changed.
            iterations: Largest number of iterations; 0 only follows the guess.
            around: A plan whose feedback follows the guess, of as many intervals: on an unstable plant a guess
                that begins a little beside its plan ends anywhere without.
        """
        coordinates = self.plant.coordinates
        n, m = len(q), len(u)
        solve = _kernel(self.plant.mechanism.name, coordinates.driven)
        limits = self.limit * np.array(self.plant.effort_limits)
        Z = np.zeros((len(efforts) + 1, 2 * n + m))
        Z[0] = (*q, *v, *u)
        reference = Z if around is None else around.states
        gains = np.zeros((len(efforts), m, 2 * n + m)) if around is None else around.gains.copy()
        U = np.clip(np.array(efforts, dtype=np.float64).reshape(-1, m), -limits, limits)
        goal = np.array(coordinates.goal)
        low = self.plant.mechanism.potential((0.0,) * n, self.plant.packed)
        high = self.plant.mechanism.potential(coordinates.goal, self.plant.packed)
        cost, count, converged = solve(
            Z, U, reference, gains, self.plant.packed, goal, np.array([low, high - low]), self.step,
            np.array(self.weights, dtype=np.float64), np.ascontiguousarray(self.terminal), limits, iterations,
        )  # fmt: skip
        return IlqrPlan(Z, U, gains, float(cost), int(count), bool(converged))


def _tuple_1(a: Any, i: int) -> Any:
    return (a[i],)


def _tuple_2(a: Any, i: int) -> Any:
    return a[i], a[i + 1]


_TUPLES = {1: _tuple_1, 2: _tuple_2}


@cache
def _kernel(name: str, driven: tuple[int, ...]) -> Any:
    """Return the compiled loop for a mechanism with some joints driven."""
    mechanism = MECHANISMS[name]
    n, m = len(mechanism.joints), len(driven)
    size = 2 * n + m
    turns = np.array([joint.turns for joint in mechanism.joints])
    where = np.array(driven)
    along = numba.njit(along_functions(n))
    pick = numba.njit(_TUPLES[n])
    rk4 = numba.njit(_fresh(rk4_joints))
    forward = numba.njit(_fresh(mechanism.forward), error_model="numpy")
    forward_c = numba.njit(in_arithmetic(mechanism.forward, cmath), error_model="numpy")
    potential = numba.njit(_fresh(mechanism.potential), error_model="numpy")
    potential_c = numba.njit(in_arithmetic(mechanism.potential, cmath), error_model="numpy")
    tiny = 2.0**-64

    @numba.njit(error_model="numpy")
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

    @numba.njit(error_model="numpy")
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
                zc[column] += 1j * tiny
            else:
                work[1, where[column - size]] += 1j * tiny
            for j in range(m):
                work[0, where[j]] = zc[2 * n + j]
            for i in range(n):
                work[2, i] = 0.5 * (work[0, i] + work[1, i])
            q, v = rk4(
                forward_c, along, pick(zc, 0), pick(zc, n), pick(work[0], 0), pick(work[2], 0), pick(work[1], 0), h, p
            )
            for i in range(n):
                if column < size:
                    A[i, column] = q[i].imag / tiny
                    A[n + i, column] = v[i].imag / tiny
                else:
                    B[i, column - size] = q[i].imag / tiny
                    B[n + i, column - size] = v[i].imag / tiny
        for j in range(m):
            B[2 * n + j, j] = 1.0

    @numba.njit(error_model="numpy")
    def far(z: Any, p: Any, goal: Any, scale: Any) -> float:
        e = 1.0 - (potential(pick(z, 0), p) - scale[0]) / scale[1]
        for i in range(n):
            if not turns[i]:
                e += (z[i] - goal[i]) ** 2
        return (1.0 + _SOFTNESS) * e / (e + _SOFTNESS)

    @numba.njit(error_model="numpy")
    def far_slope(q: Any, p: Any, goal: Any, scale: Any, qc: Any, out: Any) -> None:
        e = 1.0 - (potential(pick(q, 0), p) - scale[0]) / scale[1]
        for i in range(n):
            if not turns[i]:
                e += (q[i] - goal[i]) ** 2
        outer = (1.0 + _SOFTNESS) * _SOFTNESS / (e + _SOFTNESS) ** 2
        for i in range(n):
            for j in range(n):
                qc[j] = q[j]
            qc[i] += 1j * tiny
            slope = -potential_c(pick(qc, 0), p).imag / tiny / scale[1]
            if not turns[i]:
                slope += 2.0 * (q[i] - goal[i])
            out[i] = outer * slope

    @numba.njit(error_model="numpy")
    def stage(z: Any, u: Any, h: float, p: Any, goal: Any, scale: Any, w: Any) -> float:
        power, squares, change, speed = 0.0, 0.0, 0.0, 0.0
        for j in range(m):
            power += abs(np.sqrt((z[2 * n + j] * z[n + where[j]]) ** 2 + _POWER_CORNER**2) - _POWER_CORNER)
            squares += z[2 * n + j] ** 2
            change += (u[j] - z[2 * n + j]) ** 2
        for i in range(n):
            speed += z[n + i] ** 2
        return h * (w[0] * far(z, p, goal, scale) + w[1] * power + w[2] * squares + w[4] * speed) + w[3] * change / h

    @numba.njit(error_model="numpy")
    def deviation(z: Any, goal: Any, out: Any) -> None:
        for i in range(n):
            out[i] = z[i] - goal[i]
            if turns[i]:
                out[i] -= 2.0 * np.pi * np.rint(out[i] / (2.0 * np.pi))
            out[n + i] = z[n + i]

    @numba.njit(error_model="numpy")
    def final(z: Any, goal: Any, S: Any, w: Any, d: Any) -> float:
        deviation(z, goal, d)
        total = 0.0
        for i in range(2 * n):
            for j in range(2 * n):
                total += d[i] * S[i, j] * d[j]
        return w[5] * total

    @numba.njit(error_model="numpy")
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
        # Hessian of far by differences of its exact slope, then what is concave is left out.
        for i in range(n):
            keep = z[i]
            z[i] = keep + 1e-5
            far_slope(z, p, goal, scale, qc, slopes[1])
            z[i] = keep - 1e-5
            far_slope(z, p, goal, scale, qc, slopes[2])
            z[i] = keep
            for j in range(n):
                lzz[i, j] = h * w[0] * (slopes[1, j] - slopes[2, j]) / 2e-5
        if n == 1:
            lzz[0, 0] = max(lzz[0, 0], 0.0)
        else:
            a, b, c = lzz[0, 0], 0.5 * (lzz[0, 1] + lzz[1, 0]), lzz[1, 1]
            middle, radius = 0.5 * (a + c), np.sqrt((0.5 * (a - c)) ** 2 + b * b)
            high, low = max(middle + radius, 0.0), max(middle - radius, 0.0)
            if radius > 1e-15:
                mean, half = 0.5 * (high + low), 0.5 * (high - low)
                lzz[0, 0] = mean + half * 0.5 * (a - c) / radius
                lzz[1, 1] = mean - half * 0.5 * (a - c) / radius
                lzz[0, 1] = lzz[1, 0] = half * b / radius
            else:
                lzz[0, 0] = lzz[1, 1] = high
                lzz[0, 1] = lzz[1, 0] = 0.0
        for i in range(n):
            lz[n + i, 0] = 2.0 * h * w[4] * z[n + i]
            lzz[n + i, n + i] = 2.0 * h * w[4]
        for j in range(m):
            e, s = 2 * n + j, n + where[j]
            product = z[e] * z[s]
            root = np.sqrt(product * product + _POWER_CORNER**2)
            lz[e, 0] = h * w[1] * product / root * z[s] + 2.0 * h * w[2] * z[e] - 2.0 * w[3] * (u[j] - z[e]) / h
            lz[s, 0] += h * w[1] * product / root * z[e]
            # Of |power| the convex part of the product's square.
            lzz[e, e] = h * w[1] * z[s] * z[s] / root + 2.0 * h * w[2] + 2.0 * w[3] / h
            lzz[s, s] += h * w[1] * z[e] * z[e] / root
            lzz[e, s] += h * w[1] * product / root
            lzz[s, e] += h * w[1] * product / root
            lu[j, 0] = 2.0 * w[3] * (u[j] - z[e]) / h
            luu[j, j] = 2.0 * w[3] / h
            luz[j, e] = -2.0 * w[3] / h

    @numba.njit(error_model="numpy")
    def rollout(
        Z: Any, U: Any, Z_old: Any, K_old: Any, p: Any, goal: Any, scale: Any, h: float, w: Any, S: Any, limits: Any,
        work: Any, d: Any,
    ) -> float:  # fmt: skip
        cost = 0.0
        for k in range(U.shape[0]):
            for j in range(m):
                u = U[k, j]
                for i in range(size):
                    u += K_old[k, j, i] * (Z[k, i] - Z_old[k, i])
                U[k, j] = min(limits[j], max(-limits[j], u))
            cost += stage(Z[k], U[k], h, p, goal, scale, w)
            advance(Z[k], U[k], h, p, work, Z[k + 1])
        return cost + final(Z[-1], goal, S, w, d)

    @numba.njit(error_model="numpy")
    def solve(
        Z: Any, U: Any, Z_old: Any, K: Any, p: Any, goal: Any, scale: Any, h: float, w: Any, S: Any, limits: Any,
        iterations: int,
    ) -> Any:  # fmt: skip
        N = U.shape[0]
        work, d = np.zeros((3, n)), np.zeros(2 * n)
        work_c, zc, qc = np.zeros((3, n), np.complex128), np.zeros(size, np.complex128), np.zeros(n, np.complex128)
        lz, lu, slopes = np.zeros((size, 1)), np.zeros((m, 1)), np.zeros((3, n))
        lzz, luu, luz = np.zeros((size, size)), np.zeros((m, m)), np.zeros((m, size))
        k_0 = np.zeros((N, m))
        Z_new, U_new = Z.copy(), U.copy()
        cost = rollout(Z, U, Z_old, K, p, goal, scale, h, w, S, limits, work, d)
        Vz, Vzz = np.zeros((size, 1)), np.zeros((size, size))
        VA, VB, KQ = np.zeros((size, size)), np.zeros((size, m)), np.zeros((m, size))
        g, low, high, free = np.zeros(m), np.zeros(m), np.zeros(m), np.ones(m, np.bool_)
        small, wide = np.zeros((m, m + 1)), np.zeros((m, m + size))
        regular = 1e-6
        count, converged, fresh = 0, False, True
        As, Bs = np.zeros((N, size, size)), np.zeros((N, size, m))
        while count < iterations:
            count += 1
            deviation(Z[N], goal, d)
            Vz[:] = 0.0
            Vzz[:] = 0.0
            for i in range(2 * n):
                for j in range(2 * n):
                    Vz[i, 0] += 2.0 * w[5] * S[i, j] * d[j]
                    Vzz[i, j] = 2.0 * w[5] * S[i, j]
            gain = 0.0
            for k in range(N - 1, -1, -1):
                A, B = As[k], Bs[k]
                if fresh:
                    A[:] = 0.0
                    B[:] = 0.0
                    derive(Z[k], U[k], h, p, work_c, zc, A, B)
                expand(Z[k], U[k], h, p, goal, scale, w, qc, slopes, lz, lu, lzz, luu, luz)
                # lz, lzz, ... become the derivatives of the cost from here on: Q in the sources.
                product(Vzz, A, VA, False, False)
                product(Vzz, B, VB, False, False)
                product(A, Vz, lz, True, True)
                product(B, Vz, lu, True, True)
                product(A, VA, lzz, True, True)
                product(B, VB, luu, True, True)
                product(B, VA, luz, True, True)
                for j in range(m):
                    luu[j, j] += regular
                    g[j] = lu[j, 0]
                    low[j], high[j] = -limits[j] - U[k, j], limits[j] - U[k, j]
                newton(luu, g, low, high, k_0[k], free, small)
                for j in range(m):
                    for i in range(m):
                        wide[j, i] = luu[j, i] if free[i] and free[j] else (1.0 if i == j else 0.0)
                    for i in range(size):
                        wide[j, m + i] = -luz[j, i] if free[j] else 0.0
                eliminate(wide, m)
                for j in range(m):
                    gain -= g[j] * k_0[k, j]
                    for i in range(size):
                        K[k, j, i] = wide[j, m + i]
                # Value of the step taken: V = Q + K' Quu K + K' Quz + Quz' K, of a step that limits may have cut.
                product(luu, K[k], KQ, False, False)
                for i in range(size):
                    Vz[i, 0] = lz[i, 0]
                    for a in range(m):
                        Vz[i, 0] += (KQ[a, i] + luz[a, i]) * k_0[k, a] + K[k, a, i] * g[a]
                for i in range(size):
                    for j in range(size):
                        Vzz[i, j] = lzz[i, j]
                        for a in range(m):
                            Vzz[i, j] += K[k, a, i] * (KQ[a, j] + luz[a, j]) + luz[a, i] * K[k, a, j]
                for i in range(size):
                    for j in range(i):
                        Vzz[i, j] = Vzz[j, i] = 0.5 * (Vzz[i, j] + Vzz[j, i])
            better = False
            alpha = 1.0
            for _ in range(9):
                for i in range(size):
                    Z_new[0, i] = Z[0, i]
                new = 0.0
                for k in range(N):
                    for j in range(m):
                        u = U[k, j] + alpha * k_0[k, j]
                        for i in range(size):
                            u += K[k, j, i] * (Z_new[k, i] - Z[k, i])
                        U_new[k, j] = min(limits[j], max(-limits[j], u))
                    new += stage(Z_new[k], U_new[k], h, p, goal, scale, w)
                    advance(Z_new[k], U_new[k], h, p, work, Z_new[k + 1])
                new += final(Z_new[N], goal, S, w, d)
                if new < cost:
                    better = True
                    break
                alpha *= 0.5
            fresh = better
            if not better:
                regular = max(regular * 10.0, 1e-4)
                if regular > 1e4:
                    converged = gain < 1e-6 * max(1.0, abs(cost))
                    break
                continue
            regular = max(regular * 0.2, 1e-8)
            change = cost - new
            copy(Z_new, Z)
            copy(U_new, U)
            cost = new
            if change < 1e-6 * max(1e-6, abs(cost)):
                converged = True
                break
        return cost, count, converged

    return solve


def _fresh(function: Any) -> Any:
    """Return a copy of a function, so that what numba keeps of it is this kernel's own."""
    return FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__)
