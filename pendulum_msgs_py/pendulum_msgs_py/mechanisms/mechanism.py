"""Definition of a mechanism: joints, parameters, equations of motion, and bodies to draw and export."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["STANDARD_GRAVITY", "TORQUES_SUFFIX", "Body", "Mechanism", "Point", "Rotor", "gravity_spec", "positive"]

STANDARD_GRAVITY = 9.81
"""Default of the acceleration of gravity [m/s^2]."""

TORQUES_SUFFIX = "+torques"
"""End of the name of a mechanism with joint torques, see :mod:`pendulum_msgs_py.mechanisms.joint_torques`."""
_TILT = math.radians(25.0)
"""Elevation of the view of a spatial mechanism [rad]."""
Point = tuple[float, float, float]
"""x to the right, y away from the viewer, z up [m]."""


def positive(name: str, default: float, unit: str, description: str) -> ParameterSpec:
    """Return the spec of a parameter > 0, such as a mass or a length."""
    return ParameterSpec(name, default, unit, description, minimum=0.0, exclusive_minimum=True)


def gravity_spec() -> ParameterSpec:
    """Return the spec of the acceleration of gravity."""
    return ParameterSpec("gravity", STANDARD_GRAVITY, "m/s^2", "Acceleration of gravity, g; 0 lies flat.", minimum=0.0)


class Body(NamedTuple):
    """One rigid body, moved by one joint relative to the body before it.

    Attributes:
        name: Name in files.
        origin: Position of its joint in the frame of the body before [m].
        axis: Axis of the joint: of rotation by the right-hand rule, or of sliding.
        mass: [kg].
        centre: Centre of mass in its own frame, at joint position 0 [m].
        inertia: Principal moments about the centre of mass, along x, y, z [kg m^2].
        tip: End of the drawn rod in its own frame [m].
    """

    name: str
    origin: Point
    axis: Point
    mass: float
    centre: Point
    inertia: Point
    tip: Point


class Rotor(NamedTuple):
    """A rotor of inertia J [kg m^2] and energy J/2 (sum_i c_i q'_i)^2, with one rate c_i per joint."""

    inertia: float
    rates: tuple[float, ...]


def _no_rotors(_p: Any) -> tuple[Rotor, ...]:
    return ()


@dataclass(frozen=True)
class Mechanism:
    """Equations and joints, without numbers.

    The functions take tuples, use ``+ - * /``, ``math.sin`` and ``math.cos`` alone, and have no branches or calls: they
    run with floats, compiled by numba, and by :func:`~pendulum_msgs_py.dynamics.arithmetic.in_arithmetic` with complex
    numbers, arrays and symbols. ``p`` holds the values of ``parameters`` in order, then each joint's viscous damping.

    Attributes:
        name: Name; in plant files (``model:``) without the end for joint torques.
        title: One sentence.
        joints: n joints, in the order of messages.
        parameters: Table of its own parameters.
        forward: ``forward(q, v, torque, p) -> q''`` [rad/s^2 or m/s^2], M(q) q'' + c(q, v) + g(q) + D v = torque solved
            for q''; dry friction is part of ``torque``.
        mass: ``mass(q, p)``, rows of the mass matrix M(q), n tuples of n.
        potential: ``potential(q, p)`` [J].
        chain: ``chain(q, p)``, drawn points from base to tip [m].
        bodies: ``bodies(p)``, one :class:`Body` per joint, for URDF and MJCF.
        weights: Default diagonal of Q (deviations, then velocities) and of R.
        source: Publication of the equations.
        rotors: ``rotors(p)``, unless each motor's inertia is part of its link's.
        in_space: Whether it leaves the plane of x and z, so that pictures show it from slightly above.
    """

    name: str
    title: str
    joints: tuple[Joint, ...]
    parameters: tuple[ParameterSpec, ...]
    forward: Callable[[Any, Any, Any, Any], Any]
    mass: Callable[[Any, Any], Any]
    potential: Callable[[Any, Any], Any]
    chain: Callable[[Any, Any], tuple[Point, ...]]
    bodies: Callable[[Any], tuple[Body, ...]]
    weights: tuple[tuple[float, ...], float]
    source: str
    rotors: Callable[[Any], tuple[Rotor, ...]] = _no_rotors
    in_space: bool = False

    def __hash__(self) -> int:
        return hash(self.name)  # quick: mechanisms are looked up for each plant

    @property
    def model(self) -> str:
        """Name in plant files, without joint torques."""
        return self.name.removesuffix(TORQUES_SUFFIX)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of ``p``; the damping is ``JOINT.damping``, of a single joint ``damping``."""
        torques = JOINT_TORQUES if self.name != self.model else ()
        prefixes = [f"{joint.name}." for joint in self.joints] if len(self.joints) > 1 else [""]
        own = (f"{prefix}{name}" for prefix in prefixes for name in torques)
        return (*(spec.name for spec in self.parameters), *(f"{prefix}damping" for prefix in prefixes), *own)

    def seen(self, point: Point) -> tuple[float, float]:
        """Return a point's place in a picture, to the right and up [m]; in space it is seen from slightly above."""
        x, y, z = point
        return (x, z * math.cos(_TILT) + y * math.sin(_TILT)) if self.in_space else (x, z)
