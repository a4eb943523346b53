"""The quadratic program of a linear MPC, with inputs alone as its unknowns, by OSQP; for any number of inputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from pendulum_lqr.sampled_design import DiscreteModel

__all__ = ["CondensedMpc"]

Matrix = NDArray[np.float64]


class CondensedMpc:
    """Minimises a quadratic cost over N samples plus a cost to go, under limits of inputs and states.

    Limits of inputs are hard. Limits of states are soft, one slack for each, because a hard state limit has no answer
    once a disturbance has broken it.

    Args:
        model: Sampled model, m inputs.
        cost: Q, R and N of a sample, as :func:`pendulum_lqr.sampled_design.sampled_cost` gives them.
        terminal: Cost to go, of the shape of Q.
        horizon: N.
        limited: Which states are limited, by index.
        state_limits: Largest magnitude of each of them; inf for none.
        slack_weight: Cost of the square of the most by which a limit is broken, beside those of ``cost``.

    Source:
        Maciejowski, Predictive Control with Constraints, 2002, section 3.1.
    """

    def __init__(
        self,
        model: DiscreteModel,
        cost: tuple[Matrix, Matrix, Matrix],
        terminal: Matrix,
        horizon: int,
        limited: Sequence[int],
        state_limits: Sequence[float],
        slack_weight: float,
    ) -> None:
        self.size, self.inputs = model.B.shape
        n, m, slacks = horizon, self.inputs, len(limited)
        self._free, self._forced = _predictions(model.A, model.B, n)
        P, self._linear = _condensed(self._free, self._forced, cost, terminal, n)
        # Variables: n m inputs, then a slack for each limited state.
        hessian = scipy.sparse.block_diag([P, slack_weight * np.eye(slacks)], format="csc")
        self._limited = [self.size * k + axis for k in range(1, n + 1) for axis in limited]
        rows = self._forced[self._limited]
        slack = np.tile(np.eye(slacks), (n, 1))
        constraints = np.block(
            [
                [np.eye(n * m), np.zeros((n * m, slacks))],
                [rows, slack],
                [rows, -slack],
                [np.zeros((slacks, n * m)), np.eye(slacks)],
            ]
        )
        self.horizon = n
        self._slacks = slacks
        self._state_limit = np.tile(state_limits, n)
        self._hessian = scipy.sparse.triu(hessian, format="csc")
        self._constraints = scipy.sparse.csc_matrix(constraints)
        self.reset()

    def reset(self) -> None:
        """Set the solver up anew: what it learnt from past states (start, step size) would colour the next answers."""
        some = np.ones(self.inputs)
        lower, upper = self._bounds(np.zeros(self.size), -some, some)
        self._solver = osqp.OSQP()
        self._solver.setup(
            self._hessian,
            np.zeros(self._hessian.shape[0]),
            self._constraints,
            lower,
            upper,
            verbose=False,
            eps_abs=1e-6,
            eps_rel=1e-6,
            max_iter=4000,
            polishing=False,
            # By iterations: an adaptation by elapsed time would make answers depend on the machine's load.
            adaptive_rho=1,
            adaptive_rho_interval=50,
        )

    def first(self, state: Matrix, low: Matrix, high: Matrix) -> Matrix | None:
        """Return the first inputs of the plan, shape (m,), or None where the solver finds none.

        Args:
            state: Of the sampled model.
            low: Smallest inputs, shape (m,).
            high: Largest inputs, shape (m,).
        """
        lower, upper = self._bounds(state, low, high)
        linear = np.zeros(self._hessian.shape[0])
        linear[: self._linear.shape[0]] = self._linear @ state
        self._solver.update(q=linear, l=lower, u=upper)
        result = self._solver.solve(raise_error=False)
        plan = result.x
        if plan is None or not np.isfinite(plan[: self.inputs]).all() or result.info.status_val not in {1, 2}:
            return None
        first: Matrix = plan[: self.inputs]
        return first

    def _bounds(self, state: Matrix, low: Matrix, high: Matrix) -> tuple[Matrix, Matrix]:
        n, slacks = self.horizon, self._slacks
        infinite = np.full(slacks * n, np.inf)
        free = self._free[self._limited] @ state
        # x + s >= -limit, x - s <= limit, s >= 0
        lower = np.concatenate([np.tile(low, n), -self._state_limit - free, -infinite, np.zeros(slacks)])
        upper = np.concatenate([np.tile(high, n), infinite, self._state_limit - free, np.full(slacks, np.inf)])
        return lower, upper


def _predictions(A: Matrix, B: Matrix, n: int) -> tuple[Matrix, Matrix]:
    """Return (F, G) with [x0; x1; ...; xn] = F x0 + G [u0; ...; u(n-1)]."""
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


def _condensed(
    free: Matrix, forced: Matrix, cost: tuple[Matrix, Matrix, Matrix], terminal: Matrix, n: int
) -> tuple[Matrix, Matrix]:
    """Return (P, C) of the condensed cost u' P u / 2 + (C x0)' u."""
    q, r, cross = cost
    weight = scipy.linalg.block_diag(*([q] * n), terminal)
    size, m = cross.shape
    mixed = np.zeros((size * (n + 1), n * m))
    for k in range(n):
        mixed[size * k : size * (k + 1), m * k : m * (k + 1)] = cross
    coupling = forced.T @ mixed
    P = forced.T @ weight @ forced + np.kron(np.eye(n), r) + coupling + coupling.T
    C = forced.T @ weight @ free + mixed.T @ free
    return 0.5 * (P + P.T), C
