"""JointState to and from CDR bytes, with one precompiled struct for each kind of message.

rclpy builds, serialises and deserialises a JointState in 4, 4 and 11 us; this takes a fraction of 1 us. The layout is
checked in full before a value is used; any other message (no names, another byte order) is deserialised by rclpy.

Layout (XCDR1, little endian; offsets after the four bytes of encapsulation header)::

    0   int32 sec, uint32 nanosec, uint32 length, frame_id with NUL, padding to 4
        uint32 joints; for each: uint32 length, its name with NUL, padding to 4
        uint32 n, padding to 8 if n, n doubles: position; likewise velocity and effort

Source: OMG CDR (formal/02-06-51, section 15.3); sensor_msgs/msg/JointState.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.values import NANOSECONDS, Vector

__all__ = [
    "MAX_SECONDS",
    "JointStateFields",
    "MessageTemplate",
    "decode_joint_state",
    "encode_clock",
    "encode_joint_state",
    "encode_joints",
    "template_of",
]

MAX_SECONDS = 2**31 - 1
"""Largest ``sec`` of a ROS time stamp."""

_HEADER = b"\x00\x01\x00\x00"
_PLAIN_CDR = b"\x00\x01"
_MARK = struct.unpack("<d", b"\xff" * 8)[0]
"""A number whose bytes all differ from those of 0."""
_PREFIX = struct.Struct("<4xiII")
_COUNT = struct.Struct("<I")
_TIME = struct.Struct("<iI")
_MAX_TRAILING = 15
_MOST_KNOWN = 64
"""Bound of the cache: unknown senders must not fill the memory."""
_MOST_JOINTS = 32
"""Messages with more joints are deserialised by rclpy."""


class JointStateFields(NamedTuple):
    """Content of a JointState; a quantity has one value per joint, or none if the message omits it."""

    stamp_ns: int
    frame_id: str
    joints: tuple[str, ...]
    position: Vector
    velocity: Vector
    effort: Vector


class MessageTemplate(NamedTuple):
    """The constant bytes of one sender's messages.

    Attributes:
        data: A message with stamp, numbers and padding zero.
        mask: As long: 255 where a byte must match, 0 in stamp, numbers and padding.
        value_at: Offset of each number, by quantity, then by joint [bytes].
    """

    data: bytes
    mask: bytes
    value_at: tuple[int, ...]


def encode_joints(
    stamp_ns: int,
    frame_id: str,
    joints: tuple[str, ...],
    position: Vector = (),
    velocity: Vector = (),
    effort: Vector = (),
) -> bytes:
    """Return the CDR bytes of a JointState; padding is zero, so that equal messages are equal bytes.

    The stamp is 0 to ``MAX_SECONDS`` s [ns], else a ``struct.error``. Each quantity has one value per joint, or none:
    positions [rad or m], velocities [rad/s or m/s], efforts [N m or N].
    """
    n_position, n_velocity, n_effort = len(position), len(velocity), len(effort)
    layout, words = _layout(frame_id, joints, n_position, n_velocity, n_effort)
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    return _HEADER + layout.pack(sec, nanosec, *words, n_position, *position, n_velocity, *velocity, n_effort, *effort)


def encode_joint_state(
    stamp_ns: int,
    *,
    frame_id: str = "",
    joint: str = JOINT,
    position: float | None = None,
    velocity: float | None = None,
    effort: float | None = None,
) -> bytes:
    """Return :func:`encode_joints` of one joint: stamp [ns], theta [rad], theta' [rad/s], torque [N m]."""
    return encode_joints(
        stamp_ns,
        frame_id,
        (joint,),
        () if position is None else (position,),
        () if velocity is None else (velocity,),
        () if effort is None else (effort,),
    )


