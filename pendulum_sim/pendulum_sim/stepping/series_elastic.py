"""The link on a series-elastic actuator: motor, gear train, dry friction, spring with hysteresis.

The torque command drives the motor in feed-forward, u = tau R / (N V K_t eta), as the actuator does with its effort
loop off: the back EMF of the winding then damps with K_t K_e N^2 / R = 11.8 N m s/rad, motor and gears with 1.4. The
efficiency is in the command only. Equations and sources: ``pendulum_msgs_py.dynamics.series_elastic``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.dynamics import friction_magnitude, gravity_torque
from pendulum_msgs_py.dynamics.joint_torques import joint_torque
from pendulum_msgs_py.dynamics.series_elastic import (
    dahl_step,
    dry_friction_step,
    link_acceleration,
    motor_acceleration,
    spring_deflection,
    spring_torque,
    winding_current,
)
from pendulum_msgs_py.dynamics.steps import actuator_torque
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import command_pwm, resistance_of
from pendulum_msgs_py.plants.friction_terms import TERM_PARAMETERS, added_friction, terms_of, without_terms
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.plant import DelayLine, PlantState, check_start, check_step, command_within, period_segments
from pendulum_sim.stepping.stability import MOST_GROWTH, growth_of_map

__all__ = ["MAX_SUBSTEP", "SeriesElasticPlant", "SeriesElasticTuple", "pack_series_elastic", "series_elastic_step"]

MAX_SUBSTEP = 2.5e-4
"""Longest step of the semi-implicit scheme, for springs up to 1000 N m/rad [s]."""

SeriesElasticTuple = tuple[float, ...]
_TERMS = 21
"""Index of the first friction term."""
_TORQUES = _TERMS + len(TERM_PARAMETERS)
"""Index of the first of the link's ``JOINT_TORQUES``."""
_added_friction = added_friction((*[""] * _TERMS, *TERM_PARAMETERS))


def pack_series_elastic(parameters: PlantParameters) -> SeriesElasticTuple:
    """Return link and drivetrain in the order of :func:`series_elastic_step`."""
    drive = parameters.drivetrain
    if drive is None:
        raise ParameterError(f"plant {parameters.name!r} has no drivetrain; expected a series-elastic plant")
    return (
        parameters.inertia, parameters.damping, parameters.gravity,
        parameters.coulomb_friction, parameters.static_friction, parameters.stribeck_velocity,
        parameters.angle_offset,
        drive.gear_ratio, drive.torque_constant, drive.back_emf_constant, resistance_of(drive), drive.supply_voltage,
        drive.reflected_inertia, drive.motor_damping,
        drive.motor_coulomb_friction, drive.motor_static_friction, drive.motor_stribeck_velocity,
        drive.stiffness, drive.stiffness_hardening, drive.hysteresis_torque, drive.hysteresis_deflection,
        *terms_of(parameters), *parameters.joints[0].torques,
    )  # fmt: skip


