"""A rigid link with dry friction and true stiction: when it sticks, when and which way it slips.

::

    M_c theta'' + b_c theta' + F sgn(theta') + G_c sin(theta - theta_0) = tau + tau_0 + push
    F = tau_C' + (tau_S' - tau_C') exp(-(theta' / v_s)^2),   tau' = tau + l |G_c sin(theta - theta_0)|

Between events the direction of friction is fixed and the equation smooth, so each integrator keeps its
order. A zero crossing of the velocity inside a step is located, and there the link sticks if friction can
hold the other torques (|net| <= tau_S'), and is then exactly at rest: theta does not change by a bit until
they exceed it.

Source: D. Karnopp, "Computer simulation of stick-slip friction in mechanical dynamic systems", 1985, with
the events located instead of a velocity band, which would creep.
"""

from __future__ import annotations

import math

from pendulum_msgs_py.dynamics import friction_magnitude, gravity_torque, rigid_acceleration
from pendulum_sim.integrators import Acceleration, Coefficients, PlantTuple, Step

__all__ = [
    "PACKED",
    "acceleration_with_friction",
    "actuator_torque",
    "advance_dry",
    "narrowed",
    "static_friction_balance",
]

PACKED = (
    "inertia",
    "damping",
    "gravity",
    "coulomb_friction",
    "static_friction",
    "stribeck_velocity",
    "load_friction",
    "torque_offset",
    "angle_offset",
    "actuator_time_constant",
)
"""Order of the values in a ``PlantTuple``."""

_MAX_EVENTS = 8
_MAX_ROOT_STEPS = 60


def acceleration_with_friction(
    theta: float, theta_dot: float, torque: float, direction: float, plant: PlantTuple
) -> float:
    """Return theta'' with friction acting against ``direction`` (-1, 0 for none, or 1) [rad/s^2].

    Args:
        theta: Measured angle [rad].
        theta_dot: Velocity [rad/s].
        torque: Torque of actuator and push [N m].
        direction: Sign of the velocity during this step.
        plant: Parameters, packed.
    """
    inertia, damping, gravity, coulomb, static, stribeck_velocity, load, offset, angle_offset, _ = plant
    angle = theta - angle_offset
    friction = 0.0
    if direction != 0.0:
        carried = load * abs(gravity_torque(angle, gravity))
        friction = direction * friction_magnitude(theta_dot, coulomb + carried, static + carried, stribeck_velocity)
    return rigid_acceleration(angle, theta_dot, torque + offset - friction, inertia, damping, gravity)


def static_friction_balance(theta: float, torque: float, plant: PlantTuple) -> tuple[float, float]:
    """Return the net torque on a link at rest and the friction that can hold it, tau_S' [N m].

    Args: as in :func:`acceleration_with_friction`.
    """
    _, _, gravity, _, static, _, load, offset, angle_offset, _ = plant
    weight = gravity_torque(theta - angle_offset, gravity)
    return torque + offset - weight, static + load * abs(weight)


def actuator_torque(torque: float, command: float, elapsed: float, time_constant: float) -> float:
    """Return the torque of a first-order lag, u + (tau - u) exp(-t/T); the command itself for T = 0 [N m].

    Args:
        torque: Torque at the start [N m].
        command: Constant command u [N m].
        elapsed: Time since the start [s].
        time_constant: T [s].
    """
    if time_constant == 0.0:
        return command
    return command + (torque - command) * math.exp(-elapsed / time_constant)


def narrowed(
    low: float, g_low: float, high: float, g_high: float, side: int, root: float, g: float, before: bool
) -> tuple[float, float, float, float, int]:
    """Return the bracket of a root, narrowed: (low, g_low, high, g_high, side).

    Args:
        low: Time before the root [s].
        g_low: The function there.
        high: Time after it [s].
        g_high: The function there.
        side: Which end moved last, -1 or 1; 0 for none.
        root: Time at which the function was looked at [s].
        g: The function there.
        before: Whether that is before the root.

    Source:
        The Illinois method: M. Dowell and P. Jarratt, A modified regula falsi method, BIT 11, 1971. The end that stays
        twice counts half, else it would stay for ever.
    """
    if before:
        return root, g, high, g_high * 0.5 if side == 1 else g_high, 1
    return low, g_low * 0.5 if side == -1 else g_low, root, g, -1


def advance_dry(
    step: Step,
    coefficients_of: object,
    acceleration: Acceleration,
    theta: float,
    theta_dot: float,
    torque: float,
    command: float,
    push: float,
    h: float,
    c: Coefficients,
    plant: PlantTuple,
) -> tuple[float, float]:
    """Return (theta, theta_dot) after h, sticking and slipping as often as that takes.

    Args:
        step: Step function of the integrator.
        coefficients_of: Its coefficient function, for steps cut short by an event.
        acceleration: :func:`acceleration_with_friction` (compiled or not).
        theta: Angle [rad].
        theta_dot: Velocity [rad/s].
        torque: Actuator torque at the start [N m].
        command: Commanded torque during the step [N m].
        push: Torque on the link itself [N m].
        h: Step [s].
        c: Coefficients for h.
        plant: Parameters, packed.
    """
    time_constant = plant[9]
    rate = plant[1] / plant[0]
    left = h
    for _ in range(_MAX_EVENTS):
        if theta_dot == 0.0:
            net, hold = static_friction_balance(
                theta, actuator_torque(torque, command, h - left, time_constant) + push, plant
            )
            if abs(net) <= hold:
                # Held now; a lagging torque may still outgrow friction within this step, and slips from the
                # next on.
                return theta, 0.0
            direction = 1.0 if net > 0.0 else -1.0
        else:
            direction = 1.0 if theta_dot > 0.0 else -1.0
        start = h - left
        if start > 0.0:
            c = coefficients_of(rate, left)  # type: ignore[operator]
        theta_1, v_1 = step(
            acceleration,
            theta,
            theta_dot,
            actuator_torque(torque, command, start, time_constant) + push,
            actuator_torque(torque, command, start + 0.5 * left, time_constant) + push,
            actuator_torque(torque, command, h, time_constant) + push,
            direction,
            left,
            c,
            plant,
        )
        if v_1 * direction >= 0.0:
            return theta_1, v_1
        if theta_dot == 0.0:
            # It broke away against the net torque: an artefact of a step far too long. Keep it where it is.
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
