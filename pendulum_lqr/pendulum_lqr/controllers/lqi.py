"""LQR with an integral of the angle: no offset under a constant torque."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.design import Gain, integral_lqr
from pendulum_lqr.interface import Controller
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqi"]


class Lqi(BaseController):
    """LQI: u = u* - K [theta - theta*, theta_dot, integral of (theta - theta*)].

    The integral stands still while the torque is at its limit and integrating would drive it further (conditional
    integration), so that it does not wind up.

    Args:
        gain: Gain on the three states.
        period: Sampling period [s].
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        hold: Torque at the set-point [N m].
    """

    SUMMARY = "LQR with an integral state: no offset under a constant torque"
    PARAMETERS = (
        Q,
        ParameterSpec(
            "q_integral",
            100.0,
            "1/(rad s)^2",
            "Weight of the integral of the angle.",
            minimum=0.0,
            exclusive_minimum=True,
        ),
        R,
        FEEDFORWARD,
    )

    def __init__(
        self, gain: Gain, period: float, effort_limit: float, set_point: float = 0.0, hold: float = 0.0
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.period = period
        self.hold = hold
        self._k0, self._k1, self._ki = (float(value) for value in gain.K)
        self.integral = 0.0

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Lqi:
        """Return the LQI for the plant linearised at the set-point."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        hold = model.effort if p["feedforward"] else 0.0
        weights = [*p["q"], p["q_integral"]]
        return cls(integral_lqr(model, weights, p["r"]), period, p["effort_limit"], p["set_point"], hold)

    def reset(self) -> None:
        """Empty the integral."""
        self.integral = 0.0

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        error = self.error(x[0])
        integral = self.integral + self.period * error
        wanted = self.hold - self._k0 * error - self._k1 * x[1] - self._ki * integral
        effort = self.clamp(wanted)
        # wanted beyond the limit with the error's sign opposed means that integrating on would push further out.
        if wanted == effort or (wanted - effort) * error > 0.0:
            self.integral = integral
        return effort

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{self._k0:.6f}, {self._k1:.6f}, {self._ki:.6f}]"

    def take_over(self, previous: Controller) -> None:
        """Keep the torque that the integral stands for, though the gain on it has changed."""
        if isinstance(previous, Lqi):
            self.integral = previous.integral * previous._ki / self._ki
