"""Three links in a plane: shoulder from hanging, elbow and wrist relative to the link before.

With the absolute angles a_1 = q_1, a_2 = q_1 + q_2, a_3 = q_1 + q_2 + q_3::

    sum_j h_ij cos(a_i - a_j) a_j'' + h_ij sin(a_i - a_j) a_j'^2 + g_i sin a_i = torque_i - torque_(i+1)

    h_11 = I_1 + (m_2 + m_3) l_1^2,  h_22 = I_2 + m_3 l_2^2,  h_33 = I_3
    h_12 = l_1 (m_2 r_2 + m_3 l_2),  h_13 = l_1 m_3 r_3,      h_23 = l_2 m_3 r_3
    g_1  = g (m_1 r_1 + (m_2 + m_3) l_1),  g_2 = g (m_2 r_2 + m_3 l_2),  g_3 = g m_3 r_3

I_i are about the link's own joint; counter-clockwise is positive. A motor at elbow or wrist, with its pulleys, adds
J q_i'^2 / 2 to the energy.
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Point, Rotor, gravity_spec, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["TRIPLE_PENDULUM"]


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (q_1'', q_2'', q_3'') [rad/s^2]."""
    m_1, l_1, r_1, i_1, m_2, l_2, r_2, i_2, m_3, _, r_3, i_3, g, rotor_2, rotor_3, damping_1, damping_2, damping_3 = p
    mr_2, mr_3 = m_2 * r_2 + m_3 * l_2, m_3 * r_3
    h_12, h_13, h_23 = l_1 * mr_2, l_1 * mr_3, l_2 * mr_3
    w_1, w_2, w_3 = v[0], v[0] + v[1], v[0] + v[1] + v[2]
    t_1, t_2, t_3 = torque[0] - damping_1 * v[0], torque[1] - damping_2 * v[1], torque[2] - damping_3 * v[2]
    s_12, s_13, s_23 = h_12 * math.sin(q[1]), h_13 * math.sin(q[1] + q[2]), h_23 * math.sin(q[2])
    f_1 = t_1 - t_2 + s_12 * w_2 * w_2 + s_13 * w_3 * w_3 - g * (m_1 * r_1 + (m_2 + m_3) * l_1) * math.sin(q[0])
    f_2 = t_2 - t_3 - s_12 * w_1 * w_1 + s_23 * w_3 * w_3 - g * mr_2 * math.sin(q[0] + q[1])
    f_3 = t_3 - s_13 * w_1 * w_1 - s_23 * w_2 * w_2 - g * mr_3 * math.sin(q[0] + q[1] + q[2])
    # Elimination, from the last link on: M is positive definite.
    m_13, m_23, m_33 = h_13 * math.cos(q[1] + q[2]), h_23 * math.cos(q[2]) - rotor_3, i_3 + rotor_3
    m_12 = h_12 * math.cos(q[1]) - rotor_2 - m_13 * m_23 / m_33
    m_11 = i_1 + (m_2 + m_3) * l_1 * l_1 + rotor_2 - m_13 * m_13 / m_33
    m_22 = i_2 + m_3 * l_2 * l_2 + rotor_2 + rotor_3 - m_23 * m_23 / m_33
    f_1, f_2 = f_1 - m_13 * f_3 / m_33, f_2 - m_23 * f_3 / m_33
    determinant = m_11 * m_22 - m_12 * m_12
    x_1, x_2 = (m_22 * f_1 - m_12 * f_2) / determinant, (m_11 * f_2 - m_12 * f_1) / determinant
    return x_1, x_2 - x_1, (f_3 - m_13 * x_1 - m_23 * x_2) / m_33 - x_2


def mass(q: Any, p: Any) -> Any:
    """Return the mass matrix [kg m^2]."""
    _, l_1, _, i_1, m_2, l_2, r_2, i_2, m_3, _, r_3, i_3, _, rotor_2, rotor_3, _, _, _ = p
    c_12 = l_1 * (m_2 * r_2 + m_3 * l_2) * math.cos(q[1])
    c_13, c_23 = l_1 * m_3 * r_3 * math.cos(q[1] + q[2]), l_2 * m_3 * r_3 * math.cos(q[2])
    m_23 = i_3 + c_23
    m_13, m_22 = m_23 + c_13, i_2 + m_3 * l_2 * l_2 + c_23 + m_23
    m_12 = m_22 + c_12 + c_13
    m_11 = i_1 + (m_2 + m_3) * l_1 * l_1 + c_12 + c_13 + m_12
    return (m_11, m_12, m_13), (m_12, m_22 + rotor_2, m_23), (m_13, m_23, i_3 + rotor_3)


