"""Linear MPC of a plant of several joints: the LQR about upright under limits of efforts and of a track."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controllers.joint_discrete_lqr import JointDiscreteLqr
from pendulum_lqr.controllers.joint_lqr import JOINT_LIMIT, gain_text, joint_weights
from pendulum_lqr.linear.condensed_mpc import CondensedMpc
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointMpc"]

Array = NDArray[np.float64]

_KEPT_CLEAR = 0.95
"""Share of the way to an end stop that a plan may use."""
_DEAR = 10.0
"""Cost of a position beyond its limit, in the largest weight of a deviation: a pole must not fall for a track's end."""


class JointMpc(JointDiscreteLqr):
    """Minimises the LQR's cost over N samples plus its cost to go, under limits of efforts and positions.

    The prediction is that of the linear model about upright, efforts on their way included. Without active limits the
    command is that of the discrete LQR. Limits of efforts are hard, those of positions soft.
    """

    SUMMARY = "linear MPC with limits of efforts and positions (OSQP)"

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.failures = 0
        self._position_limits = p["position_limits"]
        if len(self._position_limits) != len(plant.joints):
            raise ParameterError(
                f"position_limits has {len(self._position_limits)} values; expected {len(plant.joints)}, for "
                f"{', '.join(plant.coordinates.names)}"
            )
        limits = {joint: width for joint, width in enumerate(self._position_limits) if width}
        self._program = CondensedMpc(
            self.model, self.gain, self.cost[1], int(p["horizon"]), limits, self.effort_limits, _DEAR * max(p["q"])
        )
        self._enough = _enough_samples(self.model.A) if limits else 0
        self._warn()

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights, horizon and limits; positions are limited where the plant has end stops."""
        names = ", ".join(plant.coordinates.names)
        meaning = f"Largest deviations of {names} from upright; 0 for none."
        limits = ParameterSpec("position_limits", _within_stops(plant), "", meaning, minimum=0.0)
        horizon = ParameterSpec("horizon", 50, "-", "Samples of the horizon.", minimum=1, maximum=200)
        return (*joint_weights(plant), horizon, limits, JOINT_LIMIT)

    def _warn(self) -> None:
        """Note that the horizon is too short, and how often the solver found no plan."""
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
        """Forget the plan and what was sent."""
        super().reset()
        self._program.reset()

    def _wanted(self, state: Array) -> Array:
        """Return the first efforts of the plan; the LQR's where the solver finds none."""
        limits = np.array(self.effort_limits)
        plan = self._program.first(state, -limits - self._hold, limits - self._hold)
        if plan is None:
            self.failures += 1
            self._warn()
            return super()._wanted(state)
        return plan

    def describe(self) -> str:
        """Return horizon, limits and unlimited gain."""
        within = ", ".join(f"{width:g}" if width else "none" for width in self._position_limits)
        return f"horizon {self._program.horizon}, positions within [{within}], K without limits [{gain_text(self._K)}]"


def _enough_samples(A: Array) -> int:
    """Return the samples in which what falls grows by e: behind a shorter horizon no limit of an effort is seen."""
    growth = float(np.max(np.abs(np.linalg.eigvals(A))))
    return math.floor(1.0 / math.log(growth)) if growth > 1.0 else 0


def _within_stops(plant: MechanismParameters) -> list[float]:
    """Return how far each joint may go from upright to keep clear of its stops; 0 where it has none."""
    widths = []
    for goal, joint in zip(plant.coordinates.goal, plant.joints, strict=True):
        ways = [abs(stop - goal) for stop in (joint.lower_stop, joint.upper_stop) if stop is not None]
        widths.append(_KEPT_CLEAR * min(ways) if ways else 0.0)
    return widths
