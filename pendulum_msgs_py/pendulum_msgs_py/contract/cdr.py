"""JointState of one joint to and from CDR bytes with one precompiled struct.

rclpy builds, serialises and deserialises a JointState in 4, 4 and 11 us; with a fixed layout the same takes a
fraction of a microsecond. The layout is checked in full before a byte is believed: whatever differs (another
joint, several joints, another byte order) is left to real deserialisation.

Layout (XCDR1, little endian; offsets after the four bytes of encapsulation header)::

    0   int32 sec, uint32 nanosec, uint32 length, frame_id with NUL, padding to 4
        uint32 1, uint32 length, joint name with NUL, padding to 4
        uint32 n, padding to 8 if n, n doubles: position; likewise velocity and effort

Source: OMG CDR (formal/02-06-51, section 15.3); sensor_msgs/msg/JointState.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["MAX_SECONDS", "JointStateFields", "decode_joint_state", "encode_clock", "encode_joint_state"]

MAX_SECONDS = 2**31 - 1
"""Largest ``sec`` of a ROS time stamp."""

_HEADER = b"\x00\x01\x00\x00"
_PREFIX = struct.Struct("<4xiII")
_COUNT = struct.Struct("<I")
_TIME = struct.Struct("<iI")
_MAX_TRAILING = 15
_MOST_KNOWN = 64
"""Layouts that are remembered; a stranger's endless names must not take memory without bound."""


class JointStateFields(NamedTuple):
    """What a JointState of one joint holds; None for a quantity that the message leaves out."""

    stamp_ns: int
    frame_id: str
    joint: str
    position: float | None
    velocity: float | None
    effort: float | None


def encode_joint_state(
    stamp_ns: int,
    *,
    frame_id: str = "",
    joint: str = JOINT,
    position: float | None = None,
    velocity: float | None = None,
    effort: float | None = None,
) -> bytes:
    """Return the CDR bytes of a JointState of one joint, padding zeroed, so that equal messages are equal bytes.

    Args:
        stamp_ns: Stamp, 0 to ``MAX_SECONDS`` seconds [ns].
        frame_id: Header frame, by our contract the name of the sender.
        joint: Joint name.
        position: theta [rad], or None to leave it out.
        velocity: theta' [rad/s], or None.
        effort: Torque [N m], or None.

    Raises:
        struct.error: The stamp does not fit a ROS time.
    """
    layout, name_bytes = _layout(frame_id, joint, position is not None, velocity is not None, effort is not None)
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    frame = frame_id.encode() + b"\x00"
    values: list[object] = [sec, nanosec, len(frame), frame, 1, len(name_bytes), name_bytes]
    for quantity in (position, velocity, effort):
        if quantity is None:
            values.append(0)
        else:
            values.append(1)
            values.append(quantity)
    return _HEADER + layout.pack(*values)


def encode_clock(stamp_ns: int) -> bytes:
    """Return the CDR bytes of a rosgraph_msgs/Clock.

    Args:
        stamp_ns: Simulated time, 0 to ``MAX_SECONDS`` seconds [ns].

    Raises:
        struct.error: The time does not fit a ROS time.
    """
    return _HEADER + _TIME.pack(*divmod(stamp_ns, NANOSECONDS))


