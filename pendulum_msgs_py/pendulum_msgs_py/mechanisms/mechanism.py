"""What a mechanism is: joints, parameters, equations of motion, and bodies to draw and export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["STANDARD_GRAVITY", "Body", "Mechanism", "Point", "Rotor", "gravity_spec", "positive"]

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity where a plant file gives none [m/s^2]."""

Point = tuple[float, float, float]
"""x to the right, y away from the viewer, z up [m]."""


def positive(name: str, default: float, unit: str, description: str) -> ParameterSpec:
    """Return a parameter that must be above zero, as a mass or a length."""
    return ParameterSpec(name, default, unit, description, minimum=0.0, exclusive_minimum=True)


def gravity_spec() -> ParameterSpec:
    """Return the parameter that every mechanism with masses has: the acceleration of gravity; 0 lies flat."""
    return ParameterSpec("gravity", STANDARD_GRAVITY, "m/s^2", "Acceleration of gravity, g; 0 lies flat.", minimum=0.0)


class Body(NamedTuple):
    """One rigid body, moved by one joint against the body before it.

    Attributes:
        name: Its name in files.
        origin: Where its joint sits, in the frame of the body before [m].
        axis: Axis of the joint: of rotation by the right-hand rule, or of sliding.
        mass: [kg].
        centre: Centre of mass in the body's own frame, at joint position 0 [m].
        inertia: Principal moments about the centre of mass, along x, y, z [kg m^2].
        tip: End of the rod that is drawn, in the body's own frame [m].
    """

    name: str
    origin: Point
    axis: Point
    mass: float
    centre: Point
    inertia: Point
    tip: Point


class Rotor(NamedTuple):
    """A rotor that turns with a sum of joint velocities, sum_i c_i q'_i, and adds J/2 times its square to the energy.

    Attributes:
        inertia: J [kg m^2].
        rates: c_i, one per joint [-].
    """

    inertia: float
    rates: tuple[float, ...]


def _no_rotors(_p: Any) -> tuple[Rotor, ...]:
    return ()


@dataclass(frozen=True)
class Mechanism:
    """Equations and joints, without numbers.

    The functions take tuples, use ``+ - * /`` and ``math.sin`` and ``math.cos`` alone, and have no branches: they run
    with floats, and by :func:`~pendulum_msgs_py.dynamics.arithmetic.in_arithmetic` with complex numbers, arrays and
    casadi's symbols; numba compiles them too. ``p`` holds the values of ``parameters`` in their order, then the viscous
    damping of each joint.

    Attributes:
        name: Its name in plant files (``model:``).
        title: What it is, one sentence.
        joints: n joints, in the order of messages.
        parameters: Table of its own parameters.
        forward: ``forward(q, v, torque, p) -> q''``; M(q) q'' + c(q, v) + g(q) + D v = torque, solved for q''. Smooth:
            dry friction is part of ``torque`` [rad/s^2 or m/s^2].
        mass: ``mass(q, p)``, the rows of the mass matrix M(q), n tuples of n.
        potential: ``potential(q, p)`` [J].
        chain: ``chain(q, p)``, points from the base to the tip, to draw [m].
        bodies: ``bodies(p)``, one :class:`Body` per joint, for URDF and MJCF.
        weights: Diagonal of Q [deviation of each joint, then velocity of each] and of R, where a design has none.
        source: Where the equations are published.
        rotors: ``rotors(p)``, what turns with more than one joint, or faster than its own; none where a motor's inertia
            is part of its link's.
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

    def __hash__(self) -> int:
        """Return a hash that is quick: tables of mechanisms are looked up for each plant."""
        return hash(self.name)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of ``p``: the parameters, then ``JOINT.damping`` of each joint, of one ``damping``."""
        damping = [f"{joint.name}.damping" for joint in self.joints] if len(self.joints) > 1 else ["damping"]
        return (*(spec.name for spec in self.parameters), *damping)
