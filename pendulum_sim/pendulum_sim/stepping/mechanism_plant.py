"""A plant of several joints, stepped under held commands.

A command is clamped to its limit, waits for the transport delay, passes the first-order lag, and adds to gravity,
friction and ``push``, as in :mod:`pendulum_sim.stepping.plant`. A motor's command is a voltage: its effort at
standstill is what is stepped, on the ``torque_plant``, whose damping has the back EMF.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import NamedTuple

import numpy as np

from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.joint_steps import LAG, advance_joints, joint_functions
from pendulum_msgs_py.dynamics.runge_kutta import rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay, pack_joints
from pendulum_sim.stepping.plant import DelayLine, check_step, period_segments

__all__ = ["MechanismPlant", "MechanismState", "check_decay", "check_stable_step", "is_smooth"]

_RK4_STABLE = 2.78
"""Largest damping rate times step at which RK4 is stable."""


class MechanismState(NamedTuple):
    """State of a plant of several joints.

    Attributes:
        time: Time since the reset [s].
        position: n positions, not wrapped [rad or m].
        velocity: n velocities [rad/s or m/s].
        effort: n efforts of the actuators, of motors less their back EMF, 0 at passive joints [N m or N].
    """

    time: float
    position: Vector
    velocity: Vector
    effort: Vector


class MechanismPlant:
    """One plant of several joints, with commands held over dt [s] and ``substeps`` integration steps in it.

    Raises:
        ParameterError: An argument is outside its domain, the integrator would be unstable, or actuators have different
            transport delays.
    """

    def __init__(self, parameters: PlantParameters, dt: float, *, substeps: int = 1) -> None:
        check_step(dt, substeps)
        check_stable_step(parameters, dt / substeps)
        self.parameters = parameters
        self.dt = dt
        self._p = parameters.packed
        self._table = pack_joints(parameters.torque_plant)
        self._forward = parameters.mechanism.forward
        self._along, self._put, self._lag = joint_functions(len(parameters.joints))
        self._plain = not _has_events(parameters)
        self._limits = parameters.command_limits
        self._motors = parameters.coordinates.volts
        self._spread = parameters.coordinates.spread
        delay = common_delay(parameters)
        self._delays = [DelayLine(delay, dt) for _ in self._limits]
        fraction = self._delays[0].fraction if self._delays else 0.0
        self._segments = period_segments(dt, fraction, substeps)
        self._still = (0.0,) * len(parameters.joints)
        self._position = self._velocity = self._effort = self._still
        self._steps = 0

    @property
    def state(self) -> MechanismState:
        """The present state."""
        return self._state()

    def reset(self, position: Vector | None = None, velocity: Vector | None = None) -> MechanismState:
        """Restart at n positions [rad or m] and velocities, 0 by default, with actuators and delays empty.

        Raises:
            ParameterError: Their number is wrong, or one is not finite or beyond an end stop.
        """
        self._position = self.parameters.check_start(self._still if position is None else position)
        velocity = self._still if velocity is None else tuple(float(value) for value in velocity)
        if len(velocity) != len(self._still) or not all(math.isfinite(value) for value in velocity):
            raise ParameterError(f"initial velocity is {list(velocity)}; expected {len(self._still)} finite numbers")
        self._velocity = velocity
        self._effort = self._still
        self._steps = 0
        for line in self._delays:
            line.clear()
        return self.state

    def step(self, effort: Vector, push: Vector | None = None) -> MechanismState:
        """Advance by one period.

        Args:
            effort: m commands, clamped to the limits [N m or N, or V of a motor].
            push: n efforts on the joints themselves, neither clamped nor delayed; None for none.

        Raises:
            ParameterError: Their number is wrong, or one is not finite (nothing moves then).
        """
        if len(effort) != len(self._limits):
            self._spread(effort)
        if push is None:
            push = self._still
        elif len(push) != len(self._still):
            raise ParameterError(f"push has {len(push)} values; expected {len(self._still)}, one per joint")
        # Clamping NaN would give the full effort.
        if not all(map(math.isfinite, (*effort, *push))):
            raise ParameterError(f"effort is {list(effort)} and push {list(push)}; expected finite numbers")
        ends = [
            line.push(min(limit, max(-limit, value)))
            for line, limit, value in zip(self._delays, self._limits, effort, strict=True)
        ]
        before, after = tuple(pair[0] for pair in ends), tuple(pair[1] for pair in ends)
        if self._motors:
            before, after = self.parameters.stall_efforts(before), self.parameters.stall_efforts(after)
        older, newer = self._spread(before), self._spread(after)
        q, v, torque = self._position, self._velocity, self._effort
        for is_newer, h in self._segments:
            command = newer if is_newer else older
            if self._plain:
                total = self._along(command, 1.0, push)
                q, v = rk4_joints(self._forward, self._along, q, v, total, total, total, h, self._p)
                torque = command
                continue
            q, v = advance_joints(
                self._forward, self._along, self._put, self._lag, q, v, torque, command, push, h, self._p, self._table
            )
            torque = self._lag(torque, command, h, self._table[LAG])
        self._position, self._velocity, self._effort = q, v, torque
        self._steps += 1
        return self._state()

    def _state(self) -> MechanismState:
        effort = self._effort
        if self._motors:
            stall = tuple(effort[index] for index in self.parameters.coordinates.driven)
            effort = self._spread(self.parameters.motor_efforts(stall, self._velocity))
        return MechanismState(self._steps * self.dt, self._position, self._velocity, effort)

    @property
    def energy(self) -> float:
        """Kinetic and potential energy, 0 at rest hanging down [J]."""
        return self.parameters.energy(self._position, self._velocity)


def is_smooth(parameters: PlantParameters) -> bool:
    """Return whether a plant has no dry friction, end stops, lag, delay, dead band or drivetrain."""
    other = any(
        actuator.transport_delay or (actuator.motor and actuator.motor.dead_band) for actuator in parameters.actuators
    )
    return parameters.drivetrain is None and not _has_events(parameters) and not other


def check_stable_step(parameters: PlantParameters, h: float) -> None:
    """Raise a ParameterError, with the largest stable step, if damping makes RK4 unstable at this step."""
    damping = np.diag([joint.total_damping for joint in parameters.joints])
    n = len(parameters.joints)
    rate = 0.0
    for angle in np.linspace(0.0, np.pi, 9):
        rows = np.array(parameters.mechanism.mass((float(angle),) * n, parameters.packed))
        rate = max(rate, float(np.max(np.linalg.eigvals(np.linalg.solve(rows, damping)).real)))
    check_decay(rate, h, f"plant {parameters.name!r}")


def check_decay(rate: float, h: float, whose: str) -> None:
    """Raise a ParameterError, with the largest stable step, if a step is too long for a rate of decay [1/s]."""
    if rate * h > _RK4_STABLE:
        raise ParameterError(
            f"step is {h} s on {whose}, whose damping decays at {rate:.4g} 1/s; expected at most "
            f"{_RK4_STABLE / rate:.3g} s: more substeps"
        )


def _has_events(parameters: PlantParameters) -> bool:
    lagging = any(actuator.time_constant > 0.0 for actuator in parameters.actuators)
    return parameters.has_dry_friction or lagging or any(map(math.isfinite, chain(*parameters.stops)))
