"""Quadratic program of a linear MPC with inputs as its only unknowns, solved by OSQP, for any number of inputs.

::

    u_k = v_k - K x_k,   x_(k+1) = (A - B K) x_k + B v_k,   K, S of the discrete LQR
    J = x_0' S x_0 + sum of v_k' (R + B' S B) v_k

The unknown v is what the limits subtract from the LQR. Powers of A itself grow with the plant's unstable modes: 1e5 in
a second of an acrobot, 1e10 in the Hessian, and the solver's results would be silently wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import osqp
import scipy.sparse
from numpy.typing import NDArray

from pendulum_lqr.linear.design import DesignError, Gain
from pendulum_lqr.linear.sampled_design import DiscreteModel

__all__ = ["CondensedMpc"]

Matrix = NDArray[np.float64]

_TOLERANCE = 1e-4
"""Relative to the limit of an input or state, and to the largest number in it; 1e-6 takes ten times as long."""


class CondensedMpc:
    """Minimises the cost of the discrete LQR under limits of inputs and states over N samples.

    Input limits are hard. State limits are soft, with one slack each, because hard ones are infeasible once a
    disturbance has violated them.

    Args:
        model: Sampled model, m inputs.
        gain: Its discrete LQR.
        r: Input cost of a sample, shape (m, m).
        horizon: N.
        limited: Largest magnitude, > 0, of each limited state, by its index.
        largest: Magnitude of the largest inputs, shape (m,), > 0.
        slack_weight: Cost of the squared largest violation of a limit.

    Raises:
        DesignError: The scales differ too much for the solver.

    Source:
        Rossiter, Kouvaritakis, Rice, A numerically robust state-space approach to stable-predictive control
        strategies, Automatica 34(1), 1998.
    """

    def __init__(
        self,
        model: DiscreteModel,
        gain: Gain,
        r: Matrix,
        horizon: int,
        limited: Mapping[int, float],
        largest: Sequence[float],
        slack_weight: float,
    ) -> None:
        self.size, self.inputs = model.B.shape
        n, m, slacks = horizon, self.inputs, len(limited)
        self._scale = np.array(largest)
        self._limits = np.tile(list(limited.values()), n)
        self._K = np.atleast_2d(gain.K) / self._scale[:, None]
        B = model.B * self._scale
        free, forced = _predictions(model.A - B @ self._K, B, n)
        # Variables: n m inputs added to the LQR's, then a slack per limited state. Variables are scaled by their limits
        # and the cost by that of an input, so that the tolerance means the same for 0.09 N m and 10 N.
        weight = np.outer(self._scale, self._scale) * (r + model.B.T @ gain.S @ model.B)
        one = float(np.trace(weight)) / m
        slack_cost = slack_weight * np.array(list(limited.values())) ** 2
        hessian = scipy.sparse.block_diag([np.kron(np.eye(n), weight / one), np.diag(slack_cost / one)], format="csc")
        axes = [self.size * k + axis for k in range(1, n + 1) for axis in limited]
        states = forced[axes] / self._limits[:, None]
        slack = np.tile(np.eye(slacks), (n, 1))
        asked = np.kron(np.eye(n), -self._K)
        inputs = np.eye(n * m) + asked @ forced[: n * self.size]
        self._free_inputs = asked @ free[: n * self.size]
        self._free_states = free[axes] / self._limits[:, None]
        constraints = np.block(
            [
                [inputs, np.zeros((n * m, slacks))],
                [states, slack],
                [states, -slack],
                [np.zeros((slacks, n * m)), np.eye(slacks)],
            ]
        )
        self.horizon = n
        self._slacks = slacks
        self._hessian = scipy.sparse.triu(hessian, format="csc")
        self._constraints = scipy.sparse.csc_matrix(constraints)
        self.reset()

    def reset(self) -> None:
        """Set the solver up again: warm start and step size from past states would affect the next results."""
        lower, upper = self._bounds(np.zeros(self.size), -self._scale, self._scale)
        self._solver = osqp.OSQP()
        try:
            self._solver.setup(
                self._hessian,
                np.zeros(self._hessian.shape[0]),
                self._constraints,
                lower,
                upper,
                verbose=False,
                eps_abs=_TOLERANCE,
                eps_rel=_TOLERANCE,
                max_iter=1000,
                polishing=False,
                # By iterations: adaptation by elapsed time would make results depend on the machine's load.
                adaptive_rho=1,
                adaptive_rho_interval=50,
            )
        except osqp.OSQPException as error:
            raise DesignError(
                f"limits of efforts {self._scale.tolist()} and of states {sorted(set(self._limits.tolist()))} are with "
                "these weights too far from one for the solver (OSQP); expected larger limits, or 0 for none"
            ) from error

    def first(self, state: Matrix, low: Matrix, high: Matrix) -> Matrix | None:
        """Return the first inputs of the plan within ``low`` and ``high``, shapes (m,), or None without a solution."""
        lower, upper = self._bounds(state, low, high)
        if (lower <= 0.0).all() and (upper >= 0.0).all():
            # The LQR's path violates no limit, so v = 0 is optimal.
            lqr: Matrix = -self._scale * (self._K @ state)
            return lqr
        if not np.abs(self._free_inputs @ state).max() * _TOLERANCE < 1.0:
            # The LQR's inputs are so large that the tolerance is a whole limit: signs would be arbitrary. With NaN the
            # solver would silently keep its previous data.
            return None
        self._solver.update(l=lower, u=upper)
        result = self._solver.solve(raise_error=False)
        plan = result.x
        if plan is None or not np.isfinite(plan[: self.inputs]).all() or result.info.status_val not in {1, 2}:
            # Its last iterate would be a bad start for the next one.
            self.reset()
            return None
        first: Matrix = self._scale * (plan[: self.inputs] - self._K @ state)
        return first

    def _bounds(self, state: Matrix, low: Matrix, high: Matrix) -> tuple[Matrix, Matrix]:
        n, slacks = self.horizon, self._slacks
        infinite = np.full(slacks * n, np.inf)
        inputs, states = self._free_inputs @ state, self._free_states @ state
        low, high, one = np.tile(low / self._scale, n), np.tile(high / self._scale, n), np.ones(slacks * n)
        # x + s >= -limit, x - s <= limit, s >= 0
        lower = np.concatenate([low - inputs, -one - states, -infinite, np.zeros(slacks)])
        upper = np.concatenate([high - inputs, infinite, one - states, np.full(slacks, np.inf)])
        return lower, upper


def _predictions(A: Matrix, B: Matrix, n: int) -> tuple[Matrix, Matrix]:
    """Return (F, G) with [x0; x1; ...; xn] = F x0 + G [v0; ...; v(n-1)]."""
    size, m = B.shape
    free = np.zeros((size * (n + 1), size))
    forced = np.zeros((size * (n + 1), n * m))
    free[:size] = np.eye(size)
    for k in range(n):
        row = slice(size * k, size * (k + 1))
        after = slice(size * (k + 1), size * (k + 2))
        free[after] = A @ free[row]
        forced[after] = A @ forced[row]
        forced[after, m * k : m * (k + 1)] += B
    return free, forced
