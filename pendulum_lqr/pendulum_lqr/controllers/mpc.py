"""Linear MPC: LQR that knows its limits, as a quadratic program by OSQP."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.condensed_mpc import CondensedMpc
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
"""So dear that angle and velocity keep their limits wherever a torque can keep them."""
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
        self._failures = 0
        self.hold = model.effort if p["feedforward"] else 0.0
        if abs(self.hold) >= self.effort_limit:
            raise DesignError(
                f"holding set_point {self.set_point} rad takes {self.hold:.4g} N m; expected less than effort_limit "
                f"= {self.effort_limit:g} N m"
            )
        sampled = discretise(model, period, p["delay"])
        cost = sampled_cost(model, p["q"], p["r"], period, p["delay"])
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
        self.gain: Gain = discrete_lqr(sampled, *cost)
        limits = {axis: p[name] for axis, name in enumerate(("angle_limit", "velocity_limit")) if p[name]}
        self._program = CondensedMpc(
            sampled, self.gain, cost[1], int(p["horizon"]), limits, (self.effort_limit,), _SLACK_WEIGHT
        )

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> LinearMpc:
        """Return the MPC for the plant linearised at the set-point."""
        return cls(linearise(plant, UPRIGHT + p["set_point"]), period, p)

    def reset(self) -> None:
        """Forget the estimate and the plan."""
        if self._observer is not None:
            self._observer.reset()
        self._program.reset()

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
        held = self.hold - offset
        low, high = np.array([-self.effort_limit - held]), np.array([self.effort_limit - held])
        plan = self._program.first(state, low, high)
        if plan is None:
            self._failures += 1
            self.notice = f"no plan for {self._failures} states: the LQR answered"
            return -float(self.gain.K @ state)
        return float(plan[0])

    def describe(self) -> str:
        """Return horizon and unlimited gain."""
        gain = ", ".join(f"{value:.6f}" for value in self.gain.K)
        return f"horizon {self._program.horizon}, K without limits [{gain}]"
