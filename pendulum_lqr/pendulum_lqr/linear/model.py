"""Linear model of the plant that runs, of one joint or several: links, motor, spring and lags of the actuators.

Derivatives of the simulator's equations by complex step, exact to rounding. For n joints, m of them driven:

    x = [q - q*, v],   x' = A x + B du,   A = [[0, I], [d v'/dq, d v'/dv]],   B = [0; d v'/d torque at driven joints]

An actuator lag T adds the state tau' = (u - tau) / T; transport delay is a number of the model. The command u of a
motor is a voltage: its torque is ``gain u``, and its back EMF is part of the damping. Dry friction, end stops, dead
bands and spring hysteresis have no derivative at rest and are neglected: simulate the nonlinear loop to see their
effect.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.dynamics.joint_torques import joint_torque, periodic_torque
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
    torques_of,
)
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "LinearModel",
    "RigidPlant",
    "acceleration_from_upright",
    "equilibrium_effort",
    "holding_effort",
    "linearise",
    "low_frequency",
    "state_derivative",
]

Matrix = NDArray[np.float64]

_BALANCED = 1e-9
"""Share of the largest gravity torque below which a joint counts as balanced."""


@dataclass(frozen=True, slots=True)
class LinearModel:
    """Linear model ``x' = A x + B du(t - delay) + E d``, ``y = C x`` around a fixed point, du = u - effort.

    The k measured states come first, C = [I, 0]: angle and velocity of one joint, positions and velocities of several.

    Attributes:
        A: State matrix, shape (n, n) [1/s and mixed].
        B: Input matrix of the commands, shape (n, m) [state/(N m s), of motors state/(V s)].
        theta: Angle of the fixed point, 0 hanging down [rad]; of several joints the last position.
        effort: Commanded torque that holds the fixed point [N m]; of several driven joints the first.
        C: Output matrix, shape (k, n).
        E: Input matrix of an external torque on each link, shape (n, joints); without delay.
        delay: Time between a command and its first effect [s], the longest of all actuators; not in A.
        states: theta, theta_dot, then motor_angle and motor_velocity (at the output side of the gears) of a
            series-elastic plant, then torque, the lagged command. Of a mechanism the joints, their velocities
            (``JOINT_dot``), then the lagged efforts (``JOINT_effort``).
        position: Fixed point, one value for each joint [rad or m].
        efforts: The m commands that hold it [N m or N, or V].
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
        """Fill in the defaults of C and E for one joint without hidden states."""
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
    def outputs_and_inputs(self) -> tuple[int, int]:
        """The numbers k and m."""
        return self.C.shape[0], self.B.shape[1]

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured states."""
        return self.states[: self.C.shape[0]]

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the states that are not measured."""
        return self.states[self.C.shape[0] :]


def sort_poles(poles: NDArray[Any]) -> NDArray[np.complex128]:
    """Return the poles, slowest (largest real part) first."""
    values = np.asarray(poles, dtype=np.complex128)
    return values[np.lexsort((values.imag, -values.real))]


class _Body(NamedTuple):
    """Plant without lags at a fixed point, as it is linearised.

    Attributes:
        rates: Derivatives of the states, from states, m actuator efforts and a torque on each joint.
        efforts: The m commands that hold the fixed point.
        gains: Effort of each actuator per command, without lag.
        lags: Lag of each actuator [s].
        lag_states: Name of the state of each lag.
        measured: Number of measured (leading) states.
        delay: Longest transport delay [s].
    """

    states: tuple[str, ...]
    at: tuple[float, ...]
    rates: Callable[[tuple[complex, ...], Sequence[complex], Sequence[complex]], tuple[complex, ...]]
    efforts: Vector
    gains: Vector
    lags: Vector
    lag_states: tuple[str, ...]
    measured: int
    joints: int
    delay: float


