"""The linear model of the plant that runs: link, motor, spring and lag as states, the transport delay beside them.

The equations are those of :mod:`pendulum_msgs_py.dynamics`, which the simulator steps too; their derivatives come by
complex step, exact to rounding. For the rigid pendulum ``M_c theta'' + b_c theta' + G_c sin(theta) = u`` that gives

    A = [[0, 1], [-G_c cos(theta*) / M_c, -b_c / M_c]],   B = [0, 1 / M_c]

Only the smooth part of a plant is linearised: dry friction and the hysteresis of a spring have no derivative at rest,
so that designs neglect them and the nonlinear closed loop, simulated, tells what they cost.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.dynamics.rigid import rigid_acceleration
from pendulum_msgs_py.dynamics.series_elastic import (
    link_acceleration,
    motor_acceleration,
    spring_deflection,
    spring_torque,
    winding_current,
)
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import (
    RigidPlant,
    command_pwm,
    drivetrain_of,
    equilibrium_effort,
    held_torque,
    offset_of,
    resistance_of,
)
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, SeriesElasticParameters

__all__ = [
    "LinearModel",
    "RigidPlant",
    "acceleration_from_upright",
    "equilibrium_effort",
    "linearise",
    "low_frequency",
    "state_derivative",
]

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LinearModel:
    """Linear model ``x' = A x + B du(t - delay) + E d``, ``y = C x`` around a fixed point, du = u - effort.

    Of one joint the first two states are always [theta - theta*, theta_dot], and they are what is measured:
    C = [I, 0].

    Attributes:
        A: State matrix, shape (n, n) [1/s and mixed].
        B: Input matrix of the commanded torque, shape (n, 1) [state/(N m s)].
        theta: Angle of the fixed point, 0 hanging down [rad].
        effort: Commanded torque that holds the fixed point [N m].
        C: Output matrix, shape (2, n): angle and velocity of the link.
        E: Input matrix of a torque on the link itself, such as a push, shape (n, 1); without delay.
        delay: Time between a command and its first effect [s]; not in A.
        states: Names of the states: theta, theta_dot, then motor_angle and motor_velocity (at the output side of the
            gears) of a series-elastic plant, then torque, the lagged command, of a plant with a lag. Of a plant of
            several joints (:mod:`~pendulum_lqr.linear.mechanism_model`) the joints, then their velocities.
        position: Of several joints, the fixed point, n values [rad or m]; ``theta`` is then the last.
        efforts: Of several joints, the m efforts that hold it [N m or N]; ``effort`` is then the first.
    """

    A: Matrix
    B: Matrix
    theta: float = UPRIGHT
    effort: float = 0.0
    C: Matrix = field(default=None)  # type: ignore[arg-type]  # filled in below
    E: Matrix = field(default=None)  # type: ignore[arg-type]
    delay: float = 0.0
    states: tuple[str, ...] = ("theta", "theta_dot")
    position: Vector = ()
    efforts: Vector = ()

    def __post_init__(self) -> None:
        """Fill in outputs and the link's input, which two states alone determine."""
        n = self.A.shape[0]
        if self.C is None:
            object.__setattr__(self, "C", np.eye(2, n))  # type: ignore[unreachable]
        if self.E is None:
            object.__setattr__(self, "E", self.B.copy())  # type: ignore[unreachable]
        if len(self.states) != n:
            raise ParameterError(f"states are {', '.join(self.states)}; expected {n} names, one per row of A")

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Open-loop eigenvalues, slowest (largest real part) first, shape (n,) [1/s]."""
        return sort_poles(np.linalg.eigvals(self.A))

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the states that are not measured."""
        return self.states[self.C.shape[0] :]


def sort_poles(poles: NDArray[Any]) -> NDArray[np.complex128]:
    """Return the poles with the slowest (largest real part) first."""
    values = np.asarray(poles, dtype=np.complex128)
    return values[np.lexsort((values.imag, -values.real))]


def linearise(plant: RigidPlant, theta: float = UPRIGHT) -> LinearModel:
    """Return the linear model about the fixed point at an angle, of the plant that the simulator runs.

    A rigid plant has two states, a series-elastic one four; a first-order lag (``actuator_time_constant``) adds one.
    ``transport_delay`` is the model's ``delay``: :func:`~pendulum_lqr.linear.sampled_design.discretise` and margins
    count it.

    Args:
        plant: Plant parameters; dry friction and the spring's hysteresis are not part of the linear model.
        theta: Angle of the fixed point, 0 hanging down [rad]; every angle is one, held by the torque ``effort``.

    Raises:
        ParameterError: The angle is not finite.

    Source:
        Thesis, section 6.2 "Linearisation about the unstable fixed point"; equations of
        :mod:`pendulum_msgs_py.dynamics`.
    """
    if not math.isfinite(theta):
        raise ParameterError(f"theta of the fixed point is {theta} rad; expected a finite angle")
    drive = drivetrain_of(plant)
    lag = offset_of(plant, "actuator_time_constant")
    effort = equilibrium_effort(plant, theta)
    states: tuple[str, ...] = ("theta", "theta_dot")
    at: tuple[float, ...] = (theta, 0.0)
    if drive is not None:
        states = (*states, "motor_angle", "motor_velocity")
        carried = held_torque(plant, theta)
        at = (*at, theta + spring_deflection(carried, drive.stiffness, drive.stiffness_hardening), 0.0)
    if lag > 0.0:
        states = (*states, "torque")
        at = (*at, effort)
    n = len(states)

    def flow(*values: complex) -> tuple[complex, ...]:
        x, command, push = values[:n], values[n], values[n + 1]
        torque = x[-1] if lag > 0.0 else command
        rates = _rigid_flow(plant, x, torque, push) if drive is None else _elastic_flow(plant, drive, x, torque, push)
        return (*rates, (command - torque) / lag) if lag > 0.0 else rates

    jacobian = np.array(complex_step(flow, (*at, effort, 0.0)))
    return LinearModel(
        jacobian[:, :n].copy(),
        jacobian[:, n : n + 1].copy(),
        theta,
        effort,
        E=jacobian[:, n + 1 :].copy(),
        delay=offset_of(plant, "transport_delay"),
        states=states,
    )


