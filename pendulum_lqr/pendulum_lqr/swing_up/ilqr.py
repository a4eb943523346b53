"""Compiled iterative LQR for any mechanism: optimises limited efforts over a horizon in milliseconds.

Efforts are linear between nodes h apart, and the previous effort is part of the state, so that its changes cost::

    z_k = (q_k, v_k, u_k),   q, v by one step of Runge-Kutta from u_k to u_(k+1),   |u| <= limit
    J   = sum h (w_0 far(q) + w_1 |u . v_driven| + w_2 |u|^2 + w_4 |v|^2) + w_3 |u_(k+1) - u_k|^2 / h  +  w_5 dx' S dx

far(q) = (1 + c) e / (e + c), from 0 at the goal to 1, of the missing potential energy e plus squared distances of
slides; S is the LQR's, dx the last deviation, wrapped. Sources: Tassa, Erez and Todorov, Synthesis and stabilization of
complex behaviors through online trajectory optimization, IROS 2012; Tassa, Mansard and Todorov, Control-limited
differential dynamic programming, ICRA 2014.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.swing_up.ilqr_functions import cost_functions, step_functions
from pendulum_lqr.swing_up.small_matrices import copy, eliminate, newton, product
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.contract.values import written
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.loops.trees import WITHIN
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.kernel_cache import keep_kernel

__all__ = ["IlqrPlan", "IlqrProblem", "IlqrWeights", "require_several_joints"]

Array = NDArray[np.float64]


class IlqrWeights(NamedTuple):
    """Weights of the cost.

    Attributes:
        far: Being away from upright [1/s].
        energy: Absolute power [1/J].
        effort: Squared efforts [1/(N^2 m^2 s)].
        rate: Squared slopes of the efforts [s/(N^2 m^2)].
        velocity: Squared velocities [s/rad^2].
        terminal: The LQR's cost of the last deviation.
    """

    far: float = 1.0
    energy: float = 0.0
    effort: float = 0.01
    rate: float = 1e-4
    velocity: float = 1e-3
    terminal: float = 1.0


class IlqrPlan(NamedTuple):
    """Result of iterations on a guess.

    Attributes:
        states: (q, v, u) at the nodes, shape (N + 1, 2n + m).
        efforts: Efforts at the ends of the intervals, shape (N, m).
        gains: Feedback gains K on (q, v, u), shape (N, m, 2n + m); 0 without iterations.
        cost: J; infinite if the plan diverges.
        iterations: Number of iterations.
        converged: Whether the last one changed J by less than 1e-6 of it.
    """

    states: Array
    efforts: Array
    gains: Array
    cost: float
    iterations: int
    converged: bool


def require_several_joints(plant: PlantParameters) -> None:
    """Raise a ParameterError for a plant of one joint, whose matrices the solver does not have."""
    if len(plant.joints) == 1:
        raise ParameterError(
            f"plant {plant.name!r} has one joint; expected several: energy_swing_up and time_optimal follow no file"
        )


@dataclass(frozen=True)
class IlqrProblem:
    """Problem of one plant; dry friction, stops, lag and delay are neglected.

    Attributes:
        step: Length of an interval, h [s].
        weights: Of the cost.
        terminal: S, shape (2n, 2n).
        limit: Usable share of the effort limits.

    Raises:
        ParameterError: The plant has one joint.
    """

    plant: PlantParameters
    step: float
    weights: IlqrWeights
    terminal: Array
    limit: float = 1.0

    def __post_init__(self) -> None:
        require_several_joints(self.plant)

    def solve(
        self, q: Vector, v: Vector, u: Vector, efforts: Array, iterations: int, around: IlqrPlan | None = None
    ) -> IlqrPlan:
        """Improve a guess.

        Args:
            q: Initial positions [rad or m].
            v: Initial velocities.
            u: Initial efforts, m values.
            efforts: Guess, shape (N, m); not changed.
            iterations: Largest number of iterations; 0 only simulates the guess.
            around: Plan of as many intervals whose feedback follows the guess; without it, an unstable plant that
                starts slightly off the plan diverges.

        Raises:
            ParameterError: The start is not finite: limits would turn NaN into efforts.
        """
        if not all(map(math.isfinite, (*q, *v, *u))):
            raise ParameterError(f"plan begins at {written((*q, *v, *u))}; expected finite numbers")
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
        return IlqrPlan(Z, U, gains, float(cost) if math.isfinite(cost) else math.inf, int(count), bool(converged))


@cache
def _kernel(name: str, driven: tuple[int, ...]) -> Any:
    """Return the compiled solver for a mechanism and its driven joints."""
    mechanism = MECHANISMS[name]
    n, m = len(mechanism.joints), len(driven)
    size = 2 * n + m
    advance, derive = step_functions(mechanism, driven)
    stage, expand, final, final_slopes = cost_functions(mechanism, driven)

    @numba.njit(error_model="numpy", **WITHIN)
    def follow(
        Z: Any, U: Any, K: Any, k_0: Any, alpha: float, Z_new: Any, U_new: Any, p: Any, goal: Any, scale: Any, h: float,
        w: Any, S: Any, limits: Any, work: Any, d: Any,
    ) -> float:  # fmt: skip
        """Fill Z_new but its first, and U_new, by u = U + alpha k_0 + K (z - Z) within limits; return the cost."""
        cost = 0.0
        for k in range(U.shape[0]):
            for j in range(m):
                u = U[k, j] + alpha * k_0[k, j]
                for i in range(size):
                    u += K[k, j, i] * (Z_new[k, i] - Z[k, i])
                U_new[k, j] = min(limits[j], max(-limits[j], u))
            cost += stage(Z_new[k], U_new[k], h, p, goal, scale, w)
            advance(Z_new[k], U_new[k], h, p, work, Z_new[k + 1])
        return cost + final(Z_new[-1], goal, S, w, d)

    @numba.njit(error_model="numpy", **WITHIN)
    def linearise(Z: Any, U: Any, h: float, p: Any, As: Any, Bs: Any) -> None:
        """Fill the derivatives of each step."""
        work, zc = np.zeros((3, n), np.complex128), np.zeros(size, np.complex128)
        for k in range(U.shape[0]):
            As[k, :, :] = 0.0
            Bs[k, :, :] = 0.0
            derive(Z[k], U[k], h, p, work, zc, As[k], Bs[k])

    @numba.njit(error_model="numpy", **WITHIN)
    def improve(
        Z: Any, U: Any, As: Any, Bs: Any, regular: float, p: Any, goal: Any, scale: Any, h: float, w: Any, S: Any,
        limits: Any, K: Any, k_0: Any,
    ) -> float:  # fmt: skip
        """Fill gains K and steps k_0, from the end to the start; return the predicted decrease."""
        d, qc = np.zeros(2 * n), np.zeros(n, np.complex128)
        lz, lu, slopes = np.zeros((size, 1)), np.zeros((m, 1)), np.zeros((3, n))
        lzz, luu, luz = np.zeros((size, size)), np.zeros((m, m)), np.zeros((m, size))
        Vz, Vzz = np.zeros((size, 1)), np.zeros((size, size))
        VA, VB, KQ = np.zeros((size, size)), np.zeros((size, m)), np.zeros((m, size))
        g, low, high, free = np.zeros(m), np.zeros(m), np.zeros(m), np.ones(m, np.bool_)
        small, wide = np.zeros((m, m + 1)), np.zeros((m, m + size))
        promised = 0.0
        final_slopes(Z[-1], goal, S, w, d, Vz, Vzz)
        for k in range(U.shape[0] - 1, -1, -1):
            A, B = As[k], Bs[k]
            expand(Z[k], U[k], h, p, goal, scale, w, qc, slopes, lz, lu, lzz, luu, luz)
            # lz, lzz, ... become the derivatives of the cost to go: Q in the sources.
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
                promised -= g[j] * k_0[k, j]
                for i in range(size):
                    K[k, j, i] = wide[j, m + i]
            # Value of the limited step: V = Q + K' Quu K + K' Quz + Quz' K.
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
        return promised

    @numba.njit(error_model="numpy", no_cfunc_wrapper=True)
    def solve(
        Z: Any, U: Any, Z_old: Any, K: Any, p: Any, goal: Any, scale: Any, h: float, w: Any, S: Any, limits: Any,
        iterations: int,
    ) -> Any:  # fmt: skip
        N = U.shape[0]
        work, d = np.zeros((3, n)), np.zeros(2 * n)
        k_0, As, Bs = np.zeros((N, m)), np.zeros((N, size, size)), np.zeros((N, size, m))
        cost = follow(Z_old, U, K, k_0, 0.0, Z, U, p, goal, scale, h, w, S, limits, work, d)
        Z_new, U_new = Z.copy(), U.copy()
        regular = 1e-6
        count, better = 0, True
        while count < iterations:
            count += 1
            if better:
                linearise(Z, U, h, p, As, Bs)
            promised = improve(Z, U, As, Bs, regular, p, goal, scale, h, w, S, limits, K, k_0)
            better = False
            alpha, new = 1.0, cost
            for _ in range(9):
                new = follow(Z, U, K, k_0, alpha, Z_new, U_new, p, goal, scale, h, w, S, limits, work, d)
                if new < cost:
                    better = True
                    break
                alpha *= 0.5
            if not better:
                regular = max(regular * 10.0, 1e-4)
                if regular > 1e4:
                    return cost, count, promised < 1e-6 * max(1.0, abs(cost))
                continue
            regular = max(regular * 0.2, 1e-8)
            change = cost - new
            copy(Z_new, Z)
            copy(U_new, U)
            cost = new
            if change < 1e-6 * max(1e-6, abs(cost)):
                return cost, count, True
        return cost, count, False

    return keep_kernel(solve, "ilqr", mechanism.forward, mechanism.potential, name, driven)
