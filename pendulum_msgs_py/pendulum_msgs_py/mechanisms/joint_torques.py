"""The equations of a mechanism whose joints have the torques of :mod:`pendulum_msgs_py.dynamics.joint_torques`.

A plant without any has its mechanism's equations as they are, at their speed.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import FunctionType
from typing import Any

from pendulum_msgs_py.dynamics.joint_torques import joint_torque, periodic_energy
from pendulum_msgs_py.mechanisms.mechanism import TORQUES_SUFFIX, Mechanism

__all__ = ["with_torques"]


# One for each number of joints: numba does not build tuples in loops.
def loaded_1(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return the efforts with these torques, of one joint."""
    return (torque[0] + joint_torque(q[0], v[0], p[0], p[1], p[2], p[3], p[4]),)


def loaded_2(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return the efforts with these torques, of two joints."""
    first, second = p[:5], p[5:]
    return (*loaded_1(q, v, torque, first), *loaded_1(q[1:], v[1:], torque[1:], second))


def loaded_3(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return the efforts with these torques, of three joints."""
    first, others = p[:5], p[5:]
    return (*loaded_1(q, v, torque, first), *loaded_2(q[1:], v[1:], torque[1:], others))


def stored_1(q: Any, p: Any) -> Any:
    """Return the energy of the periodic torques, of one joint [J]."""
    return periodic_energy(q[0], p[1], p[2], p[3], p[4])


def stored_2(q: Any, p: Any) -> Any:
    """Return the energy of the periodic torques, of two joints [J]."""
    return stored_1(q, p) + stored_1(q[1:], p[5:])


def stored_3(q: Any, p: Any) -> Any:
    """Return the energy of the periodic torques, of three joints [J]."""
    return stored_1(q, p) + stored_2(q[1:], p[5:])


# The templates' names are those of the functions that :func:`with_torques` puts in their place.
base_forward = base_mass = base_potential = None
loaded, stored, OWN = loaded_1, stored_1, 0


def _forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    return base_forward(q, v, loaded(q, v, torque, p[OWN:]), p[:OWN])  # type: ignore[misc]


def _mass(q: Any, p: Any) -> Any:
    return base_mass(q, p[:OWN])  # type: ignore[misc]


def _potential(q: Any, p: Any) -> Any:
    return base_potential(q, p[:OWN]) + stored(q, p[OWN:])  # type: ignore[misc]


@cache
def with_torques(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism whose ``p`` ends with the ``JOINT_TORQUES`` of each joint."""
    own, count = len(mechanism.parameter_names), len(mechanism.joints)
    scope = {
        **globals(),
        "OWN": own,
        "base_forward": mechanism.forward,
        "base_mass": mechanism.mass,
        "base_potential": mechanism.potential,
        "loaded": (loaded_1, loaded_2, loaded_3)[count - 1],
        "stored": (stored_1, stored_2, stored_3)[count - 1],
    }

    def made(template: Any) -> Any:
        return FunctionType(template.__code__, scope, template.__name__)

    chain, bodies, rotors = mechanism.chain, mechanism.bodies, mechanism.rotors
    return replace(
        mechanism,
        name=mechanism.name + TORQUES_SUFFIX,
        forward=made(_forward),
        mass=made(_mass),
        potential=made(_potential),
        chain=lambda q, p: chain(q, p[:own]),
        bodies=lambda p: bodies(p[:own]),
        rotors=lambda p: rotors(p[:own]),
    )
