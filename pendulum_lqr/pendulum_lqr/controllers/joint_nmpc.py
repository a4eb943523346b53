"""Nonlinear MPC of several joints: from any state to upright, replanned continuously, then LQR."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pendulum_lqr.controllers.joint_swing_up import CaughtController
from pendulum_lqr.swing_up.mpc import PLAN, MechanismMpc
from pendulum_lqr.swing_up.stored_swing_up import default_catch, refuse_passive_friction
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JointNmpc"]


class JointNmpc(CaughtController):
    """Plans by iterative LQR over 1.4 s, every 20 ms, and hands over to the LQR in its region.

    It is compiled at design time, so that its first command is not late.

    Raises:
        ParameterError: A passive joint has dry friction, which plans neglect and no effort can compensate.
    """

    SUMMARY = "nonlinear MPC by iterative LQR, then LQR; swings up from anywhere"
    NAME = "nmpc"
    EVERY_STATE = "nmpc plans for answers"
    DESIGNING = "compiles its model, which takes some ten seconds"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        refuse_passive_friction("nmpc", plant)
        inner = MechanismMpc(period, default_catch(plant))
        super().__init__(inner, period)
        still = (0.0,) * len(plant.joints)
        inner.efforts(0.0, still, still)
        inner.reset()

    def describe(self) -> str:
        """Return its horizon, and the LQR's region."""
        length = PLAN.nodes * PLAN.step
        return f"plans of {length:.3g} s by iterative LQR, then LQR within {self._inner.catch.region.describe()}"