def low_frequency(model: LinearModel) -> tuple[float, float, float]:
    """Return (M, b, k) of the second-order plant M x'' + b x' + k x = u that moves alike where motion is slow.

    Exact for a rigid plant; for others the leading terms of 1 / P(s), in units of the commanded torque. Bandwidths and
    starts of searches come from it, never a claim of stability.

    Args:
        model: Linear model; its delay is not counted.
    """
    n = model.A.shape[0]
    # theta = x^0 + x^1 s + ... as the answer to the command that moves theta by 1 at s = 0, order by order in s.
    system = np.block([[model.A, model.B], [np.eye(1, n), np.zeros((1, 1))]])
    answer = np.linalg.solve(system, np.append(np.zeros(n), 1.0))
    terms = [float(answer[n])]
    for _ in range(2):
        answer = np.linalg.solve(system, np.append(answer[:n], 0.0))
        terms.append(float(answer[n]))
    return terms[2], terms[1], terms[0]


def state_derivative(plant: RigidPlant, theta: Any, theta_dot: Any, effort: Any) -> tuple[Any, Any]:
    """Return (theta', theta'') of the smooth rigid plant, in [rad/s] and [rad/s^2].

    Args:
        plant: Plant parameters.
        theta: Angle, 0 hanging down, a number or an array [rad].
        theta_dot: Velocity [rad/s].
        effort: Torque [N m].
    """
    torque = effort + offset_of(plant, "torque_offset")
    angle = theta - offset_of(plant, "angle_offset")
    equation = in_arithmetic(rigid_acceleration, np)
    return theta_dot, equation(angle, theta_dot, torque, plant.inertia, plant.damping, plant.gravity)


def acceleration_from_upright(
    plant: PlantParameters,
    angle: Any,
    velocity: Any,
    effort: Any,
    arithmetic: ModuleType = math,
    sign_velocity: float = 0.0,
) -> Any:
    """Return theta'' of the rigid plant, offsets included, with numbers, arrays or symbols [rad/s^2].

    Args:
        plant: Plant parameters; lag and delay are not in it.
        angle: Measured angle from upright [rad].
        velocity: [rad/s].
        effort: Torque of the actuator [N m].
        arithmetic: ``math``, ``numpy`` or ``casadi``, whichever the arguments are made for.
        sign_velocity: Width over which Coulomb friction changes its sign, as tanh [rad/s]; 0 leaves it out.
    """
    torque = effort + plant.torque_offset
    if sign_velocity > 0.0 and plant.coulomb_friction > 0.0:
        torque = torque - plant.coulomb_friction * arithmetic.tanh(velocity / sign_velocity)
    equation = rigid_acceleration if arithmetic is math else in_arithmetic(rigid_acceleration, arithmetic)
    # sin(theta) = -sin(theta - pi), exactly 0 at upright in this form.
    return equation(angle - plant.angle_offset, velocity, torque, plant.inertia, plant.damping, -plant.gravity)


def _rigid_flow(plant: RigidPlant, x: tuple[complex, ...], torque: complex, push: complex) -> tuple[complex, ...]:
    acceleration = in_arithmetic(rigid_acceleration, cmath)
    net = torque + push + offset_of(plant, "torque_offset")
    angle = x[0] - offset_of(plant, "angle_offset")
    return x[1], acceleration(angle, x[1], net, plant.inertia, plant.damping, plant.gravity)


def _elastic_flow(
    plant: RigidPlant,
    drive: SeriesElasticParameters,
    x: tuple[complex, ...],
    torque: complex,
    push: complex,
) -> tuple[complex, ...]:
    angle, velocity, motor_angle, motor_velocity = x[:4]
    spring = in_arithmetic(spring_torque, cmath)(
        motor_angle - angle, 0.0, drive.stiffness, drive.stiffness_hardening, 0.0
    )
    current = in_arithmetic(winding_current, cmath)(
        command_pwm(torque, drive),
        motor_velocity,
        drive.supply_voltage,
        drive.back_emf_constant,
        drive.gear_ratio,
        resistance_of(drive),
    )
    motor = in_arithmetic(motor_acceleration, cmath)(
        current,
        motor_velocity,
        spring,
        drive.torque_constant,
        drive.gear_ratio,
        drive.motor_damping,
        drive.reflected_inertia,
    )
    link = in_arithmetic(link_acceleration, cmath)(
        angle - offset_of(plant, "angle_offset"),
        velocity,
        spring,
        push + offset_of(plant, "torque_offset"),
        plant.inertia,
        plant.damping,
        plant.gravity,
    )
    return velocity, link, motor_velocity, motor
