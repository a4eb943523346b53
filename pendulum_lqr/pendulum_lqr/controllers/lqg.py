"""LQG: discrete LQR on the state that a Kalman filter estimates from what is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pendulum_lqr.controller import BaseController
from pendulum_lqr.controllers.specs import DELAY, FEEDFORWARD, OFFSET_NOISE, Q, R
from pendulum_lqr.design import Gain
from pendulum_lqr.interface import Controller
from pendulum_lqr.model import linearise
from pendulum_lqr.observer import Observer
from pendulum_lqr.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqg"]


class Lqg(BaseController):
    """Stationary LQG regulator for the whole linear model: motor, spring, lag and torques on their way are estimated.

    Args:
        gain: LQR gain on [x; torques on their way].
        observer: Kalman filter, with the constant torque if that is observed.
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        hold: Torque that is fed forward at the set-point [N m].
    """

    PREDICTS = True
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

    def __init__(
        self, gain: Gain, observer: Observer, effort_limit: float, set_point: float = 0.0, hold: float = 0.0
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.observer = observer
        self.hold = hold

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Lqg:
        """Return the LQG regulator for the plant linearised at the set-point."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        sampled = discretise(model, period, p["delay"])
        gain = discrete_lqr(sampled, *sampled_cost(model, p["q"], p["r"], period, p["delay"]))
        observer = Observer(
            model,
            period,
            angle_noise=p["angle_noise"],
            velocity_noise=p["velocity_noise"],
            torque_noise=p["torque_noise"],
            offset_noise=p["offset_noise"],
            delay=p["delay"],
        )
        hold = model.effort if p["feedforward"] else 0.0
        return cls(gain, observer, p["effort_limit"], p["set_point"], hold)

    def reset(self) -> None:
        """Forget the estimate."""
        self.observer.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque for what is measured [N m]."""
        state = self.observer.correct(self.error(x[0]), x[1])
        effort = self.clamp(self.hold - self.observer.offset - float(self.gain.K @ state))
        self.observer.predict(effort)
        return effort

    def describe(self) -> str:
        """Return both gains."""
        return f"K = [{', '.join(f'{value:.6f}' for value in self.gain.K)}], {self.observer.describe()}"

    def take_over(self, previous: Controller) -> None:
        """Take over the estimate, moved to the new set-point."""
        if isinstance(previous, Lqg):
            self.observer.carry_over(previous.observer, self.set_point - previous.set_point)
