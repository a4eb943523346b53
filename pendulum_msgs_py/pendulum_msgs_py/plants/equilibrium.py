"""Equilibria of a plant, holding torques and slow motion, with offsets, motor and gears.

Angles theta are measured ones, 0 hanging down [rad]; torques are commands unless noted [N m].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES, periodic_torque
from pendulum_msgs_py.dynamics.rigid import gravity_torque
from pendulum_msgs_py.dynamics.series_elastic import (
    feedforward_pwm,
    shorted_winding_damping,
    winding_current,
    winding_resistance_at,
)
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.friction_terms import friction_of_terms
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "FixedPoint",
    "RigidPlant",
    "command_pwm",
    "drivetrain_of",
    "equilibrium_effort",
    "fixed_points",
    "friction_effort",
    "held_torque",
    "is_overdamped",
    "offset_of",
    "overdamped_velocity",
    "resistance_of",
    "torque_gain",
    "torques_of",
    "total_damping",
]


class RigidPlant(Protocol):
    """The minimum of a plant; further values of ``PlantParameters`` are used where present."""

    @property
    def inertia(self) -> float:
        """M_c [kg m^2]."""

    @property
    def damping(self) -> float:
        """b_c [N m s/rad]."""

    @property
    def gravity(self) -> float:
        """G_c [N m]."""


@dataclass(frozen=True, slots=True)
class FixedPoint:
    """Rest under a constant commanded torque.

    Attributes:
        theta: Angle in [-pi, pi) [rad].
        effort: The torque [N m].
        stable: Whether the pendulum returns after a small push; False also where both fixed points meet.
    """

    theta: float
    effort: float
    stable: bool


def drivetrain_of(plant: RigidPlant) -> SeriesElasticParameters | None:
    """Return motor, gears and spring of a plant, or None."""
    return getattr(plant, "drivetrain", None)


def offset_of(plant: RigidPlant, name: str) -> float:
    """Return a value of full plant parameters; 0 for a bare rigid plant."""
    return float(getattr(plant, name, 0.0))


def torques_of(plant: RigidPlant) -> tuple[float, ...]:
    """Return a plant's ``JOINT_TORQUES``; 0 for a bare rigid plant."""
    return tuple(offset_of(plant, name) for name in JOINT_TORQUES)


def resistance_of(drive: SeriesElasticParameters) -> float:
    """Return the resistance at the winding's temperature [ohm]."""
    return winding_resistance_at(
        drive.winding_temperature, drive.winding_resistance, drive.resistance_temperature_coefficient
    )


def command_pwm(torque: Any, drive: SeriesElasticParameters) -> Any:
    """Return the duty for a torque command: a number, also complex, or an array [-]."""
    return feedforward_pwm(
        torque,
        drive.supply_voltage,
        drive.torque_constant,
        drive.gear_ratio,
        drive.efficiency,
        drive.winding_resistance,
    )


def torque_gain(plant: RigidPlant) -> float:
    """Return the torque at the link per commanded torque, at rest [-]; 1 for a rigid plant.

    A series-elastic actuator without an effort loop applies R(20 degC) / (R(T) eta) times the command: the command is
    divided by the efficiency, but the simulated gears lose torque as friction.
    """
    drive = drivetrain_of(plant)
    if drive is None:
        return 1.0
    current = winding_current(
        command_pwm(1.0, drive),
        0.0,
        drive.supply_voltage,
        drive.back_emf_constant,
        drive.gear_ratio,
        resistance_of(drive),
    )
    return drive.torque_constant * drive.gear_ratio * current


def total_damping(plant: RigidPlant) -> float:
    """Return the viscous damping at the link in slow motion: link, motor and back EMF [N m s/rad]."""
    drive = drivetrain_of(plant)
    if drive is None:
        return plant.damping
    winding = shorted_winding_damping(
        drive.torque_constant, drive.back_emf_constant, drive.gear_ratio, resistance_of(drive)
    )
    return plant.damping + drive.motor_damping + winding


def is_overdamped(plant: RigidPlant) -> bool:
    """Return whether a plant comes to rest without overshoot: b^2 > 4 M G, motor included."""
    drive = drivetrain_of(plant)
    inertia = plant.inertia + (drive.reflected_inertia if drive is not None else 0.0)
    return total_damping(plant) ** 2 > 4.0 * inertia * plant.gravity


