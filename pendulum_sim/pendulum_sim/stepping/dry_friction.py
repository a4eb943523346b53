"""A rigid link with dry friction and true stiction.

::

    M_c theta'' + b_c theta' + F sgn(theta') + G_c sin(theta - theta_0) = tau + tau_0 + t + push
    F = tau_C' + (tau_S' - tau_C') exp(-(theta' / v_s)^2),   tau' = tau + a(|theta'|, |G_c sin(theta - theta_0)|)

a is the sum of the friction terms of :mod:`pendulum_msgs_py.plants.friction_terms`, t the link's own torque, of
:mod:`pendulum_msgs_py.dynamics.joint_torques` at theta - theta_0. Between events the direction of
friction is fixed and the equation smooth, so each integrator keeps its order. A zero crossing of the velocity is
located inside the step; there the link sticks, exactly at rest, while |net torque| <= tau_S'.

Source: D. Karnopp, "Computer simulation of stick-slip friction in mechanical dynamic systems", 1985, with the events
located instead of a velocity band, which would creep.
"""

from __future__ import annotations

from pendulum_msgs_py.dynamics import friction_magnitude, gravity_torque, rigid_acceleration
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES, joint_torque, periodic_torque
from pendulum_msgs_py.dynamics.steps import actuator_torque, narrowed
from pendulum_msgs_py.plants.friction_terms import STRENGTHS, added_friction
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS
from pendulum_sim.stepping.integrators import Acceleration, Coefficients, PlantTuple, Step

__all__ = [
    "DRY",
    "LAG",
    "PACKED",
    "acceleration_with_friction",
    "acceleration_with_torques",
    "advance_dry",
    "is_dry",
    "link_acceleration_of",
    "static_friction_balance",
]

PACKED = tuple(spec.name for spec in PLANT_SPECS if spec.name not in {"effort_limit", "transport_delay"})
"""Order of the values in a ``PlantTuple``."""
_INERTIA, _DAMPING, _GRAVITY, _COULOMB, _STATIC, _STRIBECK, _OFFSET, _ANGLE, LAG, _TERMS = range(10)
"""Indices in it; ``LAG`` is the actuator's time constant, friction terms and ``JOINT_TORQUES`` come last."""
_DRAG, _COS_2, _SIN_2, _COS_3, _SIN_3 = (PACKED.index(name) for name in JOINT_TORQUES)
_added_friction = added_friction(PACKED)
DRY = (_STATIC, *(_TERMS + index for index in STRENGTHS))
"""Indices of the values that are all 0 without dry friction."""

_MAX_EVENTS = 8
_MAX_ROOT_STEPS = 60


def acceleration_with_friction(
    theta: float, theta_dot: float, torque: float, direction: float, plant: PlantTuple
) -> float:
    """Return theta'' under a torque of actuator and push [N m], friction against ``direction`` -1, 0 or 1 [rad/s^2]."""
    # By index: a slice would take a tenth of an interpreted plant's time.
    gravity = plant[_GRAVITY]
    angle = theta - plant[_ANGLE]
    friction = 0.0
    if direction != 0.0:
        added = _added_friction(abs(theta_dot), abs(gravity_torque(angle, gravity)), plant)
        friction = direction * friction_magnitude(
            theta_dot, plant[_COULOMB] + added, plant[_STATIC] + added, plant[_STRIBECK]
        )
    torque = torque + plant[_OFFSET] - friction
    return rigid_acceleration(angle, theta_dot, torque, plant[_INERTIA], plant[_DAMPING], gravity)


def acceleration_with_torques(
    theta: float, theta_dot: float, torque: float, direction: float, plant: PlantTuple
) -> float:
    """Return theta'' of a link with torques of its own; arguments as :func:`acceleration_with_friction`."""
    own: float = joint_torque(
        theta - plant[_ANGLE], theta_dot, plant[_DRAG], plant[_COS_2], plant[_SIN_2], plant[_COS_3], plant[_SIN_3]
    )
    return acceleration_with_friction(theta, theta_dot, torque + own, direction, plant)


