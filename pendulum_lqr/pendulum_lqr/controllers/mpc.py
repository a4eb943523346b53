"""Linear MPC: LQR that knows its limits, as a quadratic program by OSQP."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, OFFSET_NOISE, Q, R
from pendulum_lqr.design import DesignError, Gain
from pendulum_lqr.interface import Controller
from pendulum_lqr.model import LinearModel, linearise
from pendulum_lqr.observer import Observer
from pendulum_lqr.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["LinearMpc"]

Matrix = NDArray[np.float64]

_SLACK_WEIGHT = 1e4
_ANGLE_NOISE, _VELOCITY_NOISE, _TORQUE_NOISE = 2e-4, 1e-2, 1.0
"""What the filter expects of encoder, velocity and unknown torque [rad, rad/s, N m]."""


class LinearMpc(BaseController):
    """Minimises the LQR's cost over N samples plus its cost to go, under limits of torque, angle and velocity.

    The prediction is that of the whole linear model, torques on their way included; what is not measured, and with
    ``offset_noise`` a constant torque too, comes from a Kalman filter.
    Without active limits the answer is that of the discrete LQR. The torque limit is hard; angle and velocity
    limits are soft (one slack each, dear), because a hard state limit has no answer once a disturbance has broken it.

    Args:
        model: Linear model at the set-point.
        period: Sampling period [s].
        p: Checked parameters.
    """

    PREDICTS = True
    SUMMARY = "linear MPC with limits of torque, angle and velocity (OSQP)"
    PARAMETERS = (
        Q,
        R,
        ParameterSpec("horizon", 20, "-", "Samples of the horizon.", minimum=1, maximum=200),
        ParameterSpec("angle_limit", 0.5, "rad", "Largest deviation from the set-point; 0 for none.", minimum=0.0),
        ParameterSpec("velocity_limit", 0.0, "rad/s", "Largest velocity; 0 for none.", minimum=0.0),
        OFFSET_NOISE,
        DELAY,
        FEEDFORWARD,
    )

    def __init__(self, model: LinearModel, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(p["effort_limit"], p["set_point"])
        self.hold = model.effort if p["feedforward"] else 0.0
        if abs(self.hold) >= self.effort_limit:
            raise DesignError(
                f"holding set_point {self.set_point} rad takes {self.hold:.4g} N m; expected less than effort_limit "
                f"= {self.effort_limit:g} N m"
            )
        self.failures = 0
        sampled = discretise(model, period, p["delay"])
        q, r, cross = sampled_cost(model, p["q"], p["r"], period, p["delay"])
        self._size = sampled.A.shape[0]
        # Measured states need no filter: what they show is then what counts.
        self._observer: Observer | None = None
        if model.hidden or sampled.pending or p["offset_noise"] > 0.0:
            self._observer = Observer(
                model,
                period,
                angle_noise=_ANGLE_NOISE,
                velocity_noise=_VELOCITY_NOISE,
                torque_noise=_TORQUE_NOISE,
                offset_noise=p["offset_noise"],
                delay=p["delay"],
            )
        self.gain: Gain = discrete_lqr(sampled, q, r, cross)
        n = int(p["horizon"])
        self._free, self._forced = _predictions(sampled.A, sampled.B, n)
        P, self._linear = _cost(self._free, self._forced, q, r, cross, self.gain.S, n)
        self._limits = (p["angle_limit"] or math.inf, p["velocity_limit"] or math.inf)
        # Variables: n torques, then the slack of angle and of velocity.
        hessian = scipy.sparse.block_diag([P, _SLACK_WEIGHT * np.eye(2)], format="csc")
        self._limited = [self._size * k + axis for k in range(1, n + 1) for axis in (0, 1)]
        rows = self._forced[self._limited]
        slack = np.tile(np.eye(2), (n, 1))
        constraints = np.block(
            [
                [np.eye(n), np.zeros((n, 2))],
                [rows, slack],
                [rows, -slack],
                [np.zeros((2, n)), np.eye(2)],
            ]
        )
        self._n = n
        self._state_limit = np.tile(self._limits, n)
        self._hessian = scipy.sparse.triu(hessian, format="csc")
        self._constraints = scipy.sparse.csc_matrix(constraints)
        self.reset()

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> LinearMpc:
        """Return the MPC for the plant linearised at the set-point."""
        return cls(linearise(plant, UPRIGHT + p["set_point"]), period, p)

    def reset(self) -> None:
        """Set the solver up anew: what it learnt from past states (start, step size) would colour the next answers."""
        if self._observer is not None:
            self._observer.reset()
        lower, upper = self._bounds(np.zeros(self._size), 0.0)
        self._solver = osqp.OSQP()
        self._solver.setup(
            self._hessian,
            np.zeros(self._n + 2),
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

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the first torque of the plan; the limited LQR's where the solver finds none [N m]."""
        state, offset = np.array([self.error(x[0]), x[1]]), 0.0
        if self._observer is not None:
            state = self._observer.correct(float(state[0]), float(state[1]))
            offset = self._observer.offset
        effort = self.clamp(self.hold - offset + self._plan(state, offset))
        if self._observer is not None:
            self._observer.predict(effort)
        return effort

    def take_over(self, previous: Controller) -> None:
        """Take over the estimate, moved to the new set-point."""
        if isinstance(previous, LinearMpc) and self._observer is not None and previous._observer is not None:
            self._observer.carry_over(previous._observer, self.set_point - previous.set_point)

    def _plan(self, state: Matrix, offset: float) -> float:
        """Return the first torque of the plan, beyond what holds [N m]."""
        lqr = -float(self.gain.K @ state)
        lower, upper = self._bounds(state, offset)
        linear = np.zeros(self._n + 2)
        linear[: self._n] = self._linear @ state
        self._solver.update(q=linear, l=lower, u=upper)
        result = self._solver.solve(raise_error=False)
        plan = result.x
        if plan is None or not np.isfinite(plan[0]) or result.info.status_val not in {1, 2}:
            self.failures += 1
            return lqr
        return float(plan[0])

    def describe(self) -> str:
        """Return horizon and unlimited gain."""
        return f"horizon {self._n}, K without limits [{', '.join(f'{value:.6f}' for value in self.gain.K)}]"

    def _bounds(self, state: Matrix, offset: float) -> tuple[Matrix, Matrix]:
        n = self._n
        infinite = np.full(2 * n, np.inf)
        free = self._free[self._limited] @ state
        held = self.hold - offset
        low_effort = np.full(n, -self.effort_limit - held)
        high_effort = np.full(n, self.effort_limit - held)
        # x + s >= -limit, x - s <= limit, s >= 0
        lower = np.concatenate([low_effort, -self._state_limit - free, -infinite, np.zeros(2)])
        upper = np.concatenate([high_effort, infinite, self._state_limit - free, np.full(2, np.inf)])
        return lower, upper


