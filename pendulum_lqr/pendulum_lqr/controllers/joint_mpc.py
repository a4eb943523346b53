"""Linear MPC of a plant of several joints: the LQR about upright that knows its limits and the ends of a track."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from pendulum_lqr.condensed_mpc import CondensedMpc
from pendulum_lqr.controllers.joint_lqr import JOINT_LIMIT, joint_limits, joint_weights
from pendulum_lqr.interface import Controller, JointController
from pendulum_lqr.mechanism_controller import within_limits
from pendulum_lqr.mechanism_model import linearise_mechanism
from pendulum_lqr.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_lqr.sampling import ASSUMED_PERIOD, differs
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointMpc"]

_KEPT_CLEAR = 0.95
"""Share of the way to an end stop that a plan may use."""
_DEAR = 10.0
"""Cost of a position beyond its limit, in the largest weight of a deviation: a pole must not fall for a track's end."""


class JointMpc(JointController):
    """Minimises the LQR's cost over N samples plus its cost to go, under limits of efforts and positions.

    The prediction is that of the linear model about upright, efforts on their way included: those that it sent itself.
    Without active limits the answer is that of the discrete LQR. Limits of efforts are hard, those of positions soft.

    Args:
        plant: The plant.
        p: Checked parameters.
        period: Sampling period [s].
    """

    SUMMARY = "linear MPC with limits of efforts and positions (OSQP)"

    def __init__(self, plant: MechanismParameters, p: Mapping[str, Any], period: float) -> None:
        super().__init__(joint_limits(plant, p["effort_limit"]))
        model = linearise_mechanism(plant)
        sampled = discretise(model, period)
        cost = sampled_cost(model, p["q"], p["r"], period)
        self.period = period
        self.gain = discrete_lqr(sampled, *cost)
        self.failures = 0
        self._deviation = plant.coordinates.deviation
        self._hold = np.array(model.efforts)
        self._position_limits = _position_limits(plant, p["position_limits"])
        limits = {joint: width for joint, width in enumerate(self._position_limits) if width}
        self._program = CondensedMpc(
            sampled, self.gain, cost[1], int(p["horizon"]), limits, self.effort_limits, _DEAR * max(p["q"])
        )
        self._on_their_way: deque[Vector] = deque([(0.0,) * len(self._hold)] * sampled.pending, sampled.pending)

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights, horizon and limits; positions are limited where the plant has end stops."""
        names = ", ".join(plant.coordinates.names)
        meaning = f"Largest deviations of {names} from upright; 0 for none."
        limits = ParameterSpec("position_limits", _within_stops(plant), "", meaning, minimum=0.0)
        horizon = ParameterSpec("horizon", 50, "-", "Samples of the horizon.", minimum=1, maximum=200)
        return (*joint_weights(plant), horizon, limits, JOINT_LIMIT)

    @classmethod
    def design(cls, plant: MechanismParameters, p: Mapping[str, Any], period: float | None) -> JointMpc:
        """Return the MPC for the plant linearised at upright."""
        return cls(plant, p, ASSUMED_PERIOD if period is None else period)

    def check(self, period: float) -> None:
        """Refuse another period than that of the design [s].

        Raises:
            ParameterError: as said.
        """
        if differs(period, self.period):
            raise ParameterError(f"mpc predicts every {self.period:g} s; expected states at that period")

    @property
    def notice(self) -> str:
        """How often the solver found no plan."""
        return f"no plan for {self.failures} states: the LQR answered" if self.failures else ""

    def reset(self) -> None:
        """Forget the plan and what was sent."""
        self._program.reset()
        self._on_their_way.extend([(0.0,) * len(self._hold)] * len(self._on_their_way))

    def command(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the first efforts of the plan; the limited LQR's where the solver finds none [N m or N]."""
        limits = np.array(self.effort_limits)
        state = np.array([*self._deviation(position), *velocity, *(u for sent in self._on_their_way for u in sent)])
        plan = self._program.first(state, -limits - self._hold, limits - self._hold)
        if plan is None:
            self.failures += 1
            plan = -np.atleast_2d(self.gain.K) @ state
        efforts = within_limits(self._hold + plan, self.effort_limits)
        self._on_their_way.append(tuple(effort - hold for effort, hold in zip(efforts, self._hold, strict=True)))
        return efforts

    def describe(self) -> str:
        """Return horizon, limits and unlimited gain."""
        rows = "; ".join(", ".join(f"{value:.6g}" for value in row) for row in np.atleast_2d(self.gain.K))
        within = ", ".join(f"{width:g}" if width else "none" for width in self._position_limits)
        return f"horizon {self._program.horizon}, positions within [{within}], K without limits [{rows}]"

    def carry_over(self, previous: Controller | JointController) -> None:
        """Take over what is on its way."""
        if isinstance(previous, JointMpc) and previous.period == self.period:
            self._on_their_way.extend(previous._on_their_way)


def _within_stops(plant: MechanismParameters) -> list[float]:
    """Return how far each joint may go from upright to keep clear of its stops; 0 where it has none."""
    widths = []
    for goal, joint in zip(plant.coordinates.goal, plant.joints, strict=True):
        ways = [abs(stop - goal) for stop in (joint.lower_stop, joint.upper_stop) if stop is not None]
        widths.append(_KEPT_CLEAR * min(ways) if ways else 0.0)
    return widths


def _position_limits(plant: MechanismParameters, given: list[float]) -> list[float]:
    if len(given) != len(plant.joints):
        raise ParameterError(
            f"position_limits has {len(given)} values; expected {len(plant.joints)}, for "
            f"{', '.join(plant.coordinates.names)}"
        )
    return given
