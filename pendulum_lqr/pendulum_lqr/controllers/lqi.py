"""LQR with integrals of the driven joints: no offset of theirs under a constant effort."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation, winds_up
from pendulum_lqr.controllers.linear_feedback import LinearFeedback
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import output_lqr, with_integrals
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqi", "lqi_law"]

_HOLD, _K0, _K1, _KI, _PERIOD = range(OWN, OWN + 5)
_INTEGRAL = 0


def lqi_law(
    _t: float, angle: float, velocity: float, memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K [x - x*; integral] within the limit [N m], as a :data:`.law.Law`; memory: the integral [rad s]."""
    error = deviation(angle, numbers[SET_POINT])
    integral = memory[_INTEGRAL] + numbers[_PERIOD] * error
    wanted = numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity - numbers[_KI] * integral
    effort = clamped(wanted, numbers[EFFORT_LIMIT])
    if not winds_up(-numbers[_KI] * error, wanted, effort):
        memory[_INTEGRAL] = integral
    return effort


class Lqi(LinearFeedback):
    """LQI: u = u* - K [q - q*, v, integrals of the driven joints' q - q*].

    Integrals remove the offset of as many outputs as there are efforts, here the driven joints. None winds up while its
    joint's effort is at its limit: :func:`~pendulum_lqr.controller_interface.law.winds_up`.
    """

    SETTLES_BY = "it is integrated"
    SUMMARY = "LQR with an integral of each driven joint: no offset of theirs under a constant effort"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self._driven = list(plant.coordinates.driven)
        weights = [*p["q"], *(p["q_integral"],) * len(self._driven)]
        self.gain = output_lqr(with_integrals(self.model, self._driven), weights, p["r"])
        k = self.gain.rows.shape[1] - len(self._driven)
        self._K, self._KI = self.gain.rows[:, :k], self.gain.rows[:, k:]
        self.feedback = self._feedback(period)
        numbers = (self.hold[0], *self.gain.rows[0, :2], self._KI[0, 0], period)
        self._be_law(lqi_law, numbers, (0.0,) * len(self._driven))

    @classmethod
    def own(cls, plant: PlantParameters | None) -> tuple[ParameterSpec, ...]:
        """Return the weight of the integrals."""
        several = plant is not None and not plant.is_pendulum
        default, unit, whose = (10.0, "", "each driven joint's deviation") if several else (
            100.0, "1/(rad s)^2", "the angle")  # fmt: skip
        meaning = f"Weight of the integral of {whose}."
        return (ParameterSpec("q_integral", default, unit, meaning, minimum=0.0, exclusive_minimum=True),)

    def _feedback(self, period: float) -> Feedback:
        return Feedback(np.hstack([self._K, period * self._KI]), tuple(self._driven))

    def _answer(self, off: Vector, velocity: Vector) -> Vector:
        error = np.array([off[joint] for joint in self._driven])
        integral = np.array(self.memory) + self.period * error
        wanted = self.hold - self._K @ [*off, *velocity] - self._KI @ integral
        efforts = self._within(wanted)
        stands = list(map(winds_up, -np.diag(self._KI) * error, wanted, efforts))
        self.memory = np.where(stands, self.memory, integral).tolist()
        return efforts

    def take_over(self, previous: Controller) -> None:
        """Preserve the efforts of the integrals under the new gain."""
        if isinstance(previous, Lqi):
            self.memory[:] = np.linalg.solve(self._KI, previous._KI @ previous.memory).tolist()
