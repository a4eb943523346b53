"""LQR with integrals, of a plant of several joints: no offset of the driven joints under a constant effort."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import winds_up, within_limits
from pendulum_lqr.controller_interface.loop_check import require_settling
from pendulum_lqr.controller_interface.sampling import require_period
from pendulum_lqr.controllers.joint_lqr import JOINT_LIMIT, SMALLER_Q, UprightController, gain_text, joint_weights
from pendulum_lqr.linear.analysis import Feedback
from pendulum_lqr.linear.design import output_lqr, with_integrals
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointLqi"]


class JointLqi(UprightController):
    """u = u* - K [q - q*, v, integrals of the driven joints' q - q*] about upright.

    As many outputs as there are efforts can be brought to where they belong, whatever constant effort disturbs: those
    of the driven joints. None winds up while its joint's effort is at its limit:
    :func:`~pendulum_lqr.controller_interface.law.winds_up`.
    """

    SUMMARY = "LQR with integrals of the driven joints: no offset of theirs under a constant effort"

    def __init__(self, plant: MechanismParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self._driven, n, m = list(plant.coordinates.driven), len(plant.joints), len(self._hold)
        self.gain = output_lqr(with_integrals(self._linear, self._driven), [*p["q"], *(p["q_integral"],) * m], p["r"])
        self._K, self._KI = self.gain.rows[:, : 2 * n], self.gain.rows[:, 2 * n :]
        self.reset()

    @classmethod
    def parameters(cls, plant: MechanismParameters) -> tuple[ParameterSpec, ...]:
        """Return weights and limit."""
        meaning = "Weight of the integral of each driven joint's deviation."
        integral = ParameterSpec("q_integral", 10.0, "", meaning, minimum=0.0, exclusive_minimum=True)
        return (*joint_weights(plant), integral, JOINT_LIMIT)

    def check(self, period: float) -> None:
        """Refuse another period than that of the design [s], and one at which it does not settle."""
        require_period("it is integrated", self.period, period)
        feedback = Feedback(np.hstack([self._K, self.period * self._KI]), tuple(self._driven))
        require_settling("lqi", self._plant, feedback, period, SMALLER_Q)

    def reset(self) -> None:
        """Empty the integrals."""
        self._integral = np.zeros(len(self._hold))

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts [N m or N]."""
        deviation = self._deviation(position)
        error = np.array([deviation[joint] for joint in self._driven])
        integral = self._integral + self.period * error
        wanted = self._hold - self._K @ [*deviation, *velocity] - self._KI @ integral
        efforts = within_limits(wanted, self.effort_limits)
        stands = list(map(winds_up, -np.diag(self._KI) * error, wanted, efforts))
        self._integral = np.where(stands, self._integral, integral)
        return efforts

    def describe(self) -> str:
        """Return the gain."""
        return f"K = [{gain_text(self.gain.rows)}]"

    def take_over(self, previous: Controller) -> None:
        """Keep the efforts that the integrals stand for, though the gain on them has changed."""
        if isinstance(previous, JointLqi):
            self._integral = np.linalg.solve(self._KI, previous._KI @ previous._integral)
