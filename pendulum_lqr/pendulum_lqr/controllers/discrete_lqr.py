"""Discrete LQR for the sampled loop, with the inputs that are still on their way as states."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller import BaseController, Controller
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.design import DesignError, Gain, discrete_lqr, discretise, sampled_cost
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DiscreteLqr"]

_MOST_PENDING = 100


class DiscreteLqr(BaseController):
    """Discrete LQR with delay compensation: u = u* - K [x - x*; torques on their way, oldest first].

    Args:
        gain: Gain on the augmented state.
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        hold: Torque at the set-point [N m].
    """

    SUMMARY = "discrete LQR for zero-order hold, with compensation of a known delay"
    PARAMETERS = (
        Q,
        R,
        ParameterSpec("delay", 0.0, "s", "Delay from state to torque, beyond the plant's own transport_delay.",
                      minimum=0.0, maximum=1.0),
        ParameterSpec("cost", "sampled", "", "sampled: the continuous cost collected over each period; sum: the cost "
                      "at the samples alone.", choices=("sampled", "sum")),
        FEEDFORWARD,
    )  # fmt: skip

    def __init__(self, gain: Gain, effort_limit: float, set_point: float = 0.0, hold: float = 0.0) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.hold = hold
        values = [float(value) for value in gain.K]
        self._k0, self._k1, self._pending_gain = values[0], values[1], values[2:]
        self._pending: deque[float] = deque([0.0] * len(self._pending_gain), maxlen=len(self._pending_gain))

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> DiscreteLqr:
        """Return the discrete LQR for the plant linearised at the set-point, held and delayed."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        delay = p["delay"] + plant.transport_delay
        if delay > _MOST_PENDING * period:
            raise DesignError(
                f"delay is {delay} s at a period of {period} s; expected at most {_MOST_PENDING} periods"
            )
        sampled = discretise(model, period, delay)
        if p["cost"] == "sum":
            gain = discrete_lqr(sampled, p["q"], p["r"])
        else:
            q, r, cross = sampled_cost(model, p["q"], p["r"], period)
            # The cross term belongs to the torque that acts in the same interval; a delayed one is a state by then.
            gain = discrete_lqr(sampled, q, r, cross if sampled.pending == 0 else None)
        hold = model.effort if p["feedforward"] else 0.0
        return cls(gain, p["effort_limit"], p["set_point"], hold)

    def reset(self) -> None:
        """Forget the torques on their way."""
        self._pending.extend([0.0] * len(self._pending_gain))

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        wanted = self.hold - self._k0 * self.error(x[0]) - self._k1 * x[1]
        for gain, effort in zip(self._pending_gain, self._pending, strict=True):
            wanted -= gain * effort
        effort = self.clamp(wanted)
        # What is on its way is what was sent, limits included, as a deviation from the holding torque.
        self._pending.append(effort - self.hold)
        return effort

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{', '.join(f'{value:.6f}' for value in self.gain.K)}], {len(self._pending)} torques on their way"

    def carry_over(self, previous: Controller) -> None:
        """Take over the torques on their way."""
        if isinstance(previous, DiscreteLqr):
            self._pending.extend(list(previous._pending))