def series_elastic_step(
    q_m: float, v_m: float, q: float, v: float, z: float, pwm: float, disturbance: float, h: float,
    plant: SeriesElasticTuple,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return motor angle and velocity, link angle and velocity, and Dahl state after h [s].

    Angles in [rad], the motor's at the output side; ``pwm`` in [-1, 1]; ``disturbance`` on the link, offset included [N
    m].
    """
    (
        inertia, damping, gravity, coulomb, static, stribeck_velocity, angle_offset,
        gear_ratio, torque_constant, back_emf, resistance, supply,
        motor_inertia, motor_damping, motor_coulomb, motor_static, motor_stribeck_velocity,
        stiffness, hardening, hysteresis, hysteresis_deflection,
    ) = plant[:_TERMS]  # fmt: skip
    deflection = q_m - q
    spring = spring_torque(deflection, z, stiffness, hardening, hysteresis)
    current = winding_current(pwm, v_m, supply, back_emf, gear_ratio, resistance)
    v_m_free = v_m + h * motor_acceleration(
        current, v_m, spring, torque_constant, gear_ratio, motor_damping, motor_inertia
    )
    v_m = dry_friction_step(
        v_m_free, friction_magnitude(v_m, motor_coulomb, motor_static, motor_stribeck_velocity), motor_inertia, h
    )
    drag, cos_2, sin_2, cos_3, sin_3 = plant[_TORQUES:]
    if drag != 0.0 or cos_2 != 0.0 or sin_2 != 0.0 or cos_3 != 0.0 or sin_3 != 0.0:
        disturbance += joint_torque(q - angle_offset, v, drag, cos_2, sin_2, cos_3, sin_3)
    v_free = v + h * link_acceleration(q - angle_offset, v, spring, disturbance, inertia, damping, gravity)
    added = _added_friction(abs(v), abs(gravity_torque(q - angle_offset, gravity)), plant)
    v = dry_friction_step(v_free, friction_magnitude(v, coulomb + added, static + added, stribeck_velocity), inertia, h)
    q_m += h * v_m
    q += h * v
    z = dahl_step(z, (q_m - q) - deflection, hysteresis_deflection)
    return q_m, v_m, q, v, z


class SeriesElasticPlant:
    """A link behind motor, gears and spring.

    Commands are held over dt [s]; ``substeps`` None keeps integration steps at 0.25 ms or less.

    Raises:
        ParameterError: There is no drivetrain, or an argument is outside its domain.
    """

    def __init__(self, parameters: PlantParameters, dt: float, *, substeps: int | None = None) -> None:
        if substeps is None and math.isfinite(dt):
            substeps = max(1, math.ceil(dt / MAX_SUBSTEP - 1e-9))
        check_step(dt, substeps or 1)
        self._packed = pack_series_elastic(parameters)
        drive = parameters.drivetrain
        assert drive is not None
        self.parameters = parameters
        self.dt = dt
        self._delay = DelayLine(parameters.transport_delay, dt)
        self._segments = period_segments(dt, self._delay.fraction, substeps or 1)
        self._check_stability(substeps or 1)
        self._pwm_per_effort = command_pwm(1.0, drive)
        self._spring = (drive.stiffness, drive.stiffness_hardening)
        self._steps = 0
        self._torque = 0.0
        self.q_m = self.v_m = self.theta = self.theta_dot = self.z = self.effort = 0.0

    def _check_stability(self, substeps: int) -> None:
        """Refuse unstable steps, judged without dry friction, which would hide that."""
        drive = self.parameters.drivetrain
        assert drive is not None
        smooth = self.parameters.with_values(
            coulomb_friction=0.0,
            static_friction=0.0,
            angle_offset=0.0,
            **without_terms(),
            drivetrain=replace(drive, motor_coulomb_friction=0.0, motor_static_friction=0.0, hysteresis_torque=0.0),
        )
        packed = pack_series_elastic(smooth)
        wound = spring_deflection(self.parameters.effort_limit, drive.stiffness, drive.stiffness_hardening)

        def is_stable(h: float) -> bool:
            def step(x: NDArray[np.float64]) -> NDArray[np.float64]:
                q_m, v_m, q, v = (float(value) for value in x)
                return np.array(series_elastic_step(q_m, v_m, q, v, 0.0, 0.0, 0.0, h, packed)[:4])

            # A hardening spring is stiffest when wound up; upright, one pole truly grows.
            return all(
                growth_of_map(step, np.array([angle + deflection, 0.0, angle, 0.0]), h, growing) <= MOST_GROWTH
                for angle, growing in ((0.0, 0), (math.pi, 1))
                for deflection in (0.0, wound)
            )

        longest = max(h for _, h in self._segments)
        if not is_stable(longest):
            enough = next((n for n in range(1, 10_000) if is_stable(self.dt / n)), 0)
            raise ParameterError(
                f"the step of plant {self.parameters.name!r} is {longest * 1e3:.4g} ms (dt {self.dt * 1e3:.4g} ms, "
                f"substeps {substeps}), at which motor and spring are unstable; expected substeps >= {enough}"
            )

    @property
    def state(self) -> PlantState:
        """The present state; the effort is that of the spring's deflection."""
        return PlantState(self._steps * self.dt, self.theta, self.theta_dot, self.effort)

    def reset(self, theta: float = 0.0, theta_dot: float = 0.0) -> PlantState:
        """Restart at a finite angle [rad] and velocity [rad/s], the spring carrying gravity, the motor unpowered."""
        check_start(theta, theta_dot)
        weight = gravity_torque(theta - self.parameters.angle_offset, self.parameters.gravity)
        self.theta, self.theta_dot, self.v_m = float(theta), float(theta_dot), float(theta_dot)
        self.q_m = self.theta + spring_deflection(weight, *self._spring)
        self.z = self._torque = 0.0
        self.effort = spring_torque(self.q_m - self.theta, 0.0, *self._spring, 0.0)
        self._steps = 0
        self._delay.clear()
        return self.state

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        """Advance one period under a commanded torque, clamped to the limit, and a torque on the link [N m].

        Raises:
            ParameterError: One of them is not finite (nothing moves then).
        """
        parameters = self.parameters
        older, newer = self._delay.push(command_within(parameters.effort_limit, effort, push))
        disturbance = push + parameters.torque_offset
        x = (self.q_m, self.v_m, self.theta, self.theta_dot, self.z)
        for is_newer, h in self._segments:
            command = newer if is_newer else older
            self._torque = actuator_torque(self._torque, command, h, parameters.actuator_time_constant)
            pwm = min(1.0, max(-1.0, self._torque * self._pwm_per_effort))
            x = series_elastic_step(*x, pwm, disturbance, h, self._packed)
        self.q_m, self.v_m, self.theta, self.theta_dot, self.z = x
        self.effort = spring_torque(self.q_m - self.theta, 0.0, *self._spring, 0.0)
        self._steps += 1
        return self.state
