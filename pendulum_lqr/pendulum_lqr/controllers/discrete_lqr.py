"""Discrete LQR for the sampled loop, with the inputs that are still on their way as states."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, Q, R
from pendulum_lqr.design import DesignError, Gain
from pendulum_lqr.interface import Controller
from pendulum_lqr.model import linearise
from pendulum_lqr.sampled_design import DiscreteModel, discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DiscreteLqr"]

_MOST_PENDING = 100


class DiscreteLqr(BaseController):
    """Discrete LQR with delay compensation: u = u* - K [x - x*; lagged torque; torques on their way, oldest first].

    Args:
        model: Sampled model.
        gain: Gain on its state.
        equilibrium: Torque that holds the set-point, u* [N m].
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        feedforward: Whether u* is added.
    """

    PREDICTS = True
    SUMMARY = "discrete LQR for zero-order hold, with compensation of a known delay"
    PARAMETERS = (
        Q,
        R,
        DELAY,
        ParameterSpec(
            "cost",
            "sampled",
            "",
            "sampled: the continuous cost collected over each period; sum: the cost at the samples alone.",
            choices=("sampled", "sum"),
        ),
        FEEDFORWARD,
    )

    def __init__(
        self,
        model: DiscreteModel,
        gain: Gain,
        equilibrium: float,
        effort_limit: float,
        set_point: float = 0.0,
        *,
        feedforward: bool = True,
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.hold = equilibrium if feedforward else 0.0
        self._equilibrium = equilibrium
        values = [float(value) for value in gain.K]
        known = model.A.shape[0] - model.pending
        self._k0, self._k1, self._lag_gain = values[0], values[1], values[2:known]
        self._pending_gain = values[known:]
        self._lag_row = [float(value) for value in (*model.A[2, 2:], model.B[2, 0])] if known > 2 else []
        self._pending: deque[float] = deque(maxlen=len(self._pending_gain))
        self.reset()

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> DiscreteLqr:
        """Return the discrete LQR for the plant linearised at the set-point, held and delayed."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        if plant.drivetrain is not None:
            raise DesignError(
                f"plant {plant.name!r} is series elastic, and {' and '.join(model.hidden)} not measured; expected a "
                "rigid plant: use lqg, which estimates them, or lqr, whose gain does without"
            )
        delay = p["delay"] + plant.transport_delay
        if delay > _MOST_PENDING * period:
            raise DesignError(f"delay is {delay} s at a period of {period} s; expected at most {_MOST_PENDING} periods")
        sampled = discretise(model, period, p["delay"])
        if p["cost"] == "sum":
            gain = discrete_lqr(sampled, p["q"], p["r"])
        else:
            gain = discrete_lqr(sampled, *sampled_cost(model, p["q"], p["r"], period, p["delay"]))
        return cls(sampled, gain, model.effort, p["effort_limit"], p["set_point"], feedforward=p["feedforward"])

    def reset(self) -> None:
        """Start with no torque in the lag and none on its way."""
        self._lagged = -self._equilibrium
        self._pending.extend([-self._equilibrium] * len(self._pending_gain))

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        wanted = self.hold - self._k0 * self.error(x[0]) - self._k1 * x[1]
        for gain in self._lag_gain:
            wanted -= gain * self._lagged
        for gain, effort in zip(self._pending_gain, self._pending, strict=True):
            wanted -= gain * effort
        effort = self.clamp(wanted)
        # What is on its way is what was sent, limits included, as a deviation from the torque that holds.
        sent = effort - self._equilibrium
        if self._lag_row:
            moved = zip(self._lag_row, (self._lagged, *self._pending, sent), strict=True)
            self._lagged = sum(share * value for share, value in moved)
        self._pending.append(sent)
        return effort

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{', '.join(f'{value:.6f}' for value in self.gain.K)}], {len(self._pending)} torques on their way"

    def take_over(self, previous: Controller) -> None:
        """Take over the torques on their way."""
        if isinstance(previous, DiscreteLqr):
            shift = previous._equilibrium - self._equilibrium
            self._lagged = previous._lagged + shift
            self._pending.extend(effort + shift for effort in previous._pending)
