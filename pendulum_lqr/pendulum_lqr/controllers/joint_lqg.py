"""LQG of a plant of several joints: the discrete LQR on the state that a Kalman filter estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.interface import Controller, JointController
from pendulum_lqr.controllers.joint_discrete_lqr import JointDiscreteLqr
from pendulum_lqr.controllers.joint_lqr import JOINT_LIMIT, gain_text, joint_weights
from pendulum_lqr.linear.design import kalman_gain
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointLqg"]

Array = NDArray[np.float64]


class JointLqg(JointDiscreteLqr):
    """Stationary LQG regulator about upright: positions are filtered, velocities come from them.

        x[k+1] = A x[k] + B u[k - delay] + E w[k],   y = [q - q*, v] + noise,

    with w an unknown effort on every joint, held for a period.
    """

    SUMMARY = "discrete LQR on the state that a Kalman filter estimates from positions"

    def __init__(self, plant: MechanismParameters, p: Mapping[str, Any], period: float) -> None:
        super().__init__(plant, p, period)
        n = len(plant.joints)
        disturbed = discretise(replace(self._linear, B=self._linear.E, delay=0.0), period).B
        rows = 2 * n if p["velocity_noise"] > 0.0 else n
        self._A, self._late = self.model.A[: 2 * n, : 2 * n], self.model.A[: 2 * n, 2 * n :]
        self._B = self.model.B[: 2 * n]
        variances = np.repeat([p["position_noise"] ** 2, p["velocity_noise"] ** 2], n)[:rows]
        process = p["effort_noise"] ** 2 * (disturbed @ disturbed.T)
        self.filter = kalman_gain(self._A, np.eye(rows, 2 * n), process, np.diag(variances))
        self._rows = rows
        self._predicted: Array | None = None

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights, noise and limit."""
        return (
            *joint_weights(plant),
            ParameterSpec("position_noise", 2e-4, "", "Standard deviation of a measured position [rad or m].",
                          minimum=0.0, exclusive_minimum=True),
            ParameterSpec("velocity_noise", 0.0, "", "Standard deviation of a measured velocity [rad/s or m/s]; 0 to "
                          "use positions alone.", minimum=0.0),
            ParameterSpec("effort_noise", 0.1, "", "Standard deviation of the unknown effort on every joint, held for "
                          "a period [N m or N].", minimum=0.0, exclusive_minimum=True),
            JOINT_LIMIT,
        )  # fmt: skip

    def reset(self) -> None:
        """Forget the estimate and what was sent."""
        super().reset()
        self._predicted = None

    def _state(self, position: Vector, velocity: Vector) -> Array:
        """Return the estimate; the first velocity is always believed."""
        measured = super()._state(position, velocity)
        if self._predicted is None:
            return measured
        surprise = measured - self._predicted
        n = len(position)
        surprise[:n] = self._deviation(measured[:n].tolist(), self._predicted[:n].tolist())
        return np.asarray(self._predicted + self.filter.L @ surprise[: self._rows])

    def _move_on(self, x: Array, moving: Array, sent: Array) -> None:
        predicted = self._A @ x + self._late @ moving + self._B @ sent
        # What was measured beyond all bounds once must not be remembered for ever.
        self._predicted = predicted if np.isfinite(predicted).all() else None
        super()._move_on(x, moving, sent)

    def describe(self) -> str:
        """Return both gains."""
        return f"K = [{gain_text(self._K)}], L = [{gain_text(self.filter.L.T)}]"

    def carry_over(self, previous: Controller | JointController) -> None:
        """Take over the estimate and what is on its way."""
        super().carry_over(previous)
        if isinstance(previous, JointLqg) and previous.period == self.period:
            self._predicted = previous._predicted
