"""Linear quadratic regulator of any number of joints: u = u* - K (x - x*)."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any

from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.linear_feedback import LinearFeedback
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import output_lqr
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqr", "lqr_law"]

_HOLD, _K0, _K1 = range(OWN, OWN + 3)


def lqr_law(
    _t: float, angle: float, velocity: float, _memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K (x - x*) within the limit [N m], as a :data:`.law.Law`."""
    error = deviation(angle, numbers[SET_POINT])
    return clamped(numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity, numbers[EFFORT_LIMIT])


class Lqr(LinearFeedback):
    """Continuous LQR, sampled: of one joint the controller of the thesis.

    With hidden states, K is the best gain on positions and velocities.
    """

    SAMPLED = False
    SUMMARY = "linear quadratic regulator of the thesis, u = u* - K (x - x*)"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.gain = output_lqr(self.model, p["q"], p["r"])
        self.feedback = Feedback(self.gain.K)
        self._be_law(lqr_law, (self.hold[0], *self.gain.rows[0]))
        # Floats: indexing arrays on every state costs more than the law itself.
        self._rows = tuple(tuple(map(float, row)) for row in self.gain.rows)
        self._hold = tuple(map(float, self.hold))

    def _answer(self, off: Vector, velocity: Vector) -> Vector:
        x = off + velocity
        return self._within(
            [
                hold - sum([k * value for k, value in zip(row, x, strict=True)])
                for row, hold in zip(self._rows, self._hold, strict=True)
            ]
        )

    def describe(self) -> str:
        """Return gain and poles."""
        poles = ", ".join(f"{pole:.4g}" for pole in self.gain.poles)
        return f"{super().describe()}, poles {poles} 1/s"
