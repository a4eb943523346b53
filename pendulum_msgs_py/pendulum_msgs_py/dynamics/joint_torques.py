"""Torques that a joint's angle and velocity determine: quadratic drag, and torques of twice and three times the angle.

::

    tau = a_2 cos 2q + b_2 sin 2q + a_3 cos 3q + b_3 sin 3q - c v |v|

Cogging of a motor, an eccentric gear or a cable gives the periodic ones; a sliding joint has none.
"""

from __future__ import annotations

import math
from typing import Any

__all__ = ["JOINT_TORQUES", "PERIODIC", "drag_torque", "joint_torque", "periodic_energy", "periodic_torque"]

PERIODIC = ("torque_cos_2", "torque_sin_2", "torque_cos_3", "torque_sin_3")
"""Names of the amplitudes in plant files, in the order of :func:`periodic_torque`."""
JOINT_TORQUES = ("quadratic_drag", *PERIODIC)
"""Names of all of them, in the order of :func:`joint_torque`; 0, their default, is none."""


def periodic_torque(q: Any, cos_2: Any, sin_2: Any, cos_3: Any, sin_3: Any) -> Any:
    """Return the torque of the angle [N m]."""
    s, c = math.sin(q), math.cos(q)
    s_2, c_2 = 2.0 * s * c, c * c - s * s
    return cos_2 * c_2 + sin_2 * s_2 + cos_3 * (c_2 * c - s_2 * s) + sin_3 * (s_2 * c + c_2 * s)


def periodic_energy(q: Any, cos_2: Any, sin_2: Any, cos_3: Any, sin_3: Any) -> Any:
    """Return minus the integral of the torque, 0 at q = 0 [J]."""
    twice = 0.5 * (sin_2 * (math.cos(2.0 * q) - 1.0) - cos_2 * math.sin(2.0 * q))
    return twice + (sin_3 * (math.cos(3.0 * q) - 1.0) - cos_3 * math.sin(3.0 * q)) / 3.0


def drag_torque(v: Any, drag: Any) -> Any:
    """Return the torque of the velocity [N m or N]."""
    # |v| as a square root, which has a complex step's derivative.
    return -drag * v * math.sqrt(v * v)


def joint_torque(q: Any, v: Any, drag: Any, cos_2: Any, sin_2: Any, cos_3: Any, sin_3: Any) -> Any:
    """Return the torques of angle and velocity [N m or N]."""
    return periodic_torque(q, cos_2, sin_2, cos_3, sin_3) + drag_torque(v, drag)