def template_of(fields: JointStateFields, size: int = 0) -> MessageTemplate:
    """Return the template of a message with these fields and this size [bytes]; 0 for no trailing bytes."""
    quantities = fields[3:]
    counts = tuple(len(quantity) for quantity in quantities)
    layout, words = _layout(fields.frame_id, fields.joints, *counts)

    def pack(same: tuple[object, ...], values: tuple[float, ...], tell: Callable[[int], int]) -> bytes:
        numbers, rest = [], list(values)
        for count in counts:
            numbers += [tell(count), *rest[:count]]
            del rest[:count]
        return layout.pack(0, 0, *same, *numbers)

    zeros = (0.0,) * sum(counts)
    data = pack(words, zeros, lambda count: count)
    same = tuple(b"\xff" * len(word) if isinstance(word, bytes) else 0xFFFFFFFF for word in words)
    mask = pack(same, zeros, lambda _: 0xFFFFFFFF)
    head = len(_HEADER)
    value_at = []
    for index in range(len(zeros)):
        marked = pack(words, (*zeros[:index], _MARK, *zeros[index + 1 :]), lambda count: count)
        value_at.append(head + next(at for at, (a, b) in enumerate(zip(marked, data, strict=True)) if a != b))
    trailing = bytes(max(0, size - head - layout.size))
    # The options of the encapsulation may differ.
    kept = _PLAIN_CDR + bytes(head - len(_PLAIN_CDR))
    same_head = b"\xff" * len(_PLAIN_CDR) + bytes(head - len(_PLAIN_CDR))
    return MessageTemplate(kept + data + trailing, same_head + mask + trailing, tuple(value_at))


def encode_clock(stamp_ns: int) -> bytes:
    """Return the CDR bytes of a rosgraph_msgs/Clock; raise ``struct.error`` beyond ``MAX_SECONDS`` seconds [ns]."""
    return _HEADER + _TIME.pack(*divmod(stamp_ns, NANOSECONDS))


def decode_joint_state(data: bytes) -> JointStateFields | None:
    """Return the fields of a serialised JointState with its encapsulation header, or None for any other layout."""
    size = len(data)
    known = _known_layouts.get((size, data[12:16]))
    if known is not None:
        values = known.layout.unpack(data)
        # Two layouts differ in encapsulation, names with their lengths, or counts.
        if values[0] == _PLAIN_CDR and values[3 : known.first] == known.words and values[2] < NANOSECONDS:
            n, first = known.n, known.first
            if known.complete:
                second = first + n + 1
                third = second + n + 1
                if values[first] == values[second] == values[third] == n:
                    return JointStateFields(
                        values[1] * NANOSECONDS + values[2],
                        known.frame_id,
                        known.joints,
                        values[first + 1 : second],
                        values[second + 1 : third],
                        values[third + 1 :],
                    )
            elif values[first : first + 3] == known.effort_alone:
                return JointStateFields(
                    values[1] * NANOSECONDS + values[2], known.frame_id, known.joints, (), (), values[first + 3 :]
                )
    fields = _decode_unknown(data) if size >= 24 and data[0:2] == _PLAIN_CDR else None
    if fields is not None:
        _remember_layout(fields, size)
    return fields


def _decode_unknown(data: bytes) -> JointStateFields | None:
    size = len(data)
    try:
        sec, nanosec, frame_length = _PREFIX.unpack_from(data)
        # Offsets below count from the start of ``data``; CDR aligns relative to byte 4, and 4 is a multiple of 4.
        frame_end = 16 + frame_length
        offset = (frame_end + 3) & ~3
        if frame_length == 0 or offset + 8 > size or data[frame_end - 1] != 0:
            return None
        names, offset = _decode_names(data, offset)
        if not names:
            return None
        quantities: list[Vector] = []
        for _ in range(3):
            (count,) = _COUNT.unpack_from(data, offset)
            offset += 4
            if count not in {0, len(names)}:
                return None
            if count:
                offset += (4 - offset) & 7
            quantities.append(struct.unpack_from(f"<{count}d", data, offset))
            offset += 8 * count
        # rclpy reserves space for the alignment of each sequence, empty ones too, and leaves it at the end.
        if size - offset > _MAX_TRAILING or nanosec >= NANOSECONDS:
            return None
        frame_id = data[16 : frame_end - 1].decode()
    except (struct.error, UnicodeDecodeError):
        return None
    if "\0" in frame_id or any("\0" in name for name in names):
        return None
    return JointStateFields(sec * NANOSECONDS + nanosec, frame_id, names, *quantities)


