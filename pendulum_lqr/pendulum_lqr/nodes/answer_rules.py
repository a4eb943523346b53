"""Rules on which states get a command, as functions of numbers that the compiled loop compiles too."""

from __future__ import annotations

__all__ = ["DUPLICATE", "FROM_FUTURE", "LONGEST", "NEW", "OUT_OF_ORDER", "STALE", "is_saturated", "judge_state"]

NEW, STALE, FROM_FUTURE, DUPLICATE, OUT_OF_ORDER = range(5)
"""Results of :func:`judge_state`."""
LONGEST = 2**62
"""A timeout that no age reaches [ns]."""


def judge_state(stamp_ns: int, now_ns: int, timeout_ns: int, newest_ns: int) -> int:
    """Return whether a state is new, or the first reason why it is not.

    Args:
        stamp_ns: Stamp of the state [ns].
        now_ns: Time of arrival on the clock of the stamps; in simulated time, which has no age, the stamp [ns].
        timeout_ns: Largest age, positive or negative, at most ``LONGEST`` [ns].
        newest_ns: Stamp of the newest processed state; ``NEVER`` before the first [ns].
    """
    age_ns = now_ns - stamp_ns
    if age_ns > timeout_ns:
        return STALE
    if age_ns < -timeout_ns:
        return FROM_FUTURE
    if stamp_ns > newest_ns:
        return NEW
    return DUPLICATE if stamp_ns == newest_ns else OUT_OF_ORDER


def is_saturated(effort: float, limit: float) -> bool:
    """Return whether a torque is at its limit [N m]."""
    return abs(effort) >= limit
