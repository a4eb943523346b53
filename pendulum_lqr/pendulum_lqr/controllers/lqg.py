"""LQG: discrete LQR on the state that a Kalman filter estimates from what is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, OFFSET_NOISE, Q, R
from pendulum_lqr.linear.design import Gain, Matrix
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.observer import Observer
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqg"]


class Lqg(BaseController):
    """Stationary LQG regulator for the whole linear model: motor, spring, lag and torques on their way are estimated.

    Attributes:
        gain: LQR gain on [x; torques on their way].
        hold: Torque that is fed forward at the set-point [N m].
    """

    PREDICTS = True
    BALANCES = True
    SUMMARY = "LQR on the state that a Kalman filter estimates, motor, lag, delay and constant torques included"
    PARAMETERS = (
        Q,
        R,
        ParameterSpec("angle_noise", 2e-4, "rad", "Standard deviation of a measured angle.", minimum=0.0,
                      exclusive_minimum=True),
        ParameterSpec("velocity_noise", 0.0, "rad/s", "Standard deviation of a measured velocity; 0 to use angles "
                      "alone.", minimum=0.0),
        ParameterSpec("torque_noise", 1.0, "N m", "Standard deviation of the unknown torque, held for a period.",
                      minimum=0.0, exclusive_minimum=True),
        OFFSET_NOISE,
        DELAY,
        FEEDFORWARD,
    )  # fmt: skip

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        model = linearise(plant, UPRIGHT + p["set_point"])
        super().__init__(p["effort_limit"], p["set_point"])
        self.hold = model.effort if p["feedforward"] else 0.0
        self._sampled = discretise(model, period, p["delay"])
        self._cost = sampled_cost(model, p["q"], p["r"], period, p["delay"])
        self.gain: Gain = discrete_lqr(self._sampled, *self._cost)
        self._observer = self._make_observer(model, period, p)

    def _make_observer(self, model: LinearModel, period: float, p: Mapping[str, Any]) -> Observer | None:
        """Return the Kalman filter, with the constant torque if that is observed; None where none is needed."""
        return Observer(model, period, p)

    def reset(self) -> None:
        """Forget the estimate."""
        if self._observer is not None:
            self._observer.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque for what is measured [N m]."""
        state, offset = np.array([self.error(x[0]), x[1]]), 0.0
        if self._observer is not None:
            state = self._observer.correct(float(state[0]), float(state[1]))
            offset = self._observer.offset
        held = self.hold - offset
        effort = self.clamp(held + self._beyond(state, held))
        if self._observer is not None:
            self._observer.predict(effort)
        return effort

    def _beyond(self, state: Matrix, held: float) -> float:
        """Return the torque beyond what holds, for a state of the sampled model [N m]."""
        return -float(self.gain.K @ state)

    def describe(self) -> str:
        """Return both gains."""
        filtered = "" if self._observer is None else f", {self._observer.describe()}"
        return f"K = [{', '.join(f'{value:.6f}' for value in self.gain.K)}]{filtered}"

    def take_over(self, previous: Controller) -> None:
        """Take over the estimate, moved to the new set-point."""
        if isinstance(previous, Lqg) and self._observer is not None and previous._observer is not None:
            self._observer.carry_over(previous._observer, self.set_point - previous.set_point)
