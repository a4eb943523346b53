"""The rigid pendulum, M_c theta'' + b_c theta' + G_c sin(theta) = u, and its dry friction."""

from __future__ import annotations

import math

__all__ = ["friction_magnitude", "gravity_torque", "rigid_acceleration", "rigid_energy"]


def gravity_torque(theta: float, gravity: float) -> float:
    """Return the torque with which gravity resists lifting, G_c sin(theta) [N m].

    Args:
        theta: Joint angle, 0 hanging down [rad].
        gravity: Gravity coefficient G_c = m g l_c [N m].
    """
    return gravity * math.sin(theta)


def rigid_acceleration(
    theta: float, theta_dot: float, effort: float, inertia: float, damping: float, gravity: float
) -> float:
    """Return theta'' = (u - b_c theta' - G_c sin theta) / M_c [rad/s^2].

    Args:
        theta: Joint angle, 0 hanging down [rad].
        theta_dot: Joint velocity [rad/s].
        effort: Sum of all torques on the joint but damping and gravity, dry friction included [N m].
        inertia: M_c [kg m^2].
        damping: b_c [N m s/rad].
        gravity: G_c [N m].

    Source:
        Thesis, "Control of a Pendulum System: From Simulation to Reality", equation of section 4.
    """
    return (effort - damping * theta_dot - gravity * math.sin(theta)) / inertia


def friction_magnitude(speed: float, coulomb: float, static: float, stribeck_velocity: float) -> float:
    """Return the magnitude of dry friction at a speed, tau_C + (tau_S - tau_C) exp(-(v/v_s)^2) [N m].

    Args:
        speed: Sliding velocity, sign irrelevant [rad/s].
        coulomb: tau_C, the level that remains at speed [N m].
        static: tau_S, the level at which sliding starts [N m].
        stribeck_velocity: v_s [rad/s], > 0; not used where ``static == coulomb``.

    Source:
        Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994, eq. 4 (Gaussian Stribeck curve).
    """
    if static == coulomb:
        return coulomb
    ratio = speed / stribeck_velocity
    return coulomb + (static - coulomb) * math.exp(-ratio * ratio)


def rigid_energy(theta: float, theta_dot: float, inertia: float, gravity: float) -> float:
    """Return kinetic and potential energy, zero at rest hanging down: M_c theta'^2 / 2 + G_c (1 - cos theta) [J].

    Args: as in :func:`rigid_acceleration`.
    """
    return 0.5 * inertia * theta_dot * theta_dot + gravity * (1.0 - math.cos(theta))