def linearise(plant: RigidPlant | PlantParameters, at: float | Sequence[float] | None = None) -> LinearModel:
    """Return the linear model of the simulator's plant about a fixed point.

    A rigid plant of n joints has 2n states, a series-elastic one four; each first-order lag adds one. Transport delay
    is the model's ``delay``, included by :func:`~pendulum_lqr.linear.sampled_design.discretise` and margins.

    Args:
        plant: Plant parameters; dry friction, end stops and hysteresis are neglected.
        at: Position of the fixed point, 0 hanging down, of one joint or of each [rad or m]; None for upright. One joint
            can be held at every angle; a mechanism only where its driven joints can hold it.

    Raises:
        ParameterError: The position is not finite, has another length, or a passive joint would fall; or no joint is
            driven.

    Source:
        Thesis, section 6.2 "Linearisation about the unstable fixed point"; :mod:`pendulum_msgs_py.dynamics`.
    """
    position: Vector = ()
    if isinstance(plant, PlantParameters) and not plant.is_pendulum:
        position = _checked_position(plant, at)
        body, theta = _mechanism_body(plant, position), position[-1]
    else:
        theta = UPRIGHT if at is None else float(np.ravel(at)[0])
        if not math.isfinite(theta):
            raise ParameterError(f"theta of the fixed point is {theta} rad; expected a finite angle")
        body, position = _pendulum_body(plant, theta), (theta,)
    lagging = [index for index, lag in enumerate(body.lags) if lag > 0.0]
    size, m = len(body.states), len(body.efforts)
    n = size + len(lagging)

    def flow(*values: complex) -> tuple[complex, ...]:
        x, push = values[:n], values[n + m :]
        command = [gain * value for gain, value in zip(body.gains, values[n : n + m], strict=True)]
        torque = list(command)
        for index, lagged in zip(lagging, x[size:], strict=True):
            torque[index] = lagged
        follow = ((command[index] - torque[index]) / body.lags[index] for index in lagging)
        return (*body.rates(x[:size], torque, push), *follow)

    held = (body.gains[index] * body.efforts[index] for index in lagging)
    jacobian = np.array(complex_step(flow, (*body.at, *held, *body.efforts, *(0.0,) * body.joints)))
    return LinearModel(
        jacobian[:, :n].copy(),
        jacobian[:, n : n + m].copy(),
        theta,
        body.efforts[0],
        C=np.eye(body.measured, n),
        E=jacobian[:, n + m :].copy(),
        delay=body.delay,
        states=(*body.states, *(body.lag_states[index] for index in lagging)),
        position=position,
        efforts=body.efforts,
    )


def holding_effort(plant: PlantParameters, position: Sequence[float] | None = None) -> Vector:
    """Return the m commands that hold a mechanism at n positions [rad or m], None for upright [N m or N, or V].

    Raises:
        ParameterError: The position has another length, is not finite, or a passive joint would fall from it.
    """
    q = _checked_position(plant, position)
    n = len(q)
    p = plant.packed
    weight = np.array(complex_step(lambda *x: (in_arithmetic(plant.mechanism.potential, cmath)(x, p),), q))[0]
    # Relative to the largest gravity torque, so that sin(pi), which is 1.2e-16, counts as zero.
    still = (0.0,) * n
    around = [tuple(value + 0.5 * turn for value in q) for turn in (-np.pi, np.pi, 0.0, 1.0)]
    forces = [np.array(plant.mechanism.mass(at, p)) @ plant.acceleration(at, still, still) for at in around]
    scale = float(np.max(np.abs(forces)))
    driven = plant.coordinates.driven
    for index, joint in enumerate(plant.mechanism.joints):
        if index not in driven and abs(weight[index]) > _BALANCED * scale:
            raise ParameterError(
                f"{joint.name} is passive and would fall from {q[index]:.6g} {joint.unit} with {-weight[index]:.4g} "
                f"{joint.effort_unit}; expected a position at which gravity leaves it alone, such as "
                f"{', '.join(f'{value:.6g}' for value in plant.coordinates.goal)}"
            )
    return tuple(
        float(weight[index]) / gain if abs(weight[index]) > _BALANCED * scale else 0.0
        for index, gain in zip(driven, plant.gains, strict=True)
    )


def low_frequency(model: LinearModel) -> tuple[float, float, float]:
    """Return (M, b, k) of the second-order plant M x'' + b x' + k x = u that matches at low frequency, without delay.

    Exact for a rigid plant; else the leading terms of 1 / P(s). Used for bandwidths and starts of searches, never to
    claim stability.
    """
    n = model.A.shape[0]
    # theta = x^0 + x^1 s + ... is the response to the command that moves theta by 1 at s = 0, order by order in s.
    system = np.block([[model.A, model.B], [np.eye(1, n), np.zeros((1, 1))]])
    answer = np.linalg.solve(system, np.append(np.zeros(n), 1.0))
    terms = [float(answer[n])]
    for _ in range(2):
        answer = np.linalg.solve(system, np.append(answer[:n], 0.0))
        terms.append(float(answer[n]))
    return terms[2], terms[1], terms[0]


def state_derivative(plant: RigidPlant, theta: Any, theta_dot: Any, effort: Any) -> tuple[Any, Any]:
    """Return (theta', theta'') of the smooth rigid plant [rad/s, rad/s^2], for numbers or arrays."""
    torque = effort + offset_of(plant, "torque_offset")
    angle = theta - offset_of(plant, "angle_offset")
    equation = in_arithmetic(rigid_acceleration, np)
    torque = torque + in_arithmetic(joint_torque, np)(angle, theta_dot, *torques_of(plant))
    return theta_dot, equation(angle, theta_dot, torque, plant.inertia, plant.damping, plant.gravity)


