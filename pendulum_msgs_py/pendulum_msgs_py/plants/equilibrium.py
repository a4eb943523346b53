"""Where a plant can stay, what holds it there, and how it creeps: offsets, motor and gears included."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
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
    "total_damping",
]


class RigidPlant(Protocol):
    """The least that a plant has to have; what ``PlantParameters`` adds to it is used where present."""

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
    """Angle at which the pendulum rests under a constant torque.

    Attributes:
        theta: Measured angle, 0 hanging down, in [-pi, pi) [rad].
        effort: The constant torque, as commanded [N m].
        stable: Whether the pendulum returns to it after a small push; False at a tip of the torque curve too, where
            what comes from one side is held and from the other passes.
    """

    theta: float
    effort: float
    stable: bool


def drivetrain_of(plant: RigidPlant) -> SeriesElasticParameters | None:
    """Return motor, gears and spring of a plant that has them."""
    return getattr(plant, "drivetrain", None)


def offset_of(plant: RigidPlant, name: str) -> float:
    """Return a value that only whole plant parameters have; 0 for a bare rigid plant."""
    return float(getattr(plant, name, 0.0))


def resistance_of(drive: SeriesElasticParameters) -> float:
    """Return the resistance of the winding at its temperature [ohm]."""
    return winding_resistance_at(
        drive.winding_temperature, drive.winding_resistance, drive.resistance_temperature_coefficient
    )


def command_pwm(torque: Any, drive: SeriesElasticParameters) -> Any:
    """Return the duty for a torque command [N m], a number, also a complex one, or an array [-]."""
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

    A series-elastic actuator without an effort loop applies R(20 degC) / (R(T) eta) times the commanded torque: the
    command is divided by the efficiency, and the simulated gears lose their share as friction and not by it.

    Args:
        plant: Plant parameters.
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
    """Return all viscous damping at the link in slow motion: its own, the motor's and that of the back EMF [N m s/rad].

    Args:
        plant: Plant parameters.
    """
    drive = drivetrain_of(plant)
    if drive is None:
        return plant.damping
    winding = shorted_winding_damping(
        drive.torque_constant, drive.back_emf_constant, drive.gear_ratio, resistance_of(drive)
    )
    return plant.damping + drive.motor_damping + winding


def is_overdamped(plant: RigidPlant) -> bool:
    """Return whether a plant creeps to rest without swinging past it: b^2 > 4 M G, motor included.

    Args:
        plant: Plant parameters.
    """
    drive = drivetrain_of(plant)
    inertia = plant.inertia + (drive.reflected_inertia if drive is not None else 0.0)
    return total_damping(plant) ** 2 > 4.0 * inertia * plant.gravity


def held_torque(plant: RigidPlant, theta: float) -> float:
    """Return the torque of the actuator on the link that holds it at an angle, G_c sin(theta - theta_0) - tau_0 [N m].

    Args:
        plant: Plant parameters.
        theta: Measured angle, 0 hanging down [rad].
    """
    # sin(math.pi) is 1.2e-16, not 0: upright must not need a torque.
    angle = theta - offset_of(plant, "angle_offset")
    weight = 0.0 if angle == UPRIGHT else gravity_torque(angle, plant.gravity)
    return weight - offset_of(plant, "torque_offset")


def equilibrium_effort(plant: RigidPlant, theta: float) -> float:
    """Return the command that holds the pendulum at an angle [N m].

    Args:
        plant: Plant parameters.
        theta: Measured angle, 0 hanging down [rad].
    """
    return held_torque(plant, theta) / torque_gain(plant)


def friction_effort(plant: PlantParameters, theta: float) -> float:
    """Return the command that sliding dry friction takes at an angle, of link and motor together [N m].

    Args:
        plant: Plant parameters.
        theta: Measured angle, 0 hanging down [rad].
    """
    drive = plant.drivetrain
    weight = abs(plant.gravity * math.sin(theta - plant.angle_offset))
    link = plant.coulomb_friction + friction_of_terms(plant, weight)
    return (link + (drive.motor_coulomb_friction if drive is not None else 0.0)) / torque_gain(plant)


def fixed_points(plant: RigidPlant, effort: float = 0.0) -> tuple[FixedPoint, ...]:
    """Return the fixed points under a constant torque: the stable one first, one at the tip of the curve, or none.

    They solve G_c sin(theta - angle_offset) = gain effort + torque_offset.

    Args:
        plant: Plant parameters.
        effort: Constant commanded torque [N m].

    Raises:
        ParameterError: The torque is not finite.
    """
    if not math.isfinite(effort):
        raise ParameterError(f"torque is {effort} N m; expected a finite number")
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


def overdamped_velocity(plant: RigidPlant, theta: NDArray[np.float64], effort: float = 0.0) -> NDArray[np.float64]:
    """Return x' = (gain u_0 + tau_0 - G_c sin(x - theta_0)) / b, the velocity where damping outweighs inertia [rad/s].

    Args:
        plant: Plant parameters; damping > 0, of link and motor together.
        theta: Measured angles, any shape [rad].
        effort: Constant commanded torque u_0 [N m].

    Raises:
        ParameterError: The plant has no damping, so that the limit does not exist.
    """
    damping = total_damping(plant)
    if not damping > 0.0:
        raise ParameterError(f"damping is {damping} N m s/rad; expected > 0 for the overdamped limit")
    torque = torque_gain(plant) * effort + offset_of(plant, "torque_offset")
    return (torque - plant.gravity * np.sin(theta - offset_of(plant, "angle_offset"))) / damping
