"""LQG of a plant of several joints: the discrete LQR on the state that a Kalman filter estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Stationary LQG regulator about upright: positions are filtered, velocities and lagged efforts come from them.

        x[k+1] = A x[k] + B u[k - delay] + E w[k],   y = [q - q*, v] + noise,

    with w an unknown effort on every joint, at a driven one added to the command, held for a period.
    """

    SUMMARY = "discrete LQR on the state that a Kalman filter estimates from positions"

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        n = len(plant.joints)
        entry = self._linear.E.copy()
        entry[:, list(plant.coordinates.driven)] = self._linear.B
        disturbed = discretise(replace(self._linear, B=entry, delay=0.0), period).B
        rows = 2 * n if p["velocity_noise"] > 0.0 else n
        variances = np.repeat([p["position_noise"] ** 2, p["velocity_noise"] ** 2], n)[:rows]
        process = p["effort_noise"] ** 2 * (disturbed @ disturbed.T)
        self.filter = kalman_gain(self._A, np.eye(rows, len(self._A)), process, np.diag(variances))
        self._rows = rows

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

    def _state(self, position: Vector, velocity: Vector) -> Array:
        """Return the estimate; the first velocity is always used."""
        measured = super()._state(position, velocity)
        if self._predicted is None:
            return measured
        surprise = measured - self._predicted
        n = len(position)
        surprise[:n] = self._deviation(measured[:n].tolist(), self._predicted[:n].tolist())
        return np.asarray(self._predicted + self.filter.L @ surprise[: self._rows])

    def describe(self) -> str:
        """Return both gains."""
        return f"K = [{gain_text(self._K)}], L = [{gain_text(self.filter.L.T)}]"