def acceleration_from_upright(
    plant: PlantParameters,
    angle: Any,
    velocity: Any,
    effort: Any,
    arithmetic: ModuleType = math,
    sign_velocity: float = 0.0,
) -> Any:
    """Return theta'' of the rigid plant, including offsets, for numbers, arrays or symbols [rad/s^2].

    Args:
        plant: Plant parameters, without lag and delay.
        angle: Measured angle from upright [rad].
        velocity: [rad/s].
        effort: Torque of the actuator [N m].
        arithmetic: ``math``, ``numpy`` or ``casadi``, matching the arguments.
        sign_velocity: Width of the smoothed sign (tanh) of Coulomb friction [rad/s]; 0 neglects it.
    """
    torque = effort + plant.torque_offset
    if sign_velocity > 0.0 and plant.coulomb_friction > 0.0:
        torque = torque - plant.coulomb_friction * arithmetic.tanh(velocity / sign_velocity)
    if plant.has_torques:
        periodic = in_arithmetic(periodic_torque, arithmetic)
        torque = torque + periodic(angle - plant.angle_offset + UPRIGHT, *torques_of(plant)[1:])
        # A solver differentiates: the root of a square has no slope at rest.
        torque = torque - plant.quadratic_drag * velocity * arithmetic.fabs(velocity)
    equation = rigid_acceleration if arithmetic is math else in_arithmetic(rigid_acceleration, arithmetic)
    # sin(theta) = -sin(theta - pi), exactly 0 at upright in this form.
    return equation(angle - plant.angle_offset, velocity, torque, plant.inertia, plant.damping, -plant.gravity)


def _rigid_flow(plant: RigidPlant, x: tuple[complex, ...], torque: complex, push: complex) -> tuple[complex, ...]:
    acceleration = in_arithmetic(rigid_acceleration, cmath)
    angle = x[0] - offset_of(plant, "angle_offset")
    own = in_arithmetic(joint_torque, cmath)(angle, x[1], *torques_of(plant))
    net = torque + push + offset_of(plant, "torque_offset") + own
    return x[1], acceleration(angle, x[1], net, plant.inertia, plant.damping, plant.gravity)


def _elastic_flow(
    plant: RigidPlant, drive: SeriesElasticParameters, x: tuple[complex, ...], torque: complex, push: complex
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
    from_hanging = angle - offset_of(plant, "angle_offset")
    own = in_arithmetic(joint_torque, cmath)(from_hanging, velocity, *torques_of(plant))
    link = in_arithmetic(link_acceleration, cmath)(
        from_hanging,
        velocity,
        spring,
        push + offset_of(plant, "torque_offset") + own,
        plant.inertia,
        plant.damping,
        plant.gravity,
    )
    return velocity, link, motor_velocity, motor


def _pendulum_body(plant: RigidPlant, theta: float) -> _Body:
    drive = drivetrain_of(plant)
    states: tuple[str, ...] = ("theta", "theta_dot")
    at: tuple[float, ...] = (theta, 0.0)
    if drive is not None:
        states = (*states, "motor_angle", "motor_velocity")
        carried = held_torque(plant, theta)
        at = (*at, theta + spring_deflection(carried, drive.stiffness, drive.stiffness_hardening), 0.0)

    def rates(x: tuple[complex, ...], torque: Sequence[complex], push: Sequence[complex]) -> tuple[complex, ...]:
        if drive is None:
            return _rigid_flow(plant, x, torque[0], push[0])
        return _elastic_flow(plant, drive, x, torque[0], push[0])

    efforts = (equilibrium_effort(plant, theta),)
    lags = (offset_of(plant, "actuator_time_constant"),)
    return _Body(states, at, rates, efforts, (1.0,), lags, ("torque",), 2, 1, offset_of(plant, "transport_delay"))


def _mechanism_body(plant: PlantParameters, q: Vector) -> _Body:
    coordinates, actuators = plant.coordinates, plant.actuators
    if not actuators:
        raise ParameterError(f"plant {plant.name!r} has no driven joint; expected an actuator at one of them")
    n, names = len(q), coordinates.names
    forward = in_arithmetic(plant.mechanism.forward, cmath)

    def rates(x: tuple[complex, ...], torque: Sequence[complex], push: Sequence[complex]) -> tuple[complex, ...]:
        at_joints = list(push)
        for index, effort in zip(coordinates.driven, torque, strict=True):
            at_joints[index] = effort + push[index]
        return (*x[n:], *forward(x[:n], x[n:], tuple(at_joints), plant.packed))

    return _Body(
        (*names, *(f"{name}_dot" for name in names)),
        (*q, *(0.0,) * n),
        rates,
        holding_effort(plant, q),
        plant.gains,
        tuple(actuator.time_constant for actuator in actuators),
        tuple(f"{name}_effort" for name in coordinates.driven_names),
        2 * n,
        n,
        max(actuator.transport_delay for actuator in actuators),
    )


def _checked_position(plant: PlantParameters, position: float | Sequence[float] | None) -> Vector:
    coordinates = plant.coordinates
    given = coordinates.goal if position is None else np.atleast_1d(position)
    q = tuple(float(value) for value in given)
    if len(q) != len(coordinates.joints) or not np.isfinite(q).all():
        raise ParameterError(
            f"position is {list(q)}; expected {len(coordinates.joints)} finite numbers, for {coordinates.with_units}"
        )
    return q
