"""Feedback records of all modules as one ``sensor_msgs/JointState``, without ROS: records in, CDR bytes out.

JointState is the one standard message with stamp, labels and numbers. ``name[i]`` is the quantity, prefixed by the
joint if there are several modules; ``position[i]`` is its value in SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES, Feedback
from pendulum_msgs_py.contract.cdr import encode_joints

__all__ = ["QUANTITIES", "encode_feedback"]

QUANTITIES = tuple(FEEDBACK_QUANTITIES)
"""Names of the quantities of a message, in order."""

_FIRST = Feedback._fields.index(QUANTITIES[0])
_SLICE = slice(_FIRST, _FIRST + len(QUANTITIES))


@cache
def _names(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint}/{name}" for joint in joints for name in QUANTITIES) if joints else QUANTITIES


def encode_feedback(records: Sequence[Feedback], joints: tuple[str, ...] = (), stamp_ns: int | None = None) -> bytes:
    """Return the CDR bytes of the feedback records of one cycle as a JointState.

    Args:
        records: One of each module.
        joints: Names of their joints, as prefixes (``cart/position``); none for a single module.
        stamp_ns: Stamp of the message; by default the oldest time of receipt, as of the state [ns].
    """
    stamp = min(record.stamp_ns for record in records) if stamp_ns is None else stamp_ns
    return encode_joints(
        stamp, "", _names(joints), tuple(value for record in records for value in tuple(record)[_SLICE])
    )