def held_torque(plant: RigidPlant, theta: float) -> float:
    """Return the actuator's torque on the link that holds it, G_c sin(theta - theta_0) - tau_0 - t [N m].

    t is the link's periodic torque.
    """
    # sin(math.pi) is 1.2e-16, not 0: upright must not need a torque.
    angle = theta - offset_of(plant, "angle_offset")
    weight = 0.0 if angle == UPRIGHT else gravity_torque(angle, plant.gravity)
    return weight - offset_of(plant, "torque_offset") - _periodic(plant, angle)


def equilibrium_effort(plant: RigidPlant, theta: float) -> float:
    """Return the command that holds the pendulum [N m]."""
    return held_torque(plant, theta) / torque_gain(plant)


def friction_effort(plant: PlantParameters, theta: float) -> float:
    """Return the command that overcomes sliding dry friction of link and motor [N m]."""
    drive = plant.drivetrain
    weight = abs(plant.gravity * math.sin(theta - plant.angle_offset))
    link = plant.coulomb_friction + friction_of_terms(plant, weight)
    return (link + (drive.motor_coulomb_friction if drive is not None else 0.0)) / torque_gain(plant)


def fixed_points(plant: RigidPlant, effort: float = 0.0) -> tuple[FixedPoint, ...]:
    """Return the solutions of :func:`held_torque` = gain effort, the stable ones first.

    Raises:
        ParameterError: The torque is not finite.
    """
    if not math.isfinite(effort):
        raise ParameterError(f"torque is {effort} N m; expected a finite number")
    if any(torques_of(plant)[1:]):
        return _periodic_points(plant, effort)
    if plant.gravity == 0.0:
        return ()
    ratio = (torque_gain(plant) * effort + offset_of(plant, "torque_offset")) / plant.gravity
    if abs(ratio) > 1.0:
        return ()
    low, offset = math.asin(ratio), offset_of(plant, "angle_offset")
    if abs(ratio) == 1.0:
        return (FixedPoint(wrap(low + offset), effort, stable=False),)
    return (
        FixedPoint(wrap(low + offset), effort, stable=True),
        FixedPoint(wrap(math.pi - low + offset), effort, stable=False),
    )


def _periodic(plant: RigidPlant, angle: Any, arithmetic: ModuleType = math) -> Any:
    own = torques_of(plant)[1:]
    return in_arithmetic(periodic_torque, arithmetic)(angle, *own) if any(own) else 0.0


def _periodic_points(plant: RigidPlant, effort: float) -> tuple[FixedPoint, ...]:
    """Return the fixed points of a plant with periodic torques: roots of a polynomial of degree six in e^(i theta)."""
    cos_2, sin_2, cos_3, sin_3 = torques_of(plant)[1:]
    constant = torque_gain(plant) * effort + offset_of(plant, "torque_offset")
    # a cos kx + b sin kx = (a - i b)/2 z^k + its conjugate, with z = e^(ix).
    half = [0.5 * complex(a, -b) for a, b in ((cos_3, sin_3), (cos_2, sin_2), (0.0, -plant.gravity))]
    roots = np.roots([*half, constant, *(value.conjugate() for value in reversed(half))])
    found = []
    for root in sorted(roots, key=np.angle):
        angle = float(np.angle(root))
        if abs(abs(root) - 1.0) < 1e-7:
            around = (held_torque(plant, angle + offset_of(plant, "angle_offset") + h) for h in (1e-6, -1e-6))
            found.append(
                FixedPoint(wrap(angle + offset_of(plant, "angle_offset")), effort, next(around) > next(around))
            )
    return tuple(sorted(found, key=lambda point: not point.stable))


def overdamped_velocity(plant: RigidPlant, theta: NDArray[np.float64], effort: float = 0.0) -> NDArray[np.float64]:
    """Return x' = (gain u_0 + tau_0 - G_c sin(x - theta_0)) / b, the limit of negligible inertia [rad/s].

    Raises:
        ParameterError: The plant has no damping.
    """
    damping = total_damping(plant)
    if not damping > 0.0:
        raise ParameterError(f"damping is {damping} N m s/rad; expected > 0 for the overdamped limit")
    torque = torque_gain(plant) * effort + offset_of(plant, "torque_offset")
    torque = torque + _periodic(plant, theta - offset_of(plant, "angle_offset"), np)
    return (torque - plant.gravity * np.sin(theta - offset_of(plant, "angle_offset"))) / damping
