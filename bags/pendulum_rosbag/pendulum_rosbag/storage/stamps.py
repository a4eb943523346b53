"""Log times from the messages themselves, so that a simulated run has the same log times every time."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable

from pendulum_rosbag.storage.message_types import typestore

__all__ = ["LOG_TIMES", "StampReader", "stamp_reader"]

LOG_TIMES = ("receive", "header")
"""Log time: time of arrival, or the message's stamp."""

StampReader = Callable[[bytes], int | None]
"""From CDR bytes to the stamp [ns], ``None`` if the message has none."""

_LITTLE = struct.Struct("<iI")
_BIG = struct.Struct(">iI")


def stamp_reader(type_name: str) -> StampReader | None:
    """Return the reader of a type's stamp (leading Header or time, or a JSON event's ``stamp_ns``), or None."""
    if type_name == "std_msgs/msg/String":
        return _event_stamp
    definition = typestore().fielddefs.get(type_name)
    if definition is None or not definition[1]:
        return None
    first = str(definition[1][0][1][1])
    if first in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"):
        return _leading_stamp
    return None


def _leading_stamp(data: bytes) -> int | None:
    if len(data) < 12:
        return None
    sec, nanosec = (_LITTLE if data[1] & 1 else _BIG).unpack_from(data, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def _event_stamp(data: bytes) -> int | None:
    if data[8:9] != b"{":
        return None
    try:
        return int(json.loads(data[8:].split(b"\0")[0])["stamp_ns"])
    except (ValueError, KeyError, TypeError):
        return None
