"""Laws of controllers as functions of numbers: interpreted here, compiled in compiled loops."""

from __future__ import annotations

from collections.abc import Callable, Iterable, MutableSequence, Sequence

from pendulum_msgs_py.contract.angles import wrap_angle
from pendulum_msgs_py.contract.values import Vector

__all__ = [
    "EFFORT_LIMIT",
    "MOST_MEMORY",
    "MOST_NUMBERS",
    "OWN",
    "SET_POINT",
    "Law",
    "clamped",
    "deviation",
    "winds_up",
    "within_limits",
]

Law = Callable[[float, float, float, MutableSequence[float], Sequence[float]], float]
"""``law(t, angle, velocity, memory, numbers)`` -> torque [N m].

Time since the first state [s], angle from upright [rad] and velocity [rad/s] are finite; ``numbers`` come from the
design, ``memory`` is state, changed in place. It is compiled unchanged, so it uses only numbers, ``math``, indices and
functions of this project that do likewise.
"""

EFFORT_LIMIT, SET_POINT, OWN = range(3)
"""Indices of the limit [N m] and the set-point [rad, from upright] in a law's numbers, and of its first own one."""
MOST_NUMBERS, MOST_MEMORY = 320, 128
"""Of a law that is compiled."""


def clamped(effort: float, limit: float) -> float:
    """Return a torque within a limit [N m]; NaN passes unchanged."""
    if effort > limit:
        return limit
    if effort < -limit:  # not by max(), whose result for NaN differs where it is compiled
        return -limit
    return effort


def within_limits(wanted: Iterable[float], limits: Vector) -> Vector:
    """Return efforts within symmetric limits [N m or N]; NaN passes unchanged, and the sender refuses it."""
    return tuple([top if u > top else max(float(u), -top) for u, top in zip(wanted, limits, strict=True)])


def deviation(angle: float, set_point: float) -> float:
    """Return the deviation of an angle from a set-point, the short way round [rad]."""
    return wrap_angle(angle - set_point)


def winds_up(push: float, wanted: float, effort: float) -> bool:
    """Return whether an integral must pause because it would push its effort further beyond the limit [N m or N].

    Conditional integration: it may unwind at the limit; NaN is not integrated.

    Args:
        push: Effect of the integral's next step on the effort, of any size.
        wanted: Effort including that step.
        effort: The same within its limit.
    """
    return not (wanted == effort or (wanted - effort) * push < 0.0)
