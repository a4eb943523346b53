"""A pole on a cart: x of the cart, theta of the pole, 0 hanging down, positive towards +x.

::

    (M + m) x'' + m c cos(theta) theta'' - m c sin(theta) theta'^2 + b_x x'         = force
    J theta''   + m c cos(theta) x''     + m g c sin(theta)        + b_t theta'     = torque
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.mechanisms.mechanism import Body, Mechanism, Point, gravity_spec, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["CART_POLE"]


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (x'', theta'') [m/s^2, rad/s^2]."""
    cart, pole, _, centre, inertia, g, damping_x, damping_t = p
    moment = pole * centre
    s, c = math.sin(q[1]), math.cos(q[1])
    m_01 = moment * c
    m_00 = cart + pole
    f_0 = torque[0] - damping_x * v[0] + moment * s * v[1] * v[1]
    f_1 = torque[1] - damping_t * v[1] - moment * g * s
    determinant = m_00 * inertia - m_01 * m_01
    return (inertia * f_0 - m_01 * f_1) / determinant, (m_00 * f_1 - m_01 * f_0) / determinant


def mass(q: Any, p: Any) -> Any:
    """Return the mass matrix [kg, kg m; kg m, kg m^2]."""
    cart, pole, _, centre, inertia, _, _, _ = p
    m_01 = pole * centre * math.cos(q[1])
    return (cart + pole, m_01), (m_01, inertia)


def potential(q: Any, p: Any) -> Any:
    """Return m g c (1 - cos theta) [J]."""
    return p[1] * p[5] * p[3] * (1.0 - math.cos(q[1]))


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return cart and tip of the pole [m]."""
    length = p[2]
    return ((q[0], 0.0, 0.0), (q[0] + length * math.sin(q[1]), 0.0, -length * math.cos(q[1])))


def bodies(p: Any) -> tuple[Body, ...]:
    """Return cart and pole."""
    cart, pole, length, centre, inertia, _, _, _ = p
    about_centre = inertia - pole * centre * centre
    small = 0.02 * cart * length * length
    return (
        Body("cart", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), cart, (0.0, 0.0, 0.0), (small, small, small), (0.0, 0.0, 0.0)),
        Body(
            "pole",
            (0.0, 0.0, 0.0),
            (0.0, -1.0, 0.0),
            pole,
            (0.0, 0.0, -centre),
            (about_centre, about_centre, 0.02 * about_centre),
            (0.0, 0.0, -length),
        ),
    )


CART_POLE = Mechanism(
    name="cart_pole",
    title="A pole on a hinge on a cart that slides.",
    joints=(Joint("cart", unit="m", turns=False), Joint("pole", goal=UPRIGHT)),
    parameters=(
        positive("cart_mass", 1.0, "kg", "Cart, motor included, M."),
        positive("pole_mass", 0.1, "kg", "Pole, m."),
        positive("pole_length", 1.0, "m", "Pole, to its tip: to draw it."),
        ParameterSpec("pole_centre", 0.5, "m", "Hinge to the pole's centre of mass, c.", minimum=0.0),
        positive("pole_inertia", 1.0 / 30.0, "kg m^2", "Pole about the hinge, J."),
        gravity_spec(),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    weights=((10.0, 100.0, 1.0, 1.0), 0.1),
    source="R. Tedrake, Underactuated Robotics, chapter 3.2, with the pole's own inertia.",
)
