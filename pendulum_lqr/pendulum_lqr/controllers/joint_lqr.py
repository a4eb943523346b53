"""Linear quadratic regulator of a plant of several joints: u = u* - K [q - q*, v] about upright."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import within_limits
from pendulum_lqr.controller_interface.loop_check import require_settling
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.swing_up.mechanism_catch import MechanismCatch
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = [
    "JOINT_LIMIT",
    "SMALLER_Q",
    "JointLqr",
    "UprightController",
    "gain_text",
    "joint_limits",
    "joint_weights",
    "require_catching",
]

JOINT_LIMIT = ParameterSpec(
    "effort_limit", 0.0, "N m", "Largest effort of each driven joint; 0 for the plant's own.", minimum=0.0
)
"""A limit for all driven joints, in addition to their own."""
SMALLER_Q = "a faster plant, or a smaller q"
"""What helps a gain that does not settle, where its weights can be chosen."""


def joint_weights(plant: MechanismParameters) -> tuple[ParameterSpec, ParameterSpec]:
    """Return the weights of an LQR, with those of the plant as defaults."""
    q, r = plant.mechanism.weights
    names = ", ".join(plant.coordinates.names)
    meaning = f"Diagonal of Q: weights of {names}, then of their velocities."
    return (
        ParameterSpec("q", list(q), "", meaning, minimum=0.0),
        ParameterSpec("r", r, "", "Weight of each effort, R.", minimum=0.0, exclusive_minimum=True),
    )


def joint_limits(plant: MechanismParameters, limit: float) -> Vector:
    """Return the largest effort of each driven joint: its own, and the controller's where that is not 0 [N m or N]."""
    return tuple(min(limit or math.inf, own) for own in plant.effort_limits)


def require_catching(controller: str, catch: MechanismCatch, period: float) -> None:
    """Refuse an LQR that would not hold the plant upright at a period [s], lag and delay included.

    Raises:
        DesignError: It does not settle.
    """
    require_settling(controller, catch.plant, Feedback(catch.gain.K), period, "a faster plant")


def gain_text(rows: Iterable[Iterable[float]]) -> str:
    """Return the rows of a gain for a line of text."""
    return "; ".join(", ".join(f"{value:.6g}" for value in row) for row in rows)


class UprightController(Controller):
    """Feedback of all deviations about upright, by the linear model there.

    Args:
        plant: The plant.
        p: Checked parameters.
        period: Sampling period [s].

    Raises:
        ParameterError: There is no such feedback for these weights.
    """

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(joint_limits(plant, p["effort_limit"]))
        self.period = period
        self._plant = plant
        self._linear = linearise(plant)
        self._hold = np.array(self._linear.efforts)
        self._deviation = plant.coordinates.deviation

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights and limit."""
        return (*joint_weights(plant), JOINT_LIMIT)


class JointLqr(UprightController):
    """Continuous LQR of n joints, sampled."""

    SUMMARY = "continuous LQR, sampled"
    SAMPLED = False

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.gain = output_lqr(self._linear, p["q"], p["r"])
        # Plain floats: indexing an array on every state costs more than the law itself.
        self._rows = tuple(tuple(float(value) for value in row) for row in self.gain.rows)

    def check(self, period: float) -> None:
        """Refuse a period at which it does not settle [s]."""
        require_settling("lqr", self._plant, Feedback(self.gain.K), period, SMALLER_Q)

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts."""
        x = self._deviation(position) + velocity
        wanted = (
            hold - sum(k * value for k, value in zip(row, x, strict=True))
            for row, hold in zip(self._rows, self._linear.efforts, strict=True)
        )
        return within_limits(wanted, self.effort_limits)

    def describe(self) -> str:
        """Return gain and poles."""
        poles = ", ".join(f"{pole:.4g}" for pole in self.gain.poles)
        return f"K = [{gain_text(self._rows)}], poles {poles} 1/s"