def decode_joint_state(data: bytes) -> JointStateFields | None:
    """Return the fields of a one-joint JointState, or None where the bytes have any other layout.

    Args:
        data: A serialised message, encapsulation header included.
    """
    size = len(data)
    known = _known_layouts.get((size, data[12:16]))
    if known is not None:
        values = known.layout.unpack(data)
        # All that tells one layout from another: the encapsulation, the names with their lengths, the counts.
        if values[0] == _PLAIN_CDR and values[3:8] == known.names and values[2] < NANOSECONDS:
            if known.complete:
                if values[8] == values[10] == values[12] == 1:
                    return JointStateFields(
                        values[1] * NANOSECONDS + values[2], known.frame_id, known.joint, *values[9:14:2]
                    )
            elif values[8:11] == _EFFORT_ALONE:
                return JointStateFields(
                    values[1] * NANOSECONDS + values[2], known.frame_id, known.joint, None, None, values[11]
                )
    if size < 24 or data[0:2] != _PLAIN_CDR:
        return None
    try:
        sec, nanosec, frame_length = _PREFIX.unpack_from(data)
        # Offsets below count from the start of ``data``; CDR aligns relative to byte 4, and 4 is a multiple of 4.
        frame_end = 16 + frame_length
        offset = (frame_end + 3) & ~3
        if frame_length == 0 or offset + 8 > size or data[frame_end - 1] != 0:
            return None
        joints, name_length = struct.unpack_from("<II", data, offset)
        name_start = offset + 8
        name_end = name_start + name_length
        if joints != 1 or name_length == 0 or name_end > size or data[name_end - 1] != 0:
            return None
        offset = (name_end + 3) & ~3
        quantities: list[float | None] = []
        for _ in range(3):
            (count,) = _COUNT.unpack_from(data, offset)
            offset += 4
            if count == 0:
                quantities.append(None)
            elif count == 1:
                offset += (4 - offset) & 7
                quantities.append(struct.unpack_from("<d", data, offset)[0])
                offset += 8
            else:
                return None
        # rclpy reserves room for the alignment of each sequence, empty ones too, and leaves it at the end.
        if size - offset > _MAX_TRAILING or nanosec >= NANOSECONDS:
            return None
        frame_id = data[16 : frame_end - 1].decode()
        joint = data[name_start : name_end - 1].decode()
    except (struct.error, UnicodeDecodeError):
        return None
    if "\0" in frame_id or "\0" in joint:
        return None
    fields = JointStateFields(sec * NANOSECONDS + nanosec, frame_id, joint, *quantities)
    _remember_layout(fields, size)
    return fields


class _KnownLayout(NamedTuple):
    """What the messages of one sender have in common; reading another then takes one call."""

    layout: struct.Struct
    names: tuple[object, ...]
    frame_id: str
    joint: str
    complete: bool


_PLAIN_CDR = b"\x00\x01"
_EFFORT_ALONE = (0, 0, 1)
_known_layouts: dict[tuple[int, bytes], _KnownLayout] = {}
"""One layout for each size of message and of its sender's name; the first comer's, so that two do not take turns."""


def forget_layouts() -> None:
    """Forget all remembered layouts, as at the start of the process."""
    _known_layouts.clear()


def _remember_layout(fields: JointStateFields, size: int) -> None:
    """Remember the layout of a state, or of a torque alone: the messages that come a thousand times a second."""
    present = tuple(quantity is not None for quantity in fields[3:])
    complete = present == (True, True, True)
    frame = fields.frame_id.encode() + b"\x00"
    key = (size, _COUNT.pack(len(frame)))
    if key in _known_layouts or len(_known_layouts) >= _MOST_KNOWN:
        return
    if not (complete or present == (False, False, True)):
        return
    layout, name = _layout(fields.frame_id, fields.joint, *present)
    trailing = size - len(_HEADER) - layout.size
    _known_layouts[key] = _KnownLayout(
        struct.Struct(f"<2s2x{layout.format[1:]}{trailing}x"),
        (len(frame), frame, 1, len(name), name),
        fields.frame_id,
        fields.joint,
        complete,
    )


_layout_cache: dict[tuple[str, str, bool, bool, bool], tuple[struct.Struct, bytes]] = {}


def _layout(
    frame_id: str, joint: str, has_position: bool, has_velocity: bool, has_effort: bool
) -> tuple[struct.Struct, bytes]:
    key = (frame_id, joint, has_position, has_velocity, has_effort)
    cached = _layout_cache.get(key)
    if cached is not None:
        return cached
    frame_length = len(frame_id.encode()) + 1
    name_bytes = joint.encode() + b"\x00"
    pieces = ["<iII", f"{frame_length}s"]
    offset = 12 + frame_length
    pieces.append(f"{-offset % 4}xII{len(name_bytes)}s")
    offset += -offset % 4 + 8 + len(name_bytes)
    pieces.append(f"{-offset % 4}x")
    offset += -offset % 4
    for present in (has_position, has_velocity, has_effort):
        pieces.append("I")
        offset += 4
        if present:
            pieces.append(f"{-offset % 8}xd")
            offset += -offset % 8 + 8
    layout = struct.Struct("".join(pieces))
    # A node sends under one or two names; a stranger's endless names must not grow the cache without bound.
    if len(_layout_cache) >= 256:
        _layout_cache.clear()
    _layout_cache[key] = (layout, name_bytes)
    return layout, name_bytes
