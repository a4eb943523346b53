"""Plants of several joints as tests want them: with a delay, and beside upright."""

from __future__ import annotations

from dataclasses import replace

from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

__all__ = ["delayed_plant", "lagging_plant", "near_upright", "without_friction"]


def delayed_plant(name: str, delay: float) -> PlantParameters:
    """Return a preset whose motors act a time after they are told [s]."""
    plant = load_mechanism(name)
    return plant.with_values({f"{joint}.transport_delay": delay for joint in plant.coordinates.driven_names})


def lagging_plant(plant: PlantParameters, lag: float) -> PlantParameters:
    """Return a plant whose motors follow with a first-order lag [s]."""
    return plant.with_values({f"{joint}.time_constant": lag for joint in plant.coordinates.driven_names})


def near_upright(plant: PlantParameters, *off: float) -> Vector:
    """Return positions that are off upright by so much [rad or m]."""
    return tuple(goal + each for goal, each in zip(plant.coordinates.goal, off, strict=True))


def without_friction(plant: PlantParameters) -> PlantParameters:
    """Return the same plant without damping and dry friction."""
    joints = tuple(replace(joint, damping=0.0, coulomb_friction=0.0, static_friction=None) for joint in plant.joints)
    return replace(plant, joints=joints)
