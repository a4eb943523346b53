"""LQR with integrals, of a plant of several joints: no offset of the driven joints under a constant effort."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.interface import Controller, JointController
from pendulum_lqr.controller_interface.sampling import require_period
from pendulum_lqr.controllers.joint_lqr import (
    JOINT_LIMIT,
    SMALLER_Q,
    UprightController,
    gain_text,
    joint_weights,
    require_settling,
)
from pendulum_lqr.linear.mechanism_model import mechanism_lqr
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.swing_up.mechanism_controller import within_limits
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointLqi"]


class JointLqi(UprightController):
    """u = u* - K [q - q*, v, integrals of the driven joints' q - q*] about upright.

    As many outputs as there are efforts can be brought to where they belong, whatever constant effort disturbs: those
    of the driven joints. All integrals stand still while an effort is at its limit, so that they do not wind up.
    """

    SUMMARY = "LQR with integrals of the driven joints: no offset of theirs under a constant effort"

    def __init__(self, plant: MechanismParameters, p: Mapping[str, Any], period: float) -> None:
        super().__init__(plant, p, period)
        self._driven = plant.coordinates.driven
        self._model = _with_integrals(self._linear, self._driven)
        self.gain = mechanism_lqr(self._model, [*p["q"], *(p["q_integral"],) * len(self._driven)], p["r"])
        self._integral = np.zeros(len(self._hold))

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights and limit."""
        meaning = "Weight of the integral of each driven joint's deviation."
        integral = ParameterSpec("q_integral", 10.0, "", meaning, minimum=0.0, exclusive_minimum=True)
        return (*joint_weights(plant), integral, JOINT_LIMIT)

    def check(self, period: float) -> None:
        """Refuse another period than that of the design [s], and one at which it does not settle."""
        require_period("it is integrated", self.period, period)
        require_settling("lqi", self._plant.name, self._model, self.gain, period, SMALLER_Q)

    def reset(self) -> None:
        """Empty the integrals."""
        self._integral = np.zeros(len(self._hold))

    def command(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts [N m or N]."""
        deviation = self._deviation(position)
        integral = self._integral + self.period * np.array([deviation[joint] for joint in self._driven])
        wanted = self._hold - self.gain.K @ np.array([*deviation, *velocity, *integral])
        efforts = within_limits(wanted, self.effort_limits)
        if all(abs(effort) <= limit for effort, limit in zip(wanted, self.effort_limits, strict=True)):
            self._integral = integral
        return efforts

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{gain_text(self.gain.K)}]"

    def carry_over(self, previous: Controller | JointController) -> None:
        """Keep the efforts that the integrals stand for, though the gain on them has changed."""
        if isinstance(previous, JointLqi):
            m = len(self._hold)
            self._integral = np.linalg.solve(self.gain.K[:, -m:], previous.gain.K[:, -m:] @ previous._integral)


def _with_integrals(model: LinearModel, driven: tuple[int, ...]) -> LinearModel:
    """Return the model with the integrals of the driven joints' deviations as its last states."""
    size, m = model.B.shape
    A = np.zeros((size + m, size + m))
    A[:size, :size] = model.A
    for index, joint in enumerate(driven):
        A[size + index, joint] = 1.0
    B = np.vstack([model.B, np.zeros((m, m))])
    E = np.vstack([model.E, np.zeros((m, model.E.shape[1]))])
    names = (*model.states, *(f"integral of {model.states[joint]}" for joint in driven))
    return replace(model, A=A, B=B, C=np.eye(size + m), E=E, states=names)