def _predictions(A: Matrix, B: Matrix, n: int) -> tuple[Matrix, Matrix]:
    """Return (F, G) with [x0; x1; ...; xn] = F x0 + G [u0; ...; u(n-1)]."""
    size = A.shape[0]
    free = np.zeros((size * (n + 1), size))
    forced = np.zeros((size * (n + 1), n))
    free[:size] = np.eye(size)
    for k in range(n):
        row = slice(size * k, size * (k + 1))
        after = slice(size * (k + 1), size * (k + 2))
        free[after] = A @ free[row]
        forced[after] = A @ forced[row]
        forced[after, k] += B[:, 0]
    return free, forced


def _cost(
    free: Matrix, forced: Matrix, q: Matrix, r: float, cross: Matrix, terminal: Matrix, n: int
) -> tuple[Matrix, Matrix]:
    """Return (P, C) of the condensed cost u' P u / 2 + (C x0)' u."""
    weight = scipy.linalg.block_diag(*([q] * n), terminal)
    size = q.shape[0]
    mixed = np.zeros((size * (n + 1), n))
    for k in range(n):
        mixed[size * k : size * (k + 1), k] = cross[:, 0]
    coupling = forced.T @ mixed
    P = forced.T @ weight @ forced + r * np.eye(n) + coupling + coupling.T
    C = forced.T @ weight @ free + mixed.T @ free
    return 0.5 * (P + P.T), C
