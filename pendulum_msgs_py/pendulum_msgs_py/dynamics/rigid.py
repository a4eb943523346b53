"""The rigid pendulum, M_c theta'' + b_c theta' + G_c sin(theta) = u, and its dry friction.

Units: theta (0 hanging down) in rad, M_c in kg m^2, b_c in N m s/rad, torques and G_c = m g l_c in N m.
"""

from __future__ import annotations

import math

__all__ = ["friction_magnitude", "gravity_torque", "rigid_acceleration", "rigid_energy"]


def gravity_torque(theta: float, gravity: float) -> float:
    """Return the torque with which gravity resists lifting, G_c sin(theta) [N m]."""
    return gravity * math.sin(theta)


def rigid_acceleration(
    theta: float, theta_dot: float, effort: float, inertia: float, damping: float, gravity: float
) -> float:
    """Return theta'' = (u - b_c theta' - G_c sin theta) / M_c [rad/s^2]; ``effort`` u includes dry friction.

    Source:
        Thesis, "Control of a Pendulum System: From Simulation to Reality", equation of section 4.
    """
    return (effort - damping * theta_dot - gravity * math.sin(theta)) / inertia


def friction_magnitude(speed: float, coulomb: float, static: float, stribeck_velocity: float) -> float:
    """Return the dry friction at a speed, tau_C + (tau_S - tau_C) exp(-(v/v_s)^2) [N m]; v_s > 0 [rad/s].

    Source:
        Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30(7), 1994, eq. 4 (Gaussian Stribeck curve).
    """
    if static == coulomb:
        return coulomb
    ratio = speed / stribeck_velocity
    return coulomb + (static - coulomb) * math.exp(-ratio * ratio)


def rigid_energy(theta: float, theta_dot: float, inertia: float, gravity: float) -> float:
    """Return the energy, 0 at rest hanging down: M_c theta'^2 / 2 + G_c (1 - cos theta) [J]."""
    return 0.5 * inertia * theta_dot * theta_dot + gravity * (1.0 - math.cos(theta))
