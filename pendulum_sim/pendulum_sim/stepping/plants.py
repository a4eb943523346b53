"""The plant of a parameter file: n joints of which m are driven, stepped with tuples or, as one joint, with numbers."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.mechanism_plant import MechanismPlant, MechanismState
from pendulum_sim.stepping.plant import Plant, PlantState, RigidPlant
from pendulum_sim.stepping.series_elastic import SeriesElasticPlant

__all__ = ["JointPlant", "OneJoint", "make_pendulum", "make_plant", "random_start"]

_SLIDE = 0.1
"""Largest distance of a sliding joint's random start from the middle [m]."""


class OneJoint:
    """A plant of one joint with tuples."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.parameters, self.dt = plant.parameters, plant.dt
        self._step = plant.step

    @property
    def state(self) -> MechanismState:
        """The present state."""
        return _as_tuples(self.plant.state)

    def reset(self, position: Vector, velocity: Vector) -> MechanismState:
        """Restart at an angle [rad] and a velocity [rad/s]."""
        return _as_tuples(self.plant.reset(position[0], velocity[0]))

    def step(self, effort: Vector, push: Vector) -> MechanismState:
        """Advance by one period under a commanded torque and a torque on the link [N m]."""
        time, theta, theta_dot, torque = self._step(effort[0], push[0])
        return MechanismState(time, (theta,), (theta_dot,), (torque,))


class JointPlant(Protocol):
    """A plant of n joints of which m are driven."""

    parameters: PlantParameters
    dt: float

    @property
    def state(self) -> MechanismState:
        """The present state."""

    def reset(self, position: Vector, velocity: Vector) -> MechanismState:
        """Restart at n positions [rad or m] and velocities."""

    def step(self, effort: Vector, push: Vector) -> MechanismState:
        """Advance by one period under m commanded efforts, and n efforts on the joints themselves [N m or N]."""


def make_plant(
    parameters: PlantParameters, dt: float, *, method: str = "auto", substeps: int | None = None
) -> JointPlant:
    """Return the plant that the parameters describe, with commands held over dt [s].

    Of one joint its scalar equations are stepped, by a ``method`` of ``integrators.METHODS``; ``auto`` is ``etd4``, or
    for a series-elastic plant ``semi_implicit``, its only one. With several joints it is ``auto``. ``substeps`` None is
    1, or for a series-elastic plant steps of at most 0.25 ms.

    Raises:
        ParameterError: The method does not fit the plant, or an argument is outside its domain.
    """
    if parameters.is_pendulum:
        return OneJoint(make_pendulum(parameters, dt, method=method, substeps=substeps))
    if method != "auto":
        raise ParameterError(
            f"method is {method!r}; expected auto: plant {parameters.name!r} has several joints, which are integrated "
            "by Runge-Kutta of order four"
        )
    return MechanismPlant(parameters, dt, substeps=substeps or 1)


def make_pendulum(
    parameters: PlantParameters, dt: float, *, method: str = "auto", substeps: int | None = None
) -> Plant:
    """Return a plant of one joint, whose states are numbers; arguments and errors as :func:`make_plant`."""
    if parameters.drivetrain is None:
        return RigidPlant(
            parameters, dt, method="etd4" if method == "auto" else method, substeps=1 if substeps is None else substeps
        )
    if method not in {"auto", "semi_implicit"}:
        raise ParameterError(
            f"method is {method!r}; expected semi_implicit or auto, since plant {parameters.name!r} is series elastic"
        )
    return SeriesElasticPlant(parameters, dt, substeps=substeps)


def random_start(plant: JointPlant, generator: np.random.Generator) -> tuple[Vector, Vector]:
    """Return a random start: within a turn, or near the middle, between stops; at most 1 rad/s or m/s."""
    joints = plant.parameters.coordinates.joints
    position = []
    for joint, (low, high) in zip(joints, plant.parameters.stops, strict=True):
        reach = math.pi if joint.turns else _SLIDE
        position.append(generator.uniform(min(max(-reach, low), high), max(min(reach, high), low)))
    return tuple(position), tuple(generator.uniform(-1.0, 1.0) for _ in joints)


def _as_tuples(state: PlantState) -> MechanismState:
    time, theta, theta_dot, effort = state
    return MechanismState(time, (theta,), (theta_dot,), (effort,))
