"""Controllers that follow a stored swing-up of several joints, with the LQR that catches it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pendulum_lqr.swing_up.catch import MechanismCatch, make_mechanism_catch
from pendulum_lqr.swing_up.mpc import MechanismMpc
from pendulum_lqr.swing_up.trajectory import MechanismTrajectory, load_trajectory
from pendulum_lqr.swing_up.tvlqr import MechanismTvlqr
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["CALM_WEIGHTS", "default_catch", "refuse_passive_friction", "stored_trajectory", "tracked_swing_up"]

CALM_WEIGHTS = ((1.0, 1.0, 1.0, 1.0), 10.0)
"""Weights of catch and tracking for two joints: the lowest gains that still catch from far."""
_TUBE = 10.0
"""Width of the tube about a swing-up: outside, replanning is better than tracking."""


def stored_trajectory(plant: PlantParameters) -> MechanismTrajectory:
    """Return the project's swing-up for a preset; ParameterError if there is none."""
    folder = Path(str(resources.files("pendulum_lqr"))) / "trajectories"
    path = folder / f"{plant.name}.json"
    if not path.is_file():
        names = ", ".join(sorted(each.stem for each in folder.glob("*.json")))
        raise ParameterError(f"no swing-up is stored for plant {plant.name!r}; expected one of {names}")
    return load_trajectory(path)


def default_catch(plant: PlantParameters) -> MechanismCatch:
    """Return the LQR that catches, with its sampled region."""
    return make_mechanism_catch(plant, *plant.weights)


def refuse_passive_friction(controller: str, plant: PlantParameters) -> None:
    """Raise ParameterError if a passive joint has dry friction, which no effort of a plan can compensate."""
    coordinates = plant.coordinates
    for index, (name, joint) in enumerate(zip(coordinates.names, plant.joints, strict=True)):
        if index not in coordinates.driven and joint.breakaway > 0.0:
            raise ParameterError(
                f"{controller} plans without dry friction, and {name} of plant {plant.name!r} is passive with "
                f"{joint.breakaway:g} {coordinates.joints[index].effort_unit}; "
                "expected 0, as of a preset's frictionless twin"
            )


def tracked_swing_up(plant: PlantParameters, period: float, *, recovers: bool = False) -> MechanismTvlqr:
    """Return the controller that follows the stored swing-up of a plant by time-varying LQR at a sampling period [s].

    If it ``recovers``, it replans outside the tube; otherwise it continues to follow.

    Raises:
        ParameterError: There is none for this plant.
    """
    # First, because sampling a region takes a second.
    swing_up = stored_trajectory(plant)
    q, r = CALM_WEIGHTS
    catch = make_mechanism_catch(plant, q, r)
    recover = MechanismMpc(period, catch) if recovers else None
    return MechanismTvlqr(period, swing_up, catch, q=q, r=r, recover=recover, tube=_TUBE)
