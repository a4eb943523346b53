"""Two links in a plane: shoulder from hanging, elbow relative to the first link; counter-clockwise is positive.

::

    M(q) q'' + c(q, v) + g(q) + D v = torque,      h = m_2 l_1 r_2

    M_11 = I_1 + I_2 + m_2 l_1^2 + 2 h cos q_2 + (N^2 + 1) J_r
    M_12 = I_2 + h cos q_2 - N J_r,    M_22 = I_2 + N^2 J_r
    c    = (-h sin q_2 (2 v_1 v_2 + v_2^2),  h sin q_2 v_1^2)
    g    = (g (m_1 r_1 + m_2 l_1) sin q_1 + m_2 g r_2 sin(q_1 + q_2),  m_2 g r_2 sin(q_1 + q_2))

I_i are about the link's own joint. Each joint has a motor of rotor inertia J_r behind gears N; the first link carries
the elbow's. With a motor at the elbow alone it is the acrobot, at the shoulder alone the pendubot.
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Point, Rotor, gravity_spec, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["DOUBLE_PENDULUM"]


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (q_1'', q_2'') [rad/s^2]."""
    m_1, l_1, r_1, i_1, m_2, _, r_2, i_2, g, rotor, gear, damping_1, damping_2 = p
    h = m_2 * l_1 * r_2
    h_c, h_s = h * math.cos(q[1]), h * math.sin(q[1])
    m_11 = i_1 + i_2 + m_2 * l_1 * l_1 + 2.0 * h_c + (gear * gear + 1.0) * rotor
    m_12 = i_2 + h_c - gear * rotor
    m_22 = i_2 + gear * gear * rotor
    weight_2 = m_2 * g * r_2 * math.sin(q[0] + q[1])
    weight_1 = g * (m_1 * r_1 + m_2 * l_1) * math.sin(q[0]) + weight_2
    f_1 = torque[0] - damping_1 * v[0] - weight_1 + h_s * (2.0 * v[0] + v[1]) * v[1]
    f_2 = torque[1] - damping_2 * v[1] - weight_2 - h_s * v[0] * v[0]
    determinant = m_11 * m_22 - m_12 * m_12
    return (m_22 * f_1 - m_12 * f_2) / determinant, (m_11 * f_2 - m_12 * f_1) / determinant


def mass(q: Any, p: Any) -> Any:
    """Return the mass matrix [kg m^2]."""
    _, l_1, _, i_1, m_2, _, r_2, i_2, _, rotor, gear, _, _ = p
    h_c = m_2 * l_1 * r_2 * math.cos(q[1])
    m_12 = i_2 + h_c - gear * rotor
    m_11 = i_1 + i_2 + m_2 * l_1 * l_1 + 2.0 * h_c + (gear * gear + 1.0) * rotor
    return (m_11, m_12), (m_12, i_2 + gear * gear * rotor)


def potential(q: Any, p: Any) -> Any:
    """Return the potential energy, 0 hanging down [J]."""
    m_1, l_1, r_1, _, m_2, _, r_2, _, g, _, _, _, _ = p
    first = (m_1 * r_1 + m_2 * l_1) * (1.0 - math.cos(q[0]))
    return g * (first + m_2 * r_2 * (1.0 - math.cos(q[0] + q[1])))


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return shoulder, elbow and tip [m]."""
    l_1, l_2 = p[1], p[5]
    x, z = l_1 * math.sin(q[0]), -l_1 * math.cos(q[0])
    return ((0.0, 0.0, 0.0), (x, 0.0, z), (x + l_2 * math.sin(q[0] + q[1]), 0.0, z - l_2 * math.cos(q[0] + q[1])))


def bodies(p: Any) -> tuple[Body, ...]:
    """Return the two links."""
    m_1, l_1, r_1, i_1, m_2, l_2, r_2, i_2, _, _, _, _, _ = p
    own_1, own_2 = i_1 - m_1 * r_1 * r_1, i_2 - m_2 * r_2 * r_2
    axis = (0.0, -1.0, 0.0)
    return (
        Body(
            "upper_link", (0.0, 0.0, 0.0), axis, m_1, (0.0, 0.0, -r_1), (own_1, own_1, 0.02 * own_1), (0.0, 0.0, -l_1)
        ),
        Body(
            "lower_link", (0.0, 0.0, -l_1), axis, m_2, (0.0, 0.0, -r_2), (own_2, own_2, 0.02 * own_2), (0.0, 0.0, -l_2)
        ),
    )


def rotors(p: Any) -> tuple[Rotor, ...]:
    """Return the rotors: the shoulder's turns N times as fast, the elbow's, on link 1, N times backwards."""
    rotor, gear = p[9], p[10]
    return (Rotor(rotor, (gear, 0.0)), Rotor(rotor, (1.0, -gear)))


DOUBLE_PENDULUM = Mechanism(
    name="double_pendulum",
    title="Two links in a plane, a hinge at the shoulder and one at the elbow.",
    joints=(Joint("shoulder", goal=UPRIGHT), Joint("elbow")),
    parameters=(
        positive("mass_1", 0.523, "kg", "First link, m_1."),
        positive("length_1", 0.2, "m", "Shoulder to elbow, l_1."),
        ParameterSpec("centre_1", 0.2, "m", "Shoulder to the first link's centre of mass, r_1.", minimum=0.0),
        positive("inertia_1", 0.0319, "kg m^2", "First link about the shoulder, I_1."),
        positive("mass_2", 0.626, "kg", "Second link, m_2."),
        positive("length_2", 0.3, "m", "Elbow to the tip, l_2: to draw it, and its height."),
        ParameterSpec("centre_2", 0.256, "m", "Elbow to the second link's centre of mass, r_2.", minimum=0.0),
        positive("inertia_2", 0.0509, "kg m^2", "Second link about the elbow, I_2."),
        gravity_spec(),
        ParameterSpec("rotor_inertia", 0.0, "kg m^2", "Rotor of each motor, at the motor, J_r.", minimum=0.0),
        ParameterSpec("gear_ratio", 1.0, "-", "Motor turns per turn of a joint, N.", minimum=0.0),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    rotors=rotors,
    weights=((10.0, 10.0, 1.0, 1.0), 1.0),
    source="F. Wiebe et al., Open-source dual-purpose acrobot and pendubot platform, IEEE RAM 31(2), 2024, eq. 1 to 4.",
)
