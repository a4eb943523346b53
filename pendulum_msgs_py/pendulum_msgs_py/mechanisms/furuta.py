"""A rotary pendulum: an arm that turns about the vertical, a slender pendulum on a hinge along it, 0 hanging down.

::

    M_11 = J_1 + m L^2 + J_2 sin^2 q_2,   M_12 = m L c cos q_2,   M_22 = J_2
    M_11 q_1'' + M_12 q_2'' + 2 J_2 sin q_2 cos q_2 v_1 v_2 - m L c sin q_2 v_2^2 + b_1 v_1 = torque_1
    M_12 q_1'' + M_22 q_2'' - J_2 sin q_2 cos q_2 v_1^2     + m g c sin q_2       + b_2 v_2 = torque_2

Counter-clockwise from above is positive; a positive pendulum angle leans in the direction of a positive arm velocity.
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Point, gravity_spec, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["FURUTA"]

_SLENDER = 1e-9
"""Share of a slender rod's inertia about its own axis, required by file formats."""


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (q_1'', q_2'') [rad/s^2]."""
    arm_inertia, arm, m, _, centre, inertia, g, damping_1, damping_2 = p
    s, c = math.sin(q[1]), math.cos(q[1])
    h = m * arm * centre
    whirl = inertia * s * c
    m_11 = arm_inertia + m * arm * arm + inertia * s * s
    m_12 = h * c
    f_1 = torque[0] - damping_1 * v[0] - 2.0 * whirl * v[0] * v[1] + h * s * v[1] * v[1]
    f_2 = torque[1] - damping_2 * v[1] + whirl * v[0] * v[0] - m * g * centre * s
    determinant = m_11 * inertia - m_12 * m_12
    return (inertia * f_1 - m_12 * f_2) / determinant, (m_11 * f_2 - m_12 * f_1) / determinant


def mass(q: Any, p: Any) -> Any:
    """Return the mass matrix [kg m^2]."""
    arm_inertia, arm, m, _, centre, inertia, _, _, _ = p
    s = math.sin(q[1])
    m_12 = m * arm * centre * math.cos(q[1])
    return (arm_inertia + m * arm * arm + inertia * s * s, m_12), (m_12, inertia)


def potential(q: Any, p: Any) -> Any:
    """Return m g c (1 - cos q_2) [J]."""
    return p[2] * p[6] * p[4] * (1.0 - math.cos(q[1]))


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return axis, end of the arm and tip of the pendulum [m]."""
    arm, length = p[1], p[3]
    s_1, c_1 = math.sin(q[0]), math.cos(q[0])
    out = length * math.sin(q[1])
    return (
        (0.0, 0.0, 0.0),
        (arm * c_1, arm * s_1, 0.0),
        (arm * c_1 - out * s_1, arm * s_1 + out * c_1, -length * math.cos(q[1])),
    )


def bodies(p: Any) -> tuple[Body, ...]:
    """Return arm and pendulum; the arm's whole inertia is about its axis, its unknown mass has no effect."""
    arm_inertia, arm, m, length, centre, inertia, _, _, _ = p
    about_centre = inertia - m * centre * centre
    return (
        Body("arm", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), m, (0.0, 0.0, 0.0), (arm_inertia, arm_inertia, arm_inertia),
             (arm, 0.0, 0.0)),
        Body("pendulum", (arm, 0.0, 0.0), (1.0, 0.0, 0.0), m, (0.0, 0.0, -centre),
             (about_centre, about_centre, _SLENDER * about_centre), (0.0, 0.0, -length)),
    )  # fmt: skip


FURUTA = Mechanism(
    name="furuta",
    title="A pendulum on the end of an arm that turns about the vertical.",
    joints=(Joint("arm"), Joint("pendulum", goal=UPRIGHT)),
    parameters=(
        positive("arm_inertia", 2.3e-4, "kg m^2", "Arm about its axis, motor included, J_1."),
        positive("arm_length", 0.085, "m", "Axis to the pendulum's hinge, L."),
        positive("pendulum_mass", 0.024, "kg", "Pendulum, m."),
        positive("pendulum_length", 0.129, "m", "Pendulum, to its tip: to draw it."),
        ParameterSpec("pendulum_centre", 0.0645, "m", "Hinge to the pendulum's centre of mass, c.", minimum=0.0),
        positive("pendulum_inertia", 1.33e-4, "kg m^2", "Pendulum about its hinge, J_2."),
        gravity_spec(),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    weights=((1.0, 10.0, 0.1, 0.1), 100.0),
    source="B. S. Cazzolato and Z. Prime, On the dynamics of the Furuta pendulum, J. Control Sci. Eng., 2011, eq. 33.",
    in_space=True,
)
