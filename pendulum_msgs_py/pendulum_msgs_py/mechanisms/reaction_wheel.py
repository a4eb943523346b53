"""A pendulum that carries a wheel at its end; the wheel's motor turns it against the pendulum.

::

    (J + J_w) q_1'' + J_w q_2'' + m g c sin q_1 + b_1 v_1 = torque_1,      J   = J_p + m_w L^2
    J_w q_1''       + J_w q_2''                 + b_2 v_2 = torque_2,      m c = m_p c_p + m_w L

q_1 is the pendulum from hanging, q_2 the wheel relative to the pendulum; counter-clockwise is positive.
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Point, gravity_spec, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["REACTION_WHEEL"]


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (q_1'', q_2'') [rad/s^2]."""
    m, centre, inertia, m_wheel, arm, _, wheel, g, damping_1, damping_2 = p
    f_1 = torque[0] - damping_1 * v[0] - g * (m * centre + m_wheel * arm) * math.sin(q[0])
    f_2 = torque[1] - damping_2 * v[1]
    swing = (f_1 - f_2) / (inertia + m_wheel * arm * arm)
    return swing, f_2 / wheel - swing


def mass(_q: Any, p: Any) -> Any:
    """Return the mass matrix [kg m^2]."""
    _, _, inertia, m_wheel, arm, _, wheel, _, _, _ = p
    return (inertia + m_wheel * arm * arm + wheel, wheel), (wheel, wheel)


def potential(q: Any, p: Any) -> Any:
    """Return m g c (1 - cos q_1) [J]."""
    return p[7] * (p[0] * p[1] + p[3] * p[4]) * (1.0 - math.cos(q[0]))


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return hinge, axis of the wheel and a mark on its rim [m]."""
    x, z, turned = p[4] * math.sin(q[0]), -p[4] * math.cos(q[0]), q[0] + q[1]
    return ((0.0, 0.0, 0.0), (x, 0.0, z), (x + p[5] * math.sin(turned), 0.0, z - p[5] * math.cos(turned)))


def bodies(p: Any) -> tuple[Body, ...]:
    """Return pendulum and wheel, a thin disc."""
    m, centre, inertia, m_wheel, arm, radius, wheel, _, _, _ = p
    own, axis, zero = inertia - m * centre * centre, (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)
    disc = (0.5 * wheel, wheel, 0.5 * wheel)
    return (
        Body("pendulum_link", zero, axis, m, (0.0, 0.0, -centre), (own, own, 0.02 * own), (0.0, 0.0, -arm)),
        Body("wheel_disc", (0.0, 0.0, -arm), axis, m_wheel, zero, disc, (0.0, 0.0, -radius)),
    )


REACTION_WHEEL = Mechanism(
    name="reaction_wheel",
    title="A pendulum that is balanced by the wheel at its end.",
    # A controller that took angles of the wheel a turn apart as equal would jump with every turn.
    joints=(Joint("swing", goal=UPRIGHT), Joint("wheel", turns=False)),
    parameters=(
        positive("pendulum_mass", 0.2164, "kg", "Pendulum, without the wheel, m_p."),
        ParameterSpec("pendulum_centre", 0.1173, "m", "Hinge to the pendulum's centre of mass, c_p.", minimum=0.0),
        positive("pendulum_inertia", 3.2e-3, "kg m^2", "Pendulum without the wheel about the hinge, J_p."),
        positive("wheel_mass", 0.085, "kg", "Wheel, with what turns of its motor, m_w."),
        positive("wheel_distance", 0.127, "m", "Hinge to the wheel's axis, L."),
        positive("wheel_radius", 0.035, "m", "Wheel, to its rim: to draw it."),
        positive("wheel_inertia", 2.495e-5, "kg m^2", "Wheel about its axis, J_w."),
        gravity_spec(),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    weights=((100.0, 1e-4, 1.0, 1e-4), 400.0),
    source="D. J. Block, K. J. Astrom, M. W. Spong, The Reaction Wheel Pendulum, 2007, chapter 2.",
)
