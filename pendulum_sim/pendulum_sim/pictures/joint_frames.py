"""Positions and axes of a plant's joints in space, from the bodies of URDF and MJCF."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.mechanisms import Body
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JointFrame", "across", "full_effort", "joint_frames"]

Array = NDArray[np.float64]


class JointFrame(NamedTuple):
    """A joint at a position of the plant; x to the right, y away from the viewer, z up.

    Attributes:
        origin: Position of the joint, of a slide where it has slid to [m].
        axis: Axis of rotation by the right-hand rule, or of sliding.
        right: Unit vector from which a positive angle turns.
        up: Unit vector towards which it turns.
        tip: End of the rod that the joint moves [m].
    """

    origin: Array
    axis: Array
    right: Array
    up: Array
    tip: Array


def joint_frames(parameters: PlantParameters, position: Vector) -> tuple[JointFrame, ...]:
    """Return the frame of each joint at n positions [rad or m]."""
    frames = []
    turned, at = np.eye(3), np.zeros(3)
    for body, joint, q in zip(
        parameters.mechanism.bodies(parameters.packed), parameters.mechanism.joints, position, strict=True
    ):
        at = at + turned @ np.array(body.origin)
        right, up = (turned @ way for way in across(body))
        axis = turned @ np.array(body.axis)
        if joint.unit == "m":
            at = at + q * axis
        else:
            basis = np.stack((right, up, axis), axis=1)
            cos, sin = np.cos(q), np.sin(q)
            turned = basis @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ basis.T @ turned
        frames.append(JointFrame(at, axis, right, up, at + turned @ np.array(body.tip)))
    return tuple(frames)


def across(body: Body) -> tuple[Array, Array]:
    """Return unit vectors across a joint's axis, in the body before; a positive angle turns one towards the other."""
    axis = np.array(body.axis)
    right = np.array([0.0, 1.0, 0.0]) if abs(axis[0]) > abs(axis[1]) else np.array([1.0, 0.0, 0.0])
    return right, np.cross(axis, right)


def full_effort(parameters: PlantParameters, index: int) -> float:
    """Return the effort of a full arc: the joint's limit, or for a passive joint the strongest motor's."""
    own = parameters.joints[index].actuator
    return own.effort_limit if own is not None else max(parameters.effort_limits, default=1.0)
