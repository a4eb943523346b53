"""The pendulum linearised about a fixed point.

``M_c theta'' + b_c theta' + G_c sin(theta) = u`` with the state x = [theta - theta*, theta'] and the input u - u*,
where u* = G_c sin(theta*) holds the pendulum at theta*:

    A = [[0, 1], [-G_c cos(theta*) / M_c, -b_c / M_c]],   B = [0, 1 / M_c]

Only the smooth part of the plant is linearised: dry friction has no derivative at rest, so designs neglect it and the
nonlinear closed loop, simulated, tells what it costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "FixedPoint",
    "LinearModel",
    "RigidPlant",
    "equilibrium_effort",
    "fixed_points",
    "linearise",
    "overdamped_velocity",
    "state_derivative",
]

Matrix = NDArray[np.float64]


class RigidPlant(Protocol):
    """What a design needs to know of a plant; ``PlantParameters`` has it."""

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
class LinearModel:
    """Linear model ``x' = A x + B (u - effort)`` around ``theta``.

    Attributes:
        A: State matrix, shape (2, 2) [1/s and mixed].
        B: Input matrix, shape (2, 1) [1/(kg m^2) in its last row].
        theta: Angle of the fixed point, 0 hanging down [rad].
        effort: Torque that holds the fixed point [N m].
    """

    A: Matrix
    B: Matrix
    theta: float = UPRIGHT
    effort: float = 0.0

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Open-loop eigenvalues, slowest (largest real part) first, shape (2,) [1/s]."""
        return sort_poles(np.linalg.eigvals(self.A))


@dataclass(frozen=True, slots=True)
class FixedPoint:
    """Angle at which the pendulum rests under a constant torque.

    Attributes:
        theta: Angle, 0 hanging down, in [-pi, pi] [rad].
        effort: The constant torque [N m].
        stable: Whether the pendulum returns to it after a small push; False at a tip of the torque curve too.
    """

    theta: float
    effort: float
    stable: bool


def sort_poles(poles: NDArray[Any]) -> NDArray[np.complex128]:
    """Return the poles with the slowest (largest real part) first."""
    values = np.asarray(poles, dtype=np.complex128)
    return values[np.lexsort((values.imag, -values.real))]


def equilibrium_effort(plant: RigidPlant, theta: float) -> float:
    """Return the torque u* = G_c sin(theta - angle_offset) - torque_offset that holds the pendulum at an angle [N m].

    Args:
        plant: Plant parameters.
        theta: Angle, 0 hanging down [rad].
    """
    # sin(math.pi) is 1.2e-16, not 0: upright must not ask for a torque.
    angle = theta - float(getattr(plant, "angle_offset", 0.0))
    lift = 0.0 if angle == UPRIGHT else plant.gravity * math.sin(angle)
    return lift - float(getattr(plant, "torque_offset", 0.0))


def linearise(plant: RigidPlant, theta: float = UPRIGHT) -> LinearModel:
    """Linearise the rigid plant about the fixed point at an angle.

    Args:
        plant: Plant parameters; dry friction, drivetrain, lag and delay are not part of the linear model.
        theta: Angle of the fixed point, 0 hanging down [rad]; every angle is one, held by the torque ``effort``.

    Raises:
        ParameterError: The angle is not finite.

    Source:
        Thesis, section 6.2 "Linearisation about the unstable fixed point".
    """
    if not math.isfinite(theta):
        raise ParameterError(f"theta of the fixed point is {theta} rad; expected a finite angle")
    angle = theta - float(getattr(plant, "angle_offset", 0.0))
    slope = -1.0 if angle == UPRIGHT else math.cos(angle)
    A = np.array([[0.0, 1.0], [-plant.gravity * slope / plant.inertia, -plant.damping / plant.inertia]])
    B = np.array([[0.0], [1.0 / plant.inertia]])
    return LinearModel(A, B, theta, equilibrium_effort(plant, theta))


def state_derivative(plant: RigidPlant, theta: float, theta_dot: float, effort: float) -> tuple[float, float]:
    """Return (theta', theta'') of the smooth rigid plant, in [rad/s] and [rad/s^2].

    Args:
        plant: Plant parameters.
        theta: Angle, 0 hanging down [rad].
        theta_dot: Velocity [rad/s].
        effort: Torque [N m].
    """
    offset = float(getattr(plant, "torque_offset", 0.0))
    angle = theta - float(getattr(plant, "angle_offset", 0.0))
    torque = effort + offset - plant.damping * theta_dot - plant.gravity * math.sin(angle)
    return theta_dot, torque / plant.inertia


def fixed_points(plant: RigidPlant, effort: float = 0.0) -> tuple[FixedPoint, ...]:
    """Return the fixed points under a constant torque: two, one at the tip of the torque curve, or none.

    Args:
        plant: Plant parameters.
        effort: Constant torque [N m].
    """
    if plant.gravity == 0.0:
        return ()
    ratio = effort / plant.gravity
    if abs(ratio) > 1.0:
        return ()
    low = math.asin(ratio)
    if abs(ratio) == 1.0:
        return (FixedPoint(low, effort, False),)
    high = math.copysign(math.pi, low if low != 0.0 else 1.0) - low
    return (FixedPoint(low, effort, True), FixedPoint(high, effort, False))


def overdamped_velocity(
    plant: RigidPlant, theta: NDArray[np.float64], effort: float = 0.0
) -> NDArray[np.float64]:
    """Return x' = (u0 - G_c sin x) / b_c, the velocity where damping outweighs inertia [rad/s].

    Args:
        plant: Plant parameters; damping > 0.
        theta: Angles, any shape [rad].
        effort: Constant torque u0 [N m].

    Raises:
        ParameterError: The plant has no damping, so that the limit does not exist.
    """
    if not plant.damping > 0.0:
        raise ParameterError(f"damping is {plant.damping} N m s/rad; expected > 0 for the overdamped limit")
    return (effort - plant.gravity * np.sin(theta)) / plant.damping
