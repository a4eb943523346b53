"""Linear MPC: LQR under limits, as a quadratic program by OSQP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pendulum_lqr.controllers.lqg import Lqg
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, OFFSET_NOISE, Q, R
from pendulum_lqr.linear.condensed_mpc import CondensedMpc
from pendulum_lqr.linear.design import DesignError, Matrix
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.observer import Observer
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["LinearMpc"]

_SLACK_WEIGHT = 1e4
"""Cost high enough that angle and velocity stay within their limits wherever a torque can achieve that."""
_NOISE = {"angle_noise": 2e-4, "velocity_noise": 1e-2, "torque_noise": 1.0}
"""What the filter expects of encoder, velocity and unknown torque [rad, rad/s, N m]."""


class LinearMpc(Lqg):
    """Minimises the LQR's cost over N samples plus its cost to go, under limits of torque, angle and velocity.

    The prediction is that of the whole linear model, torques on their way included; what is not measured, and with
    ``offset_noise`` a constant torque too, comes from a Kalman filter.
    Without active limits the command is that of the discrete LQR. The torque limit is hard; angle and velocity limits
    are soft (one slack each, at a high cost): a hard state limit is infeasible once a disturbance has broken it.
    """

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

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self._failures = 0
        if abs(self.hold) >= self.effort_limit:
            raise DesignError(
                f"holding set_point {self.set_point} rad takes {self.hold:.4g} N m; expected less than effort_limit "
                f"= {self.effort_limit:g} N m"
            )
        limits = {axis: p[name] for axis, name in enumerate(("angle_limit", "velocity_limit")) if p[name]}
        self._program = CondensedMpc(
            self._sampled, self.gain, self._cost[1], int(p["horizon"]), limits, (self.effort_limit,), _SLACK_WEIGHT
        )

    def _make_observer(self, model: LinearModel, period: float, p: Mapping[str, Any]) -> Observer | None:
        # Measured states need no filter: what they show is then what counts.
        needed = model.hidden or self._sampled.pending or p["offset_noise"] > 0.0
        return super()._make_observer(model, period, {**p, **_NOISE}) if needed else None

    def reset(self) -> None:
        """Forget the estimate and the plan."""
        super().reset()
        self._program.reset()

    def _beyond(self, state: Matrix, held: float) -> float:
        """Return the first torque of the plan, beyond what holds; the LQR's where the solver finds none [N m]."""
        plan = self._program.first(state, np.array([-self.effort_limit - held]), np.array([self.effort_limit - held]))
        if plan is None:
            self._failures += 1
            self.notice = f"no plan for {self._failures} states: the LQR answered"
            return super()._beyond(state, held)
        return float(plan[0])

    def describe(self) -> str:
        """Return horizon and unlimited gain."""
        gain = ", ".join(f"{value:.6f}" for value in self.gain.K)
        return f"horizon {self._program.horizon}, K without limits [{gain}]"