def potential(q: Any, p: Any) -> Any:
    """Return the potential energy, 0 hanging down [J]."""
    m_1, l_1, r_1, _, m_2, l_2, r_2, _, m_3, _, r_3, _, g, _, _, _, _, _ = p
    first = (m_1 * r_1 + (m_2 + m_3) * l_1) * (1.0 - math.cos(q[0]))
    second = (m_2 * r_2 + m_3 * l_2) * (1.0 - math.cos(q[0] + q[1]))
    return g * (first + second + m_3 * r_3 * (1.0 - math.cos(q[0] + q[1] + q[2])))


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return shoulder, elbow, wrist and tip [m]."""
    a_2, a_3 = q[0] + q[1], q[0] + q[1] + q[2]
    x_1, z_1 = p[1] * math.sin(q[0]), -p[1] * math.cos(q[0])
    x_2, z_2 = x_1 + p[5] * math.sin(a_2), z_1 - p[5] * math.cos(a_2)
    tip = (x_2 + p[9] * math.sin(a_3), 0.0, z_2 - p[9] * math.cos(a_3))
    return ((0.0, 0.0, 0.0), (x_1, 0.0, z_1), (x_2, 0.0, z_2), tip)


def bodies(p: Any) -> tuple[Body, ...]:
    """Return the three links."""
    made, above = [], 0.0
    for name, (m, length, centre, inertia) in zip(("upper", "middle", "lower"), (p[:4], p[4:8], p[8:12]), strict=True):
        own, at, axis = inertia - m * centre * centre, (0.0, 0.0, -above), (0.0, -1.0, 0.0)
        moments = (own, own, 0.02 * own)
        made.append(Body(f"{name}_link", at, axis, m, (0.0, 0.0, -centre), moments, (0.0, 0.0, -length)))
        above = length
    return tuple(made)


def rotors(p: Any) -> tuple[Rotor, ...]:
    """Return motors and pulleys of elbow and wrist, which turn with them."""
    return (Rotor(p[13], (0.0, 1.0, 0.0)), Rotor(p[14], (0.0, 0.0, 1.0)))


def _link(number: int, name: str, m: float, length: float, centre: float, inertia: float) -> tuple[ParameterSpec, ...]:
    return (
        positive(f"mass_{number}", m, "kg", f"{name} link, m_{number}."),
        positive(f"length_{number}", length, "m", f"{name} link, from joint to joint or tip, l_{number}."),
        ParameterSpec(
            f"centre_{number}", centre, "m", f"{name} link: joint to centre of mass, r_{number}.", minimum=0.0
        ),
        positive(f"inertia_{number}", inertia, "kg m^2", f"{name} link about its own joint, I_{number}."),
    )


TRIPLE_PENDULUM = Mechanism(
    name="triple_pendulum",
    title="Three links in a plane, with hinges at shoulder, elbow and wrist.",
    joints=(Joint("shoulder", goal=UPRIGHT), Joint("elbow"), Joint("wrist")),
    parameters=(
        *_link(1, "First", 3.25, 0.5, 0.35, 1.052),
        *_link(2, "Second", 1.9, 0.4, 0.181, 0.179),
        *_link(3, "Third", 2.23, 0.49, 0.245, 0.669),
        gravity_spec(),
        ParameterSpec("rotor_2", 0.0, "kg m^2", "Motor and pulleys of the elbow, seen at the elbow.", minimum=0.0),
        ParameterSpec("rotor_3", 0.0, "kg m^2", "Motor and pulleys of the wrist, seen at the wrist.", minimum=0.0),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    rotors=rotors,
    weights=((10.0, 10.0, 10.0, 1.0, 1.0, 1.0), 0.01),
    source="K. Furuta, T. Ochiai, N. Ono, Attitude control of a triple inverted pendulum, Int. J. Control 39(6), 1984.",
)