def _decode_names(data: bytes, offset: int) -> tuple[tuple[str, ...], int]:
    (count,) = _COUNT.unpack_from(data, offset)
    offset += 4
    names = []
    for _ in range(count if count <= _MOST_JOINTS else 0):
        offset = (offset + 3) & ~3
        (length,) = _COUNT.unpack_from(data, offset)
        begin, offset = offset + 4, offset + 4 + length
        if length == 0 or offset > len(data) or data[offset - 1] != 0:
            return (), offset
        names.append(data[begin : offset - 1].decode())
    return tuple(names), (offset + 3) & ~3


class _KnownLayout(NamedTuple):
    layout: struct.Struct
    words: tuple[object, ...]
    first: int
    n: int
    frame_id: str
    joints: tuple[str, ...]
    complete: bool
    effort_alone: tuple[int, int, int]


_known_layouts: dict[tuple[int, bytes], _KnownLayout] = {}
"""One layout for each size of message and of its sender's name: the first, so that two do not evict each other."""


def _remember_layout(fields: JointStateFields, size: int) -> None:
    """Cache the layout of a full state or of efforts alone: the frequent messages."""
    counts = tuple(len(quantity) for quantity in fields[3:])
    n = len(fields.joints)
    complete = counts == (n, n, n)
    key = (size, _COUNT.pack(len(fields.frame_id.encode()) + 1))
    if key in _known_layouts or len(_known_layouts) >= _MOST_KNOWN:
        return
    if not (complete or counts == (0, 0, n)):
        return
    layout, words = _layout(fields.frame_id, fields.joints, *counts)
    trailing = size - len(_HEADER) - layout.size
    _known_layouts[key] = _KnownLayout(
        struct.Struct(f"<2s2x{layout.format[1:]}{trailing}x"),
        words,
        3 + len(words),
        n,
        fields.frame_id,
        fields.joints,
        complete,
        (0, 0, n),
    )


_layout_cache: dict[tuple[str, tuple[str, ...], int, int, int], tuple[struct.Struct, tuple[object, ...]]] = {}


def _layout(
    frame_id: str, joints: tuple[str, ...], n_position: int, n_velocity: int, n_effort: int
) -> tuple[struct.Struct, tuple[object, ...]]:
    """Return the struct of a message, and its constant words between stamp and counts."""
    key = (frame_id, joints, n_position, n_velocity, n_effort)
    cached = _layout_cache.get(key)
    if cached is not None:
        return cached
    frame = frame_id.encode() + b"\x00"
    words: list[object] = [len(frame), frame, len(joints)]
    pieces = ["<iII", f"{len(frame)}s"]
    offset = 12 + len(frame)
    pieces.append(f"{-offset % 4}xI")
    offset += -offset % 4 + 4
    for joint in joints:
        name = joint.encode() + b"\x00"
        words += [len(name), name]
        pieces.append(f"{-offset % 4}xI{len(name)}s")
        offset += -offset % 4 + 4 + len(name)
    pieces.append(f"{-offset % 4}x")
    offset += -offset % 4
    for count in (n_position, n_velocity, n_effort):
        pieces.append("I")
        offset += 4
        if count:
            pieces.append(f"{-offset % 8}x{count}d")
            offset += -offset % 8 + 8 * count
    layout = struct.Struct("".join(pieces))
    # A node sends under one or two names; other senders must not grow the cache without bound.
    if len(_layout_cache) >= 256:
        _layout_cache.clear()
    _layout_cache[key] = layout, tuple(words)
    return _layout_cache[key]