def link_acceleration_of(torques: bool) -> Acceleration:
    """Return the equation of a link with or without torques of its own; without, it costs nothing."""
    return acceleration_with_torques if torques else acceleration_with_friction


def static_friction_balance(theta: float, torque: float, plant: PlantTuple) -> tuple[float, float]:
    """Return the net torque on a link at rest and the largest static friction tau_S' [N m]."""
    angle = theta - plant[_ANGLE]
    weight = gravity_torque(angle, plant[_GRAVITY])
    if plant[_COS_2] != 0.0 or plant[_SIN_2] != 0.0 or plant[_COS_3] != 0.0 or plant[_SIN_3] != 0.0:
        torque = torque + periodic_torque(angle, plant[_COS_2], plant[_SIN_2], plant[_COS_3], plant[_SIN_3])
    return torque + plant[_OFFSET] - weight, plant[_STATIC] + _added_friction(0.0, abs(weight), plant)


def is_dry(plant: PlantTuple) -> bool:
    """Return whether a plant has dry friction or any friction term."""
    dry = False
    for index in DRY:
        dry = dry or plant[index] > 0.0
    return dry


def advance_dry(
    step: Step, coefficients_of: object, acceleration: Acceleration, theta: float, theta_dot: float, torque: float,
    command: float, push: float, h: float, c: Coefficients, plant: PlantTuple,
) -> tuple[float, float]:  # fmt: skip
    """Return (theta, theta_dot) after h [s], with as many events as occur.

    ``coefficients_of`` serves steps cut short by an event; ``acceleration`` is of :func:`link_acceleration_of`,
    compiled or not; ``c`` are the coefficients for h. Torques [N m]: the actuator's at the start, the command, and a
    push on the link.
    """
    time_constant = plant[LAG]
    rate = plant[_DAMPING] / plant[_INERTIA]
    left = h
    for _ in range(_MAX_EVENTS):
        if theta_dot == 0.0:
            net, hold = static_friction_balance(
                theta, actuator_torque(torque, command, h - left, time_constant) + push, plant
            )
            if abs(net) <= hold:
                # A lagging torque that outgrows friction within this step slips from the next on.
                return theta, 0.0
            direction = 1.0 if net > 0.0 else -1.0
        else:
            direction = 1.0 if theta_dot > 0.0 else -1.0
        start = h - left
        if start > 0.0:
            c = coefficients_of(rate, left)  # type: ignore[operator]
        theta_1, v_1 = step(
            acceleration, theta, theta_dot, actuator_torque(torque, command, start, time_constant) + push,
            actuator_torque(torque, command, start + 0.5 * left, time_constant) + push,
            actuator_torque(torque, command, h, time_constant) + push, direction, left, c, plant,
        )  # fmt: skip
        if v_1 * direction >= 0.0:
            return theta_1, v_1
        if theta_dot == 0.0:
            # It broke away against the net torque, an artefact of too long a step: hold it.
            return theta, 0.0
        low, v_low, high, v_high = 0.0, theta_dot, left, v_1
        side = 0
        root = left
        theta_root = theta_1
        for _ in range(_MAX_ROOT_STEPS):
            root = (low * v_high - high * v_low) / (v_high - v_low)
            if not low < root < high:
                break
            theta_root, v_root = step(
                acceleration,
                theta,
                theta_dot,
                actuator_torque(torque, command, start, time_constant) + push,
                actuator_torque(torque, command, start + 0.5 * root, time_constant) + push,
                actuator_torque(torque, command, start + root, time_constant) + push,
                direction,
                root,
                coefficients_of(rate, root),  # type: ignore[operator]
                plant,
            )
            if abs(v_root) <= 1e-14 * (abs(theta_dot) + abs(v_1)):
                break
            low, v_low, high, v_high, side = narrowed(
                low, v_low, high, v_high, side, root, v_root, v_root * direction > 0.0
            )
        theta = theta_root
        theta_dot = 0.0
        left -= root
        if left <= 1e-12 * h:
            return theta, 0.0
    return theta, theta_dot
