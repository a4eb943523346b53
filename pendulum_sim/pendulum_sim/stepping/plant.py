"""The rigid plant, stepped under a held command, and parts of all plants.

A command is clamped to the effort limit, waits for the transport delay (any fraction of a period), passes the
first-order lag, and adds to gravity, friction and ``push``, the torque on the link itself. Sensors are separate:
:mod:`pendulum_sim.stepping.sensors`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from pendulum_msgs_py.dynamics.steps import actuator_torque
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.dry_friction import LAG, PACKED, advance_dry, is_dry, link_acceleration_of
from pendulum_sim.stepping.integrators import Acceleration, Coefficients, PlantTuple, Step, get_integrator
from pendulum_sim.stepping.stability import check_stability

__all__ = [
    "DelayLine",
    "Plant",
    "PlantState",
    "RigidPlant",
    "advance_rigid",
    "command_within",
    "pack",
    "period_segments",
]

_MAX_DELAY_STEPS = 100_000


class PlantState(NamedTuple):
    """State of a plant of one joint.

    Attributes:
        time: Time since the reset [s].
        theta: Angle, 0 hanging, pi upright; not wrapped [rad].
        theta_dot: Velocity [rad/s].
        effort: Torque at the joint, as an ideal sensor in the actuator measures it [N m].
    """

    time: float
    theta: float
    theta_dot: float
    effort: float


class Plant(Protocol):
    """A plant of one joint."""

    parameters: PlantParameters
    dt: float

    @property
    def state(self) -> PlantState:
        """The present state."""

    def reset(self, theta: float = 0.0, theta_dot: float = 0.0) -> PlantState:
        """Restart at an angle [rad] and a velocity [rad/s], without torque."""

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        """Advance one period under a commanded torque and a torque on the link [N m].

        Raises:
            ParameterError: One of them is not finite (nothing moves then).
        """


class DelayLine:
    """Delayed commands; the delay [s] is any number of periods dt [s]."""

    def __init__(self, delay: float, dt: float) -> None:
        periods = delay / dt
        # Rounding must not leave a sliver of a period.
        if abs(periods - round(periods)) < 1e-9:
            periods = float(round(periods))
        if periods > _MAX_DELAY_STEPS:
            raise ParameterError(f"transport_delay is {delay} s; expected at most {_MAX_DELAY_STEPS * dt} s")
        self.whole = math.floor(periods)
        self.fraction = periods - self.whole
        self.line: deque[float] = deque(maxlen=self.whole + 2)
        self.clear()

    def clear(self) -> None:
        """Fill the line with zero torque."""
        self.line.extend([0.0] * (self.whole + 2))

    def push(self, command: float) -> tuple[float, float]:
        """Add this period's command; return those before and after the fractional part [N m]."""
        self.line.append(command)
        return self.line[0], self.line[1]


def period_segments(dt: float, fraction: float, substeps: int) -> list[tuple[bool, float]]:
    """Cut a period where the delayed command changes, and each part into equal sub-steps.

    ``fraction`` is the place of the change in dt [s], 0 for its start; ``substeps`` those of a whole period.

    Returns:
        (whether the newer command acts, length [s]) of each sub-step; the lengths sum to dt.
    """
    segments: list[tuple[bool, float]] = []
    for newer, share in ((False, fraction), (True, 1.0 - fraction)):
        if share > 0.0:
            count = max(1, math.ceil(share * substeps - 1e-9))
            segments += [(newer, share * dt / count)] * count
    return segments


def pack(parameters: PlantParameters) -> PlantTuple:
    """Return a rigid plant's parameters in the order of ``PACKED``."""
    return tuple(float(getattr(parameters, name)) for name in PACKED)


def advance_rigid(
    step: Step, coefficients_of: object, acceleration: Acceleration, theta: float, theta_dot: float, torque: float,
    command: float, push: float, h: float, c: Coefficients, plant: PlantTuple, dry: bool,
) -> tuple[float, float, float]:  # fmt: skip
    """Return (theta, theta_dot, torque of the actuator) of a rigid link after h [s]; arguments as :func:`advance_dry`.

    ``dry`` is :func:`pendulum_sim.stepping.dry_friction.is_dry`.
    """
    lag = plant[LAG]
    if dry:
        theta, theta_dot = advance_dry(
            step, coefficients_of, acceleration, theta, theta_dot, torque, command, push, h, c, plant
        )
        return theta, theta_dot, actuator_torque(torque, command, h, lag)
    torque_0 = command if lag == 0.0 else torque
    torque_mid = actuator_torque(torque, command, 0.5 * h, lag)
    torque = actuator_torque(torque, command, h, lag)
    theta, theta_dot = step(
        acceleration, theta, theta_dot, torque_0 + push, torque_mid + push, torque + push, 0.0, h, c, plant
    )
    return theta, theta_dot, torque


