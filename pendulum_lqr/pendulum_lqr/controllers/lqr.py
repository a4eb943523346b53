"""Linear quadratic regulator: u = u* - K (x - x*)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.design import Gain, output_lqr
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqr"]


class Lqr(BaseController):
    """Continuous LQR, sampled: the controller of the thesis.

    Where the plant has states that are not measured, K is the best gain on angle and velocity.

    Args:
        gain: Gain and Riccati solution.
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        hold: Torque at the set-point, u* [N m].
    """

    SUMMARY = "linear quadratic regulator of the thesis, u = u* - K (x - x*)"
    PARAMETERS: ClassVar[tuple[ParameterSpec, ...]] = (Q, R, FEEDFORWARD)

    def __init__(self, gain: Gain, effort_limit: float, set_point: float = 0.0, hold: float = 0.0) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.hold = hold
        # Plain floats: indexing an array of two on every state costs more than the law itself.
        self._k0, self._k1 = (float(value) for value in gain.K)

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Lqr:
        """Return the LQR for the plant linearised at the set-point."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        hold = model.effort if p["feedforward"] else 0.0
        return cls(output_lqr(model, p["q"], p["r"]), p["effort_limit"], p["set_point"], hold)

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        return self.clamp(self.hold - self._k0 * self.error(x[0]) - self._k1 * x[1])

    def describe(self) -> str:
        """Return gain and poles."""
        poles = ", ".join(f"{pole:.4g}" for pole in self.gain.poles)
        return f"K = [{self._k0:.6f}, {self._k1:.6f}], poles {poles} 1/s"
