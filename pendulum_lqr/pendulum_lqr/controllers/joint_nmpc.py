"""Nonlinear MPC of a plant of several joints: from anywhere to upright, planned anew as it goes, then LQR."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pendulum_lqr.controllers.joint_lqr import require_catching
from pendulum_lqr.interface import JointController
from pendulum_lqr.mechanism_controllers import default_catch, refuse_passive_friction
from pendulum_lqr.mechanism_mpc import MechanismMpc
from pendulum_lqr.sampling import ASSUMED_PERIOD, require_period
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["JointNmpc"]


class JointNmpc(JointController):
    """Plans by iterative LQR over 1.4 s, every 20 ms, and hands over to the LQR in the region from which it catches.

    It is compiled when it is designed, so that its first answer is not late.

    Args:
        plant: The plant.
        period: Sampling period [s].
    """

    SUMMARY = "nonlinear MPC by iterative LQR, then LQR; swings up from anywhere"

    DESIGNING = "compiles its model, which takes some ten seconds"

    def __init__(self, plant: MechanismParameters, period: float) -> None:
        super().__init__(plant.effort_limits)
        self.period = period
        self._inner = MechanismMpc(plant, period, default_catch(plant))
        self._inner.command(0.0, (0.0,) * (2 * len(plant.joints)))
        self._inner.reset()

    @classmethod
    def design(cls, plant: MechanismParameters, p: Mapping[str, Any], period: float | None) -> JointNmpc:
        """Return the controller for a plant whose passive joints have no dry friction.

        Raises:
            ParameterError: One has: plans leave it out, and no effort can make up for it there.
        """
        refuse_passive_friction("nmpc", plant)
        return cls(plant, ASSUMED_PERIOD if period is None else period)

    def check(self, period: float) -> None:
        """Refuse another period than that of the design [s], and one at which its LQR does not settle.

        Raises:
            ParameterError: as said.
        """
        require_period("nmpc plans for answers", self.period, period)
        require_catching("nmpc", self._inner.catch, self.period)

    def reset(self) -> None:
        """Forget the plan."""
        self._inner.reset()

    def command(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts."""
        return self._inner.command(t, position + velocity)

    def describe(self) -> str:
        """Return its horizon, and from where the LQR catches."""
        plan = self._inner.settings.plan
        return (
            f"plans of {plan.nodes * plan.step:.3g} s by iterative LQR, then LQR within "
            f"{self._inner.catch.region.describe()}"
        )
