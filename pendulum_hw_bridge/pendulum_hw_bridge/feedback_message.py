"""The complete feedback record as one standard message: a JointState whose names are the quantities.

``sensor_msgs/JointState`` is the one standard message with a stamp, labels and numbers; ``name[i]`` is the quantity
and ``position[i]`` its value in SI units. The bytes are written directly: the names never change, so only the stamp
and nineteen doubles do. Without ROS: CDR bytes in, CDR bytes out.
"""

from __future__ import annotations

import struct

from pendulum_hw_bridge.actuator import FEEDBACK_QUANTITIES, Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["QUANTITIES", "encode_feedback"]

QUANTITIES = tuple(FEEDBACK_QUANTITIES)
"""Names of the quantities in a message, in their order."""

_FIRST = Feedback._fields.index(QUANTITIES[0])
_SLICE = slice(_FIRST, _FIRST + len(QUANTITIES))


def _template() -> tuple[bytes, int, int]:
    """Return the message with zeros, and the offsets of its stamp and of its values."""
    body = bytearray(8)  # stamp
    body += struct.pack("<I", 1) + b"\x00"  # empty frame_id
    body += b"\x00" * (-len(body) % 4)
    body += struct.pack("<I", len(QUANTITIES))
    for name in QUANTITIES:
        text = name.encode() + b"\x00"
        body += struct.pack("<I", len(text)) + text
        body += b"\x00" * (-len(body) % 4)
    body += struct.pack("<I", len(QUANTITIES))
    body += b"\x00" * (-len(body) % 8)
    values = len(body)
    body += bytes(8 * len(QUANTITIES))
    body += struct.pack("<II", 0, 0)  # no velocity, no effort
    return b"\x00\x01\x00\x00" + bytes(body), 4, 4 + values


_TEMPLATE, _STAMP_AT, _VALUES_AT = _template()
_STAMP = struct.Struct("<iI")
_VALUES = struct.Struct(f"<{len(QUANTITIES)}d")


def encode_feedback(feedback: Feedback) -> bytes:
    """Return the CDR bytes of a feedback record as a JointState.

    Args:
        feedback: The record; its stamp is the time of receipt.
    """
    message = bytearray(_TEMPLATE)
    _STAMP.pack_into(message, _STAMP_AT, *divmod(feedback.stamp_ns, NANOSECONDS))
    _VALUES.pack_into(message, _VALUES_AT, *tuple(feedback)[_SLICE])
    return bytes(message)
