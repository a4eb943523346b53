"""LQG: discrete LQR on the state that a Kalman filter estimates from measured angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pendulum_lqr.controller import BaseController, Controller
from pendulum_lqr.controllers.specs import FEEDFORWARD, Q, R
from pendulum_lqr.design import (
    DiscreteModel,
    Gain,
    KalmanGain,
    discrete_lqr,
    discretise,
    kalman_gain,
    sampled_cost,
)
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Lqg"]


class Lqg(BaseController):
    """Stationary LQG regulator; only the angle is measured.

    Args:
        model: Sampled model without delay, around the set-point.
        gain: LQR gain.
        kalman: Filter gain, shape (2, 1).
        effort_limit: Largest torque [N m].
        set_point: Angle from upright [rad].
        hold: Torque at the set-point [N m].
    """

    SUMMARY = "LQR on the state that a Kalman filter estimates from angles alone"
    PARAMETERS = (
        Q,
        R,
        ParameterSpec("angle_noise", 2e-4, "rad", "Standard deviation of a measured angle.", minimum=0.0,
                      exclusive_minimum=True),
        ParameterSpec("torque_noise", 1.0, "N m", "Standard deviation of the unknown torque, held for a period.",
                      minimum=0.0, exclusive_minimum=True),
        FEEDFORWARD,
    )  # fmt: skip

    def __init__(
        self,
        model: DiscreteModel,
        gain: Gain,
        kalman: KalmanGain,
        effort_limit: float,
        set_point: float = 0.0,
        hold: float = 0.0,
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.gain = gain
        self.kalman = kalman
        self.hold = hold
        self._k0, self._k1 = (float(value) for value in gain.K)
        self._l0, self._l1 = (float(value) for value in kalman.L[:, 0])
        self._a = tuple(float(value) for value in model.A.ravel())
        self._b = (float(model.B[0, 0]), float(model.B[1, 0]))
        self._angle: float | None = None
        self._velocity = 0.0

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Lqg:
        """Return the LQG regulator for the plant linearised at the set-point."""
        model = linearise(plant, UPRIGHT + p["set_point"])
        sampled = discretise(model, period)
        q, r, cross = sampled_cost(model, p["q"], p["r"], period)
        drive = sampled.B * p["torque_noise"]
        kalman = kalman_gain(sampled.A, np.array([[1.0, 0.0]]), drive @ drive.T, [[p["angle_noise"] ** 2]])
        hold = model.effort if p["feedforward"] else 0.0
        return cls(
            sampled, discrete_lqr(sampled, q, r, cross), kalman, p["effort_limit"], p["set_point"], hold
        )

    def reset(self) -> None:
        """Forget the estimate."""
        self._angle, self._velocity = None, 0.0

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque for the measured angle; the measured velocity serves the first sample only [N m]."""
        measured = self.error(x[0])
        if self._angle is None:
            angle, velocity = measured, x[1]
        else:
            innovation = wrap(measured - self._angle)
            angle = self._angle + self._l0 * innovation
            velocity = self._velocity + self._l1 * innovation
        effort = self.clamp(self.hold - self._k0 * angle - self._k1 * velocity)
        a00, a01, a10, a11 = self._a
        torque = effort - self.hold
        self._angle = a00 * angle + a01 * velocity + self._b[0] * torque
        self._velocity = a10 * angle + a11 * velocity + self._b[1] * torque
        return effort

    def describe(self) -> str:
        """Return both gains."""
        return f"K = [{self._k0:.6f}, {self._k1:.6f}], L = [{self._l0:.6f}, {self._l1:.6f}]"

    def carry_over(self, previous: Controller) -> None:
        """Take over the estimate, moved to the new set-point."""
        if isinstance(previous, Lqg) and previous._angle is not None:
            self._angle = wrap(previous._angle + previous.set_point - self.set_point)
            self._velocity = previous._velocity
