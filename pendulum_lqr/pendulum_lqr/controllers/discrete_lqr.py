"""Discrete LQR for the sampled loop, with the inputs that are still on their way as states."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, Q, R
from pendulum_lqr.linear.design import DesignError, Gain
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DiscreteLqr", "discrete_lqr_law"]

_MOST_PENDING = 100
_HOLD, _EQUILIBRIUM, _K0, _K1, _LAGS, _LAG_GAIN, _LAG_SHARE, _SENT_SHARE, _ON_THEIR_WAY, _PENDING_GAIN = range(
    OWN, OWN + 10
)
_PENDING_SHARE = _PENDING_GAIN + _MOST_PENDING
_LAGGED, _PENDING = range(2)


def discrete_lqr_law(
    _t: float, angle: float, velocity: float, memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K [x - x*; lagged; on their way] within the limit [N m], as a :data:`.law.Law`.

    It remembers the lagged torque and those on their way, oldest first, as deviations from the one that holds [N m].
    """
    error = deviation(angle, numbers[SET_POINT])
    lags = numbers[_LAGS] != 0.0
    wanted = numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity
    if lags:
        wanted -= numbers[_LAG_GAIN] * memory[_LAGGED]
    lagged = numbers[_LAG_SHARE] * memory[_LAGGED]
    pending = int(numbers[_ON_THEIR_WAY])
    for k in range(pending):
        wanted -= numbers[_PENDING_GAIN + k] * memory[_PENDING + k]
        lagged += numbers[_PENDING_SHARE + k] * memory[_PENDING + k]
    effort = clamped(wanted, numbers[EFFORT_LIMIT])
    # What is on its way is what was sent, limits included, as a deviation from the torque that holds.
    sent = effort - numbers[_EQUILIBRIUM]
    if lags:
        memory[_LAGGED] = lagged + numbers[_SENT_SHARE] * sent
    for k in range(1, pending):
        memory[_PENDING + k - 1] = memory[_PENDING + k]
    if pending > 0:
        memory[_PENDING + pending - 1] = sent
    return effort


class DiscreteLqr(LawController):
    """Discrete LQR with delay compensation: u = u* - K [x - x*; lagged torque; torques on their way, oldest first]."""

    PREDICTS = True
    BALANCES = True
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

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        linear = linearise(plant, UPRIGHT + p["set_point"])
        if plant.drivetrain is not None:
            raise DesignError(
                f"plant {plant.name!r} is series elastic, and {' and '.join(linear.hidden)} not measured; expected a "
                "rigid plant: use lqg, which estimates them, or lqr, whose gain does without"
            )
        delay = p["delay"] + plant.transport_delay
        if delay > _MOST_PENDING * period:
            raise DesignError(f"delay is {delay} s at a period of {period} s; expected at most {_MOST_PENDING} periods")
        model = discretise(linear, period, p["delay"])
        cost = sampled_cost(linear, p["q"], p["r"], period, p["delay"])
        self.gain: Gain = discrete_lqr(model, *((p["q"], p["r"]) if p["cost"] == "sum" else cost))
        K, pending = self.gain.K, model.pending
        self.hold = linear.effort if p["feedforward"] else 0.0
        lags = model.A.shape[0] - pending > 2
        lag_gain, lag_share, sent_share = (K[2], model.A[2, 2], model.B[2, 0]) if lags else (0.0, 0.0, 0.0)
        unused = [0.0] * (_MOST_PENDING - pending)
        shares = model.A[2, 3:] if lags else np.zeros(pending)
        numbers = (self.hold, linear.effort, K[0], K[1], lags, lag_gain, lag_share, sent_share, pending)
        weights = (*K[len(K) - pending :], *unused, *shares, *unused)
        # No torque in the lag and none on its way.
        at_first = [-linear.effort] * (1 + pending)
        super().__init__(discrete_lqr_law, p["effort_limit"], p["set_point"], (*numbers, *weights), at_first)

    def describe(self) -> str:
        """Return the gain."""
        gains = ", ".join(f"{value:.6f}" for value in self.gain.K)
        return f"K = [{gains}], {len(self.memory) - _PENDING} torques on their way"

    def take_over(self, previous: Controller) -> None:
        """Take over the torques on their way."""
        if isinstance(previous, DiscreteLqr):
            shift = previous.numbers[_EQUILIBRIUM] - self.numbers[_EQUILIBRIUM]
            lagged, *pending = (effort + shift for effort in previous.memory)
            self.memory[_LAGGED] = lagged
            kept = min(len(pending), len(self.memory) - _PENDING)
            if kept:
                self.memory[-kept:] = pending[-kept:]