class RigidPlant:
    """One rigid link: the thesis's equation, with dry friction, lag and delay.

    Commands are held over dt > 0 [s], with ``substeps`` >= 1 of a method of ``integrators.METHODS``.

    Raises:
        ParameterError: An argument is outside its domain, the plant has a drivetrain, or the method is unstable on it.
    """

    def __init__(self, parameters: PlantParameters, dt: float, *, method: str = "etd4", substeps: int = 1) -> None:
        if parameters.drivetrain is not None:
            raise ParameterError(f"plant {parameters.name!r} is series elastic; expected a rigid one: use make_plant")
        check_step(dt, substeps)
        integrator = get_integrator(method)
        self.parameters = parameters
        self.dt = dt
        self.method = method
        self._step = integrator.step
        self._coefficients_of = integrator.coefficients
        self.delay = DelayLine(parameters.transport_delay, dt)
        rate = parameters.damping / parameters.inertia
        self.segments: Sequence[tuple[bool, float, Coefficients]] = [
            (newer, h, integrator.coefficients(rate, h))
            for newer, h in period_segments(dt, self.delay.fraction, substeps)
        ]
        check_stability(integrator, parameters, dt, substeps, max(h for _, h, _ in self.segments))
        self.packed = pack(parameters)
        self._limit = parameters.effort_limit
        self.dry = is_dry(self.packed)
        self._acceleration = link_acceleration_of(parameters.has_torques)
        self.steps = 0
        self.theta = 0.0
        self.theta_dot = 0.0
        self.effort = 0.0

    @property
    def state(self) -> PlantState:
        """The present state."""
        return PlantState(self.steps * self.dt, self.theta, self.theta_dot, self.effort)

    def reset(self, theta: float = 0.0, theta_dot: float = 0.0) -> PlantState:
        """Restart at an angle [rad] and a velocity [rad/s], with actuator and delay empty; both must be finite."""
        check_start(theta, theta_dot)
        self.theta, self.theta_dot, self.effort = float(theta), float(theta_dot), 0.0
        self.steps = 0
        self.delay.clear()
        return self.state

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        """Advance one period under a commanded torque, clamped to the limit, and a torque on the link [N m].

        Raises:
            ParameterError: One of them is not finite (nothing moves then).
        """
        older, newer = self.delay.push(command_within(self._limit, effort, push))
        theta, theta_dot, torque = self.theta, self.theta_dot, self.effort
        for is_newer, h, c in self.segments:
            theta, theta_dot, torque = advance_rigid(
                self._step, self._coefficients_of, self._acceleration, theta, theta_dot, torque,
                newer if is_newer else older, push, h, c, self.packed, self.dry,
            )  # fmt: skip
        self.theta, self.theta_dot, self.effort = theta, theta_dot, torque
        self.steps += 1
        return PlantState(self.steps * self.dt, theta, theta_dot, torque)

    @property
    def energy(self) -> float:
        """Kinetic and potential energy, 0 at rest hanging down [J]."""
        return self.parameters.energy((self.theta - self.parameters.angle_offset,), (self.theta_dot,))


def command_within(limit: float, effort: float, push: float) -> float:
    """Return a commanded torque within the limit [N m].

    Raises:
        ParameterError: It, or the push, is not finite: clamping NaN could give the full torque.
    """
    if not (math.isfinite(effort) and math.isfinite(push)):
        raise ParameterError(f"effort is {effort} N m and push {push} N m; expected finite numbers")
    return limit if effort > limit else max(effort, -limit)


def check_step(dt: float, substeps: int) -> None:
    """Raise a ParameterError for an invalid period or number of sub-steps."""
    if not (math.isfinite(dt) and dt > 0.0):
        raise ParameterError(f"dt is {dt} s; expected a finite number > 0")
    if substeps < 1:
        raise ParameterError(f"substeps is {substeps}; expected an integer >= 1")


def check_start(theta: float, theta_dot: float) -> None:
    """Raise a ParameterError for a start that is not finite."""
    if not math.isfinite(theta):
        raise ParameterError(f"initial theta is {theta} rad; expected a finite number")
    if not math.isfinite(theta_dot):
        raise ParameterError(f"initial theta_dot is {theta_dot} rad/s; expected a finite number")
