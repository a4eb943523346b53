"""Discrete LQR of any number of joints, with the efforts in transit as states."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.linear_feedback import LinearFeedback
from pendulum_lqr.controllers.specs import DELAY
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.observer import Observer
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DiscreteLqr", "SampledFeedback", "discrete_lqr_law"]

Array = NDArray[np.float64]

_MOST_PENDING = 100
_HOLD, _EQUILIBRIUM, _K0, _K1, _LAGS, _LAG_GAIN, _LAG_SHARE, _SENT_SHARE, _ON_THEIR_WAY, _PENDING_GAIN = range(
    OWN, OWN + 10
)
_PENDING_SHARE = _PENDING_GAIN + _MOST_PENDING
_LAGGED, _PENDING = range(2)


class SampledFeedback(LinearFeedback):
    """Feedback of the sampled model's state: measured and hidden states, and efforts in transit.

    Efforts in transit, and their effect behind a lag, follow from those sent, after limits.

    Attributes:
        observer: Estimates the state; None if all states are measured and no effort is in transit.
    """

    PREDICTS = True
    SETTLES_BY = "the loop is predicted"
    NOISE: ClassVar[Mapping[str, Any]] = {}
    """Noise assumed by the estimate, without parameters for it; empty to use measurements unfiltered."""

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.sampled = discretise(self.model, period, p["delay"])
        self.cost = sampled_cost(self.model, p["q"], p["r"], period, p["delay"])
        weights = (p["q"], p["r"]) if p.get("cost") == "sum" else self.cost
        self.gain = discrete_lqr(self.sampled, *weights)
        self.observer = self._make_observer(p)

    def _make_observer(self, p: Mapping[str, Any]) -> Observer | None:
        return Observer(self.model, self._plant.coordinates, self.period, {**p, **self.NOISE})

    def reset(self) -> None:
        """Forget the estimate."""
        super().reset()
        if self.observer is not None:
            self.observer.reset()

    def _answer(self, off: Vector, velocity: Vector) -> Vector:
        if self.observer is None:
            return self._within((self.hold + self._beyond(np.array([*off, *velocity]), self.hold)).tolist())
        state = self.observer.correct(off, velocity)
        held = self.hold - self.observer.offsets
        efforts = self._within((held + self._beyond(state, held)).tolist())
        self.observer.predict(efforts)
        return efforts

    def _beyond(self, state: Array, held: Array) -> Array:
        """Return the efforts beyond the holding ones for a state of the sampled model, without limits, shape (m,)."""
        return np.asarray(-(self.gain.K @ state))

    def take_over(self, previous: Controller) -> None:
        """Take over the estimate, moved to the new set-point."""
        if not isinstance(previous, SampledFeedback) or previous.period != self.period:
            return
        if self.observer is not None and previous.observer is not None:
            self.observer.carry_over(previous.observer)


def discrete_lqr_law(
    _t: float, angle: float, velocity: float, memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K [x - x*; lagged; in transit] within the limit [N m], as a :data:`.law.Law`.

    Its memory has the lagged torque and those in transit, oldest first, as deviations from the holding one [N m].
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
    # In transit is what was sent, after limits, as a deviation from the holding torque.
    sent = effort - numbers[_EQUILIBRIUM]
    if lags:
        memory[_LAGGED] = lagged + numbers[_SENT_SHARE] * sent
    for k in range(1, pending):
        memory[_PENDING + k - 1] = memory[_PENDING + k]
    if pending > 0:
        memory[_PENDING + pending - 1] = sent
    return effort


class DiscreteLqr(SampledFeedback):
    """Discrete LQR with delay compensation: u = u* - K [x - x*; lagged; in transit, oldest first], held."""

    SUMMARY = "discrete LQR for zero-order hold, with compensation of lag and delay"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        if (motor := "motor_angle") in self.model.states:
            raise DesignError(
                f"plant {plant.name!r} is series elastic, and {' and '.join(self.model.hidden)} not measured; expected "
                f"a rigid plant, without {motor}: use lqg, which estimates them, or lqr, whose gain does without"
            )
        if len(self.position) > 1:
            return
        if self.sampled.pending > _MOST_PENDING:
            raise DesignError(
                f"delay is {self.sampled.delay} s at a period of {period} s; expected at most {_MOST_PENDING} periods"
            )
        A, B, K, pending = self.sampled.A, self.sampled.B, self.gain.K, self.sampled.pending
        equilibrium = self.equilibrium[0]
        lags = A.shape[0] - pending > 2
        lag_gain, lag_share, sent_share = (K[2], A[2, 2], B[2, 0]) if lags else (0.0, 0.0, 0.0)
        unused = [0.0] * (_MOST_PENDING - pending)
        shares = A[2, 3:] if lags else np.zeros(pending)
        numbers = (self.hold[0], equilibrium, K[0], K[1], lags, lag_gain, lag_share, sent_share, pending)
        weights = (*K[len(K) - pending :], *unused, *shares, *unused)
        # No torque in the lag or in transit.
        self._be_law(discrete_lqr_law, (*numbers, *weights), [-equilibrium] * (1 + pending))

    @classmethod
    def own(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return delay and kind of cost."""
        meaning = "sampled: the continuous cost collected over each period; sum: the cost at the samples alone."
        return (DELAY, ParameterSpec("cost", "sampled", "", meaning, choices=("sampled", "sum")))

    def describe(self) -> str:
        """Return gain and number of efforts in transit."""
        return f"{super().describe()}, {self.sampled.pending} efforts on their way"

    def take_over(self, previous: Controller) -> None:
        """Take over the efforts in transit."""
        super().take_over(previous)
        if isinstance(previous, DiscreteLqr) and self.law is not None is not previous.law:
            shift = previous.numbers[_EQUILIBRIUM] - self.numbers[_EQUILIBRIUM]
            lagged, *pending = (effort + shift for effort in previous.memory)
            self.memory[_LAGGED] = lagged
            kept = min(len(pending), len(self.memory) - _PENDING)
            if kept:
                self.memory[-kept:] = pending[-kept:]
