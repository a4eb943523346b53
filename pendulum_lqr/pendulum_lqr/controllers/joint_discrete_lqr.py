"""Discrete linear quadratic regulator of a plant of several joints, with the efforts on their way as states."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import within_limits
from pendulum_lqr.controller_interface.sampling import require_period
from pendulum_lqr.controllers.joint_lqr import UprightController, gain_text
from pendulum_lqr.linear.sampled_design import discrete_lqr, discretise, sampled_cost
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointDiscreteLqr"]

Array = NDArray[np.float64]


class JointDiscreteLqr(UprightController):
    """u = u* - K [q - q*, v, lagged efforts, efforts on their way, oldest first] about upright, held over each period.

    What is on its way, and what has come of it behind a lag, follows from what it sent itself, limits included.
    """

    SUMMARY = "discrete LQR for zero-order hold, with compensation of the plant's lag and delay"

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.model = discretise(self._linear, period)
        self.cost = sampled_cost(self._linear, p["q"], p["r"], period)
        self.gain = discrete_lqr(self.model, *self.cost)
        self._K = self.gain.rows
        size = len(self._linear.states)
        self._A, self._late, self._B = self.model.A[:size, :size], self.model.A[:size, size:], self.model.B[:size]
        self._on_their_way: deque[Vector] = deque(maxlen=self.model.pending)
        JointDiscreteLqr.reset(self)

    def check(self, period: float) -> None:
        """Refuse another period than that of the design [s]."""
        require_period("the loop is predicted", self.period, period)

    def reset(self) -> None:
        """Forget what was sent."""
        self._on_their_way.extend([(0.0,) * len(self._hold)] * self.model.pending)
        self._predicted: Array | None = None

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts [N m or N]."""
        x = self._state(position, velocity)
        moving = [u for sent in self._on_their_way for u in sent]
        efforts = within_limits(self._hold + self._wanted(np.array([*x, *moving])), self.effort_limits)
        sent = np.array(efforts) - self._hold
        predicted = self._A @ x + self._late @ np.array(moving) + self._B @ sent
        # What was measured beyond all bounds once must not be remembered for ever.
        self._predicted = predicted if np.isfinite(predicted).all() else None
        self._on_their_way.append(tuple(sent))
        return efforts

    def _state(self, position: Vector, velocity: Vector) -> Array:
        """Return [q - q*, v, lagged efforts beyond those that hold]: what is measured, and predicted behind it."""
        x = np.zeros(len(self._A)) if self._predicted is None else self._predicted.copy()
        x[: 2 * len(position)] = (*self._deviation(position), *velocity)
        return x

    def _wanted(self, state: Array) -> Array:
        """Return the efforts beyond those that hold upright, limits left out, shape (m,)."""
        return -self._K @ state

    def describe(self) -> str:
        """Return gain and efforts on their way."""
        return f"K = [{gain_text(self._K)}], {len(self._on_their_way)} efforts on their way"

    def take_over(self, previous: Controller) -> None:
        """Take over what is on its way, and what is predicted."""
        if isinstance(previous, JointDiscreteLqr) and previous.period == self.period:
            self._on_their_way.extend(previous._on_their_way)
            if previous._A.shape == self._A.shape:
                self._predicted = previous._predicted
