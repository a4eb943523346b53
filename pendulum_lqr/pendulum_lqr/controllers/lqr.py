"""Linear quadratic regulator: u = u* - K (x - x*)."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence
from typing import Any, ClassVar

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.law import EFFORT_LIMIT, OWN, SET_POINT, clamped, deviation
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import Gain, output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqr", "lqr_law"]

_HOLD, _K0, _K1 = range(OWN, OWN + 3)


def lqr_law(
    _t: float, angle: float, velocity: float, _memory: MutableSequence[float], numbers: Sequence[float]
) -> float:
    """Return u* - K (x - x*) within the limit [N m]; see :data:`pendulum_lqr.controller_interface.law.Law`."""
    error = deviation(angle, numbers[SET_POINT])
    return clamped(numbers[_HOLD] - numbers[_K0] * error - numbers[_K1] * velocity, numbers[EFFORT_LIMIT])


class Lqr(LawController):
    """Continuous LQR, sampled: the controller of the thesis.

    Where the plant has states that are not measured, K is the best gain on angle and velocity.
    """

    SAMPLED = False
    BALANCES = True
    SUMMARY = "linear quadratic regulator of the thesis, u = u* - K (x - x*)"
    PARAMETERS: ClassVar[tuple[ParameterSpec, ...]] = (Q, R, FEEDFORWARD)

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        model = linearise(plant, UPRIGHT + p["set_point"])
        self.gain: Gain = output_lqr(model, p["q"], p["r"])
        self.feedback = Feedback(self.gain.K)
        hold = model.effort if p["feedforward"] else 0.0
        super().__init__(lqr_law, p["effort_limit"], p["set_point"], (hold, *self.gain.K))

    def describe(self) -> str:
        """Return gain and poles."""
        poles = ", ".join(f"{pole:.4g}" for pole in self.gain.poles)
        return f"K = [{self.gain.K[0]:.6f}, {self.gain.K[1]:.6f}], poles {poles} 1/s"
