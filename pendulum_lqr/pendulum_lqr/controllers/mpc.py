"""Linear MPC of any number of joints: LQR under limits, as a quadratic program by OSQP."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controllers.discrete_lqr import SampledFeedback
from pendulum_lqr.controllers.linear_feedback import gain_text
from pendulum_lqr.controllers.specs import DELAY, OFFSET_NOISE
from pendulum_lqr.linear.condensed_mpc import CondensedMpc
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.observer import Observer
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["LinearMpc"]

Array = NDArray[np.float64]

_SLACK_WEIGHT = 1e4
"""Cost high enough that angle and velocity stay within their limits if a torque can achieve that."""
_DEAR = 10.0
"""Cost of exceeding a position limit of several joints, relative to the largest weight: a pole must not fall for a
track's end.
"""
_KEPT_CLEAR = 0.95
"""Usable share of the way to an end stop."""
_NOISE = {"position_noise": 2e-4, "velocity_noise": 1e-2, "effort_noise": 1.0}
"""Assumed noise of encoder, velocity and unknown effort [rad, rad/s, N m]."""


class LinearMpc(SampledFeedback):
    """Minimises the LQR's cost over N samples plus its cost to go, under limits of efforts and states.

    It predicts the whole linear model with efforts in transit. Hidden states of one joint come from a Kalman filter,
    those of several are predicted; with ``offset_noise`` constant efforts are estimated too. Without active limits it
    equals the discrete LQR. Effort limits are hard; state limits are soft (one slack each, at a high cost), because a
    hard one is infeasible once a disturbance has violated it.
    """

    SUMMARY = "linear MPC with limits of efforts and states (OSQP)"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.failures = 0
        for name, hold, limit in zip(plant.coordinates.driven_names, self.hold, self.effort_limits, strict=True):
            if abs(hold) >= limit:
                unit = plant.coordinates.drive_unit
                raise DesignError(
                    f"holding set_point {p['set_point']} takes {hold:.4g} {unit} at {name}; expected less than "
                    f"effort_limit = {limit:g} {unit}"
                )
        one = "position_limits" not in p
        widths = [p["angle_limit"], p["velocity_limit"]] if one else p["position_limits"]
        if not one and len(widths) != len(self.position):
            raise ParameterError(
                f"position_limits has {len(widths)} values; expected {len(self.position)}, for "
                f"{', '.join(plant.coordinates.names)}"
            )
        self._widths, self._limits = widths, np.array(self.effort_limits)
        limits = {axis: width for axis, width in enumerate(widths) if width}
        slack = _SLACK_WEIGHT if one else _DEAR * max(p["q"])
        self._program = CondensedMpc(
            self.sampled, self.gain, self.cost[1], int(p["horizon"]), limits, self.effort_limits, slack
        )
        self._enough = _enough_samples(self.sampled.A) if limits and not one else 0
        self._warn()

    def _make_observer(self, p: Mapping[str, Any]) -> Observer | None:
        if not self._plant.is_pendulum:
            return super()._make_observer({**p, **_NOISE} if p["offset_noise"] > 0.0 else p)
        # Measured states need no filter.
        needed = self.model.hidden or self.sampled.pending or p["offset_noise"] > 0.0
        return super()._make_observer({**p, **_NOISE}) if needed else None

    @classmethod
    def own(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return horizon, limits of states (by default inside end stops), and estimated offsets."""
        if plant is None or plant.is_pendulum:
            return (
                ParameterSpec("horizon", 20, "-", "Samples of the horizon.", minimum=1, maximum=200),
                ParameterSpec("angle_limit", 0.5, "rad", "Largest deviation from the set-point; 0 for none.",
                              minimum=0.0),
                ParameterSpec("velocity_limit", 0.0, "rad/s", "Largest velocity; 0 for none.", minimum=0.0),
                OFFSET_NOISE,
                DELAY,
            )  # fmt: skip
        meaning = f"Largest deviations of {', '.join(plant.coordinates.names)} from the set-point; 0 for none."
        return (
            ParameterSpec("horizon", 50, "-", "Samples of the horizon.", minimum=1, maximum=200),
            ParameterSpec("position_limits", _within_stops(plant), "", meaning, minimum=0.0),
            OFFSET_NOISE,
            DELAY,
        )

    def _warn(self) -> None:
        """Report a horizon that is too short, and failures of the solver."""
        notices = []
        if self._program.horizon < self._enough:
            notices.append(
                f"it looks {self._program.horizon * self.period:g} s ahead, and to keep clear of a limit it may let "
                f"fall what falls later; expected a horizon of {self._enough} samples or more, or a slower plant"
            )
        if self.failures:
            notices.append(f"no plan for {self.failures} states: the LQR answered")
        self.notice = "; ".join(notices)

    def reset(self) -> None:
        """Forget the estimate and the plan."""
        super().reset()
        self._program.reset()

    def _beyond(self, state: Array, held: Array) -> Array:
        """Return the first efforts of the plan; the LQR's without a solution."""
        plan = self._program.first(state, -self._limits - held, self._limits - held)
        if plan is None:
            self.failures += 1
            self._warn()
            return super()._beyond(state, held)
        return plan

    def describe(self) -> str:
        """Return horizon, limits and unlimited gain."""
        within = ", ".join(f"{width:g}" if width else "none" for width in self._widths)
        limits = f"positions within [{within}], " if len(self.position) > 1 else ""
        return f"horizon {self._program.horizon}, {limits}K without limits [{gain_text(self.gain.rows)}]"


def _enough_samples(A: Array) -> int:
    """Return the samples in which a fall grows by e: a shorter horizon does not see the effort limit."""
    growth = float(np.max(np.abs(np.linalg.eigvals(A))))
    return math.floor(1.0 / math.log(growth)) if growth > 1.0 else 0


def _within_stops(plant: PlantParameters) -> list[float]:
    """Return the largest deviation of each joint from upright to stay clear of its stops; 0 without stops."""
    widths = []
    for goal, joint in zip(plant.coordinates.goal, plant.joints, strict=True):
        ways = [abs(stop - goal) for stop in (joint.lower_stop, joint.upper_stop) if stop is not None]
        widths.append(_KEPT_CLEAR * min(ways) if ways else 0.0)
    return widths
