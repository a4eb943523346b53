"""The pendulum as a mechanism of one joint, M q'' + b q' + G sin(q) = torque."""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.contract.names import LINK
from pendulum_msgs_py.dynamics.rigid import rigid_acceleration, rigid_energy
from pendulum_msgs_py.mechanisms.mechanism import STANDARD_GRAVITY, Body, Mechanism, Point, positive
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["PENDULUM"]

_BOB_SHARE = 0.9
_FLAT_LENGTH = 0.3


def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
    """Return (q'',) [rad/s^2]."""
    inertia, gravity, damping = p
    return (rigid_acceleration(q[0], v[0], torque[0], inertia, damping, gravity),)


def mass(_q: Any, p: Any) -> Any:
    """Return ((M,),) [kg m^2]."""
    return ((p[0],),)


def potential(q: Any, p: Any) -> Any:
    """Return G (1 - cos q) [J]."""
    return rigid_energy(q[0], 0.0, p[0], p[1])


def _shape(p: Any) -> tuple[float, float]:
    """Return mass and length of a bob with nine tenths of the inertia, as the file has M and G only."""
    at_bob = _BOB_SHARE * p[0]
    length = at_bob * STANDARD_GRAVITY / p[1] if p[1] > 0.0 else _FLAT_LENGTH
    return at_bob / length**2, length


def chain(q: Any, p: Any) -> tuple[Point, ...]:
    """Return hinge and bob [m]."""
    length = _shape(p)[1]
    return ((0.0, 0.0, 0.0), (length * math.sin(q[0]), 0.0, -length * math.cos(q[0])))


def bodies(p: Any) -> tuple[Body, ...]:
    """Return the link."""
    weight, length = _shape(p)
    rest = p[0] - weight * length**2
    return (
        Body(
            LINK,
            (0.0, 0.0, 0.0),
            (0.0, -1.0, 0.0),
            weight,
            (0.0, 0.0, -length),
            (rest, rest, 0.02 * rest),
            (0.0, 0.0, -length),
        ),
    )


PENDULUM = Mechanism(
    name="pendulum",
    title="One link on a driven hinge.",
    joints=ONE_JOINT.joints,
    parameters=(
        positive("inertia", 0.055, "kg m^2", "Inertia about the joint, M_c."),
        ParameterSpec(
            "gravity", 1.678, "N m", "Gravity coefficient, G_c = m g l_c; 0 for a pendulum that lies flat.", minimum=0.0
        ),
    ),
    forward=forward,
    mass=mass,
    potential=potential,
    chain=chain,
    bodies=bodies,
    weights=((100.0, 0.01), 0.1),
    source='Thesis, "Control of a Pendulum System: From Simulation to Reality", section 4.',
)
