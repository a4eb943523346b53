"""What the simulator's node steps: a plant of n joints of which m are driven, one joint being n = m = 1."""

from __future__ import annotations

import math

import numpy as np

from pendulum_msgs_py.contract.joints import ONE_JOINT, Vector
from pendulum_sim.stepping.mechanism_plant import MechanismPlant, MechanismState
from pendulum_sim.stepping.plant import Plant, PlantState

__all__ = ["JointPlant", "OneJoint", "joint_plant", "random_start"]

_SLIDE = 0.1
"""Largest distance from the middle at which a joint that slides starts at random [m]."""


class OneJoint:
    """A plant of one joint, its numbers as tuples."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.dt = plant.dt
        self.name = plant.parameters.name
        self.coordinates = ONE_JOINT
        self.stops = ((-math.inf, math.inf),)
        self.effort_limits = (plant.parameters.effort_limit,)
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


JointPlant = MechanismPlant | OneJoint
"""A plant whose states and efforts are tuples in the order of its joints."""


def joint_plant(plant: Plant | MechanismPlant) -> JointPlant:
    """Return a plant of any number of joints as one that takes and gives tuples."""
    return plant if isinstance(plant, MechanismPlant) else OneJoint(plant)


def random_start(plant: JointPlant, generator: np.random.Generator) -> tuple[Vector, Vector]:
    """Return positions and velocities of a start: in a turn, or near the middle, between stops; at most 1 rad/s."""
    joints = plant.coordinates.joints
    position = []
    for joint, (low, high) in zip(joints, plant.stops, strict=True):
        reach = math.pi if joint.turns else _SLIDE
        position.append(generator.uniform(min(max(-reach, low), high), max(min(reach, high), low)))
    return tuple(position), tuple(generator.uniform(-1.0, 1.0) for _ in joints)


def _as_tuples(state: PlantState) -> MechanismState:
    time, theta, theta_dot, effort = state
    return MechanismState(time, (theta,), (theta_dot,), (effort,))
