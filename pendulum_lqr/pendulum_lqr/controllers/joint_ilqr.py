"""Swing-up of several joints planned at start: iterative LQR, TVLQR along it, then LQR."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pendulum_lqr.controllers.joint_swing_up import JointSwingUp
from pendulum_lqr.controllers.linear_feedback import JOINT_LIMIT, joint_limits
from pendulum_lqr.swing_up.catch import MechanismCatch, make_mechanism_catch
from pendulum_lqr.swing_up.ilqr import IlqrWeights
from pendulum_lqr.swing_up.stored_swing_up import refuse_passive_friction
from pendulum_lqr.swing_up.trajectory import MechanismTrajectory, SwingUpSearch, cheapest_swing_up
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JointIlqr"]

_WEIGHTS = IlqrWeights(far=1.0, energy=0.0, effort=0.02, rate=1e-4, velocity=5e-3, terminal=10.0)


class JointIlqr(JointSwingUp):
    """From hanging along the cheapest swing-up found by iterative LQR from random guesses.

    The search runs once, at design: nothing is planned while the plant moves.

    Raises:
        ParameterError: A passive joint has dry friction, or no guess ends upright within limits and end stops.
    """

    SUMMARY = "swing-up planned by iterative LQR when it starts, followed by TVLQR, then LQR"
    NAME = "ilqr"
    DESIGNING = "compiles its model and searches a swing-up, which takes some ten seconds"

    @classmethod
    def parameters(cls, plant: PlantParameters) -> tuple[ParameterSpec, ...]:
        """Return parameters of the search, and the limit."""
        return (
            ParameterSpec(
                "guesses", 16, "-", "Random guesses from which a swing-up is searched.", minimum=1, maximum=1000
            ),
            ParameterSpec("duration", 4.0, "s", "Longest swing-up.", minimum=1.5, maximum=20.0),
            JOINT_LIMIT,
        )

    def _find(self, plant: PlantParameters, p: Mapping[str, Any]) -> tuple[MechanismCatch, MechanismTrajectory]:
        refuse_passive_friction("ilqr", plant)
        catch = make_mechanism_catch(plant, *plant.weights, joint_limits(plant, p["effort_limit"]))
        search = SwingUpSearch(_WEIGHTS, duration=p["duration"])
        return catch, cheapest_swing_up(catch, search, range(p["guesses"]))[0]
