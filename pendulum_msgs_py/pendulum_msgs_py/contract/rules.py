"""The rules of a plant as functions of numbers, for one command or one joint at a time.

Gates, supervisor and compiled loops run these very functions; the caller names, counts and reports the results.
"""

from __future__ import annotations

import math

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = [
    "ACCEPTED",
    "COMMANDER_HOLD",
    "DUPLICATE",
    "FROM_FUTURE",
    "FUTURE_TOLERANCE_NS",
    "NEVER",
    "OUT_OF_ORDER",
    "SECOND_COMMANDER",
    "TOO_OLD",
    "age_of",
    "has_expired",
    "has_lapsed",
    "is_ahead",
    "is_inside",
    "is_last",
    "judge_stamp",
    "rise_within",
    "within",
]

COMMANDER_HOLD = 1.0
"""Silence after which another commander may take over [s]."""
FUTURE_TOLERANCE_NS = 5_000_000
"""How far ahead of the plant's clock a stamp may lie [ns]."""
NEVER = -(2**63)
"""Stands for a missing stamp."""

ACCEPTED, TOO_OLD, FROM_FUTURE, SECOND_COMMANDER, DUPLICATE, OUT_OF_ORDER = range(6)
"""Results of :func:`judge_stamp`."""
_HOLD_NS = round(COMMANDER_HOLD * NANOSECONDS)


def judge_stamp(stamp_ns: int, now_ns: int, timeout_ns: int, newest_ns: int, heard_ns: int, other: bool) -> int:
    """Return ``ACCEPTED`` or the first reason to refuse a command.

    ``newest_ns`` is the stamp of the newest accepted command or ``NEVER``, ``heard_ns`` its arrival on the plant's
    clock [ns]; ``other`` says whether this command comes from another sender.
    """
    if now_ns - stamp_ns > timeout_ns:
        return TOO_OLD
    if is_ahead(stamp_ns, now_ns):
        return FROM_FUTURE
    # After a clock stepped back, the last command lies in the future: it no longer defines an order.
    if newest_ns == NEVER or is_ahead(newest_ns, now_ns):
        return ACCEPTED
    if other and 0 <= now_ns - heard_ns <= _HOLD_NS:
        return SECOND_COMMANDER
    if stamp_ns == newest_ns:
        return DUPLICATE
    return OUT_OF_ORDER if stamp_ns < newest_ns else ACCEPTED


def is_ahead(stamp_ns: int, now_ns: int) -> bool:
    """Return whether a stamp lies further ahead of the plant's clock than ``FUTURE_TOLERANCE_NS``."""
    return stamp_ns - now_ns > FUTURE_TOLERANCE_NS


def has_expired(stamp_ns: int, heard_ns: int, now_ns: int, timeout_ns: int) -> bool:
    """Return whether a command is too old to act on, by its stamp or by its arrival [ns].

    Both, so that a clock step can only shorten its life. An arrival after ``now_ns`` is no such step: a plant that
    catches up decides as of each missed period.
    """
    return now_ns - stamp_ns > timeout_ns or abs(now_ns - heard_ns) > timeout_ns


def has_lapsed(commanded_ns: int, now_ns: int) -> bool:
    """Return whether the commander has timed out, so that the next command begins a new one."""
    return now_ns - commanded_ns > _HOLD_NS


def is_last(stamp_ns: int, newest_ns: int) -> bool:
    """Return whether a zero effort ends its commander's commands: it is stamped 1 ns after the last reply.

    The motor is then released at once; otherwise the zero would keep its torque loop active until it expires.
    """
    return stamp_ns == newest_ns + 1


def age_of(stamp_ns: int, now_ns: int) -> float:
    """Return the age of a stamp [s]."""
    return (now_ns - stamp_ns) / NANOSECONDS


def is_inside(low: float, position: float, high: float, velocity: float, fastest: float) -> bool:
    """Return whether a joint is inside its window and speed limit; False for NaN."""
    return low <= position <= high and -fastest <= velocity <= fastest


def within(value: float, limit: float) -> float:
    """Return a value clamped to +-limit; 0 for NaN."""
    if -limit <= value <= limit:
        return value
    if math.isnan(value):
        return 0.0
    return limit if value > 0.0 else -limit


def rise_within(last: float, wanted: float, step: float) -> float:
    """Return the wanted effort, rising from zero by at most a step; torque without a command must fall at once."""
    return min(max(last, 0.0) + step, max(min(last, 0.0) - step, wanted))
