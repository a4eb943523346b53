"""The complete feedback records of all modules as one standard message: a JointState whose names are the quantities.

``sensor_msgs/JointState`` is the one standard message with a stamp, labels and numbers; ``name[i]`` is the quantity
and ``position[i]`` its value in SI units. Of several modules the joint stands before it. The bytes are
written directly: the names never change, so only the stamp and the doubles do. Without ROS: records in, CDR bytes out.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache

from pendulum_hw_bridge.actuator import FEEDBACK_QUANTITIES, Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["QUANTITIES", "encode_feedback"]

QUANTITIES = tuple(FEEDBACK_QUANTITIES)
"""Names of the quantities in a message, in their order."""

_FIRST = Feedback._fields.index(QUANTITIES[0])
_SLICE = slice(_FIRST, _FIRST + len(QUANTITIES))
_STAMP = struct.Struct("<iI")
_STAMP_AT = 4


@cache
def _template(joints: tuple[str, ...]) -> tuple[bytes, int, struct.Struct]:
    """Return the message with zeros, the offset of its values, and what packs them."""
    names = [f"{joint}/{name}" for joint in joints for name in QUANTITIES] if joints else QUANTITIES
    body = bytearray(8)  # stamp
    body += struct.pack("<I", 1) + b"\x00"  # empty frame_id
    body += b"\x00" * (-len(body) % 4)
    body += struct.pack("<I", len(names))
    for name in names:
        text = name.encode() + b"\x00"
        body += struct.pack("<I", len(text)) + text
        body += b"\x00" * (-len(body) % 4)
    body += struct.pack("<I", len(names))
    body += b"\x00" * (-len(body) % 8)
    values = len(body)
    body += bytes(8 * len(names))
    body += struct.pack("<II", 0, 0)  # no velocity, no effort
    return b"\x00\x01\x00\x00" + bytes(body), 4 + values, struct.Struct(f"<{len(names)}d")


def encode_feedback(records: Sequence[Feedback], joints: tuple[str, ...] = (), stamp_ns: int | None = None) -> bytes:
    """Return the CDR bytes of the feedback records of one cycle as a JointState.

    Args:
        records: One of each module.
        joints: Names of their joints, which stand before the quantities: ``cart/position``; none for the only module.
        stamp_ns: Stamp of the message; by default the time of receipt of the oldest record, as of the state [ns].
    """
    template, values_at, values = _template(joints)
    message = bytearray(template)
    stamp = min(record.stamp_ns for record in records) if stamp_ns is None else stamp_ns
    _STAMP.pack_into(message, _STAMP_AT, *divmod(stamp, NANOSECONDS))
    values.pack_into(message, values_at, *(value for record in records for value in tuple(record)[_SLICE]))
    return bytes(message)
