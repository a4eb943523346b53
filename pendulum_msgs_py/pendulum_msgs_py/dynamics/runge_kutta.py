"""One step of a mechanism's smooth equations, on tuples: interpreted, or compiled by numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["along_1", "along_2", "along_3", "along_functions", "rk4_joints"]


def along_1(q: Any, h: Any, v: Any) -> Any:
    """Return q + h v, of one joint."""
    return (q[0] + h * v[0],)


def along_2(q: Any, h: Any, v: Any) -> Any:
    """Return q + h v, of two joints."""
    return q[0] + h * v[0], q[1] + h * v[1]


def along_3(q: Any, h: Any, v: Any) -> Any:
    """Return q + h v, of three joints."""
    return q[0] + h * v[0], q[1] + h * v[1], q[2] + h * v[2]


def along_functions(count: int) -> Callable[..., Any]:
    """Return the function for this number of joints."""
    return {1: along_1, 2: along_2, 3: along_3}[count]


def rk4_joints(
    forward: Any, along: Any, q: Any, v: Any, torque_0: Any, torque_mid: Any, torque_1: Any, h: float, p: Any
) -> Any:
    """Return (q, v) after a step h [s] of the classical Runge-Kutta method of order four.

    ``forward`` is the mechanism's equation with parameters ``p``; q in rad or m; the efforts of all joints at start,
    middle and end of the step in N m or N.
    """
    half = 0.5 * h
    a_1 = forward(q, v, torque_0, p)
    v_2 = along(v, half, a_1)
    a_2 = forward(along(q, half, v), v_2, torque_mid, p)
    v_3 = along(v, half, a_2)
    a_3 = forward(along(q, half, v_2), v_3, torque_mid, p)
    v_4 = along(v, h, a_3)
    a_4 = forward(along(q, h, v_3), v_4, torque_1, p)
    sixth, third = h / 6.0, h / 3.0
    return (
        along(along(along(along(q, sixth, v), third, v_2), third, v_3), sixth, v_4),
        along(along(along(along(v, sixth, a_1), third, a_2), third, a_3), sixth, a_4),
    )
