"""One-joint ``sensor_msgs/JointState`` messages from CDR bytes to arrays, thousands at a time.

CDR aligns each value to its size, counted from the end of the encapsulation. For one joint the layout depends on two
string lengths and on which of position, velocity and effort are present::

    encapsulation[4]  sec i32  nanosec u32  frame_id: u32 n, n bytes   names: u32 1, u32 m, m bytes
    position: u32 0|1, (f64)   velocity: u32 0|1, (f64)   effort: u32 0|1, (f64)

The layout is taken from a topic's first message. Each message is checked against all its constant bytes (not padding,
which rclpy leaves uninitialised); those that fit are copied column by column, the rest is tried with the layout of the
first that did not fit.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from pendulum_rosbag.reader.batches import MCAP_HEAD, Batch, Int64, items_at
from pendulum_rosbag.storage.mcap_records import MESSAGE

__all__ = ["FIELDS", "JointStateParser", "Layout", "Trimmer", "canonical", "layout_of", "two_motions"]

FIELDS = np.dtype(
    [("log_time_ns", "<i8"), ("stamp_ns", "<i8"), ("position", "<f8"), ("velocity", "<f8"), ("effort", "<f8")]
)
"""Columns of the arrays: times [ns], position [rad], velocity [rad/s], effort [N m]; absent values are NaN."""

_BLOCK = 8192  # messages parsed at once: their bytes stay in the cache
_MAX_EXPECTED = 1 << 22  # messages for which memory is allocated in advance: a damaged file may claim any number
_MAX_COPY = 1 << 26  # bytes of messages that are copied at once
_MAX_FRAME = 255  # bytes of a frame id that are kept: no name in ROS is longer
_LAYOUTS = 16  # layouts tried in one batch before a topic counts as not fixed


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the fields of a message are; offsets count from the first byte of encapsulation.

    Args:
        size: Bytes up to the last field (a serialiser may append meaningless ones).
        joint: Its name, with the terminating zero.
        frame: Start and length of the frame id without its terminating zero.
        values: Offset of position, velocity and effort; -1 if absent.
        constants: (offset, bytes) that every message of this layout has.
    """

    size: int
    joint: bytes
    frame: tuple[int, int]
    values: tuple[int, int, int]
    constants: tuple[tuple[int, bytes], ...]


def layout_of(data: bytes) -> Layout | None:
    """Return the layout of a one-joint JointState, ``None`` for other bytes."""
    try:
        if data[:2] != b"\x00\x01":  # little-endian CDR
            return None
        (frame_size,) = struct.unpack_from("<I", data, 12)
        if not 1 <= frame_size <= len(data) or data[15 + frame_size] != 0:
            return None
        constants = [(0, data[:2]), (12, data[12:16])]
        at = _align(16 + frame_size, 4)
        names, name_size = struct.unpack_from("<II", data, at)
        if names != 1 or not 1 <= name_size <= len(data) or at + 8 + name_size > len(data):
            return None
        constants.append((at, data[at : at + 8 + name_size]))
        at += 8 + name_size
        joint = data[at - name_size : at]
        values = []
        for _ in range(3):
            at = _align(at, 4)
            (count,) = struct.unpack_from("<I", data, at)
            if count > 1:
                return None
            constants.append((at, data[at : at + 4]))
            at += 4
            if count:
                at = _align(at, 8)
                values.append(at)
                at += 8
            else:
                values.append(-1)
    except (struct.error, IndexError):
        return None
    if at > len(data):
        return None
    # The frame id's terminating zero is as constant as its length.
    constants.append((15 + frame_size, b"\x00"))
    position, velocity, effort = values
    return Layout(at, joint, (16, frame_size - 1), (position, velocity, effort), tuple(constants))


def _align(at: int, size: int) -> int:
    return at + (4 - at) % size


def canonical(data: bytes) -> bytes:
    """Return a one-joint JointState with zeroed padding and nothing after its last field; others unchanged.

    rclpy leaves padding uninitialised, so equal messages may differ in their bytes.
    """
    layout = layout_of(data)
    if layout is None:
        return data
    clean = bytearray(layout.size)
    spans = [(4, 16), (layout.frame[0], layout.frame[0] + layout.frame[1])]
    spans += [(start, start + len(content)) for start, content in layout.constants]
    spans += [(start, start + 8) for start in layout.values if start >= 0]
    for start, stop in spans:
        clean[start:stop] = data[start:stop]
    return bytes(clean)


class Trimmer:
    """Cuts off up to twelve meaningless bytes that rclpy appends to JointStates, which rosbags refuses."""

    def __init__(self) -> None:
        self._layouts: list[Layout] = []

    def __call__(self, data: bytes) -> bytes:
        """Return the message without trailing bytes."""
        for layout in self._layouts:
            if all(data[start : start + len(content)] == content for start, content in layout.constants):
                return data if len(data) <= layout.size else data[: layout.size]
        layout_found = layout_of(data)
        if layout_found is None:
            return data
        self._layouts = [*self._layouts[-_LAYOUTS:], layout_found]
        return data[: layout_found.size]


_APART, _BACK, _SHARE = 0.05, 0.2, 0.12
"""Two motions on one topic: least jump [rad], its remainder after the jump back, and share of such messages."""


def two_motions(position: npt.NDArray[Any]) -> str:
    """Return how an angle, shape (n,) [rad], jumps to and fro if two senders share a topic, in words."""
    finite = np.isfinite(position)
    known = position if finite.all() else position[finite]
    steps = np.diff(known)
    if max(float(np.max(steps, initial=0.0)), -float(np.min(steps, initial=0.0))) <= _APART:
        return ""
    steps = np.diff(np.unwrap(known))
    least = np.minimum(np.abs(steps[1:]), np.abs(steps[:-1]))
    # An encoder at rest between two counts goes to and fro, too: 0.36 deg of 1000 counts, read as radians.
    levels = np.diff(np.unique(known))
    count_size = float(np.min(levels, initial=0.4, where=levels > 1e-9))
    there_and_back = (least > max(_APART, 1.5 * count_size)) & (np.abs(steps[1:] + steps[:-1]) < _BACK * least)
    count = int(np.sum(there_and_back))
    if count < max(10, _SHARE * known.size):
        return ""
    return f"{count} of {known.size} messages jump by {float(np.median(least[there_and_back])):.2g} rad and back"


def _words(offset: int, content: bytes) -> list[tuple[int, str, int]]:
    """Split constant bytes into integers, so that each check is one column comparison."""
    pieces = []
    while content:
        size = next(size for size in (8, 4, 2, 1) if size <= len(content))
        pieces.append((offset, f"<u{size}", int.from_bytes(content[:size], "little")))
        offset += size
        content = content[size:]
    return pieces


@dataclass(frozen=True, slots=True)
class _Plan:
    """A layout as a numpy record type over a message (and in MCAP its record head)."""

    item: np.dtype[Any]
    checks: tuple[tuple[str, Any], ...]
    least_length: int


@lru_cache(maxsize=256)
def _plan(layout: Layout, head: int, channel: int) -> _Plan:
    names, formats, offsets = [], [], []
    checks = []

    def column(name: str, kind: str, offset: int) -> None:
        names.append(name)
        formats.append(kind)
        offsets.append(offset)

    if head:
        column("opcode", "u1", 0)
        column("length", "<u8", 1)
        column("channel", "<u2", 9)
        column("log_time", "<i8", 15)
        checks += [("opcode", np.uint8(MESSAGE)), ("channel", np.uint16(channel))]
    column("sec", "<i4", head + 4)
    column("nanosec", "<u4", head + 8)
    start, size = layout.frame
    if size:
        column("frame", f"S{min(size, _MAX_FRAME)}", head + start)
    for name, offset in zip(("position", "velocity", "effort"), layout.values, strict=True):
        if offset >= 0:
            column(name, "<f8", head + offset)
    for offset, content in layout.constants:
        for place, kind, value in _words(offset, content):
            name = f"constant_{place}"
            column(name, kind, head + place)
            checks.append((name, np.dtype(kind).type(value)))
    item = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": head + layout.size})
    return _Plan(item, tuple(checks), layout.size + 22)


@dataclass(slots=True)
class _Columns:
    """The array under construction, and its frame ids (short while they do not change)."""

    array: npt.NDArray[Any]
    at: int = 0
    joint: bytes | None = None
    frames: list[tuple[Any, int, Any]] = field(default_factory=list)


class JointStateParser:
    """Collects the messages of one topic, of which about ``count`` are expected."""

    def __init__(self, count: int) -> None:
        self._columns = _Columns(np.empty(min(count, _MAX_EXPECTED), FIELDS))
        self._fixed = True

    def add(self, batch: Batch) -> None:
        """Parse more messages; after one that is not a JointState of the same one joint, ignore the rest."""
        if not self._fixed:
            return
        columns = self._columns
        needed = columns.at + len(batch.offsets)
        if needed > len(columns.array):
            spare = np.empty(max(needed, 2 * len(columns.array)) - len(columns.array), FIELDS)
            columns.array = np.concatenate([columns.array, spare])
        self._fixed = _parse_batch(batch, columns)

    def result(self) -> npt.NDArray[Any] | None:
        """Return the messages in the order of :meth:`add`, or ``None`` if one did not fit.

        Structured array with the columns :data:`FIELDS`, and ``frame_id`` when any message has one. One-joint
        JointStates in little-endian CDR fit, of the same joint.
        """
        return _with_frames(self._columns) if self._fixed else None


def _parse_batch(batch: Batch, columns: _Columns) -> bool:
    layouts: list[Layout] = []
    for begin in range(0, len(batch.offsets), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        sizes = None if batch.sizes is None else batch.sizes[block]
        if not _parse_block(batch, batch.offsets[block], batch.times[block], sizes, columns, layouts):
            return False
    return True


def _parse_block(
    batch: Batch, offsets: Int64, times: Int64, sizes: Int64 | None, columns: _Columns, layouts: list[Layout]
) -> bool:
    out = columns.array[columns.at : columns.at + len(offsets)]
    out["log_time_ns"] = times
    left: Int64 | None = None  # rows that no layout has fitted yet; None for all
    tried = 0
    while left is None or len(left):
        if tried == len(layouts):
            first = 0 if left is None else int(left[0])
            layout = layout_of(_message(batch, int(offsets[first]), None if sizes is None else int(sizes[first])))
            if layout is None or layout in layouts or tried >= _LAYOUTS:
                return False
            if columns.joint not in {None, layout.joint}:
                return False
            columns.joint = layout.joint
            layouts.append(layout)
        layout = layouts[tried]
        tried += 1
        rows = _fit(batch, layout, offsets, times, sizes, left, out, columns)
        if rows is None:
            break
        left = rows
    columns.at += len(offsets)
    return True


def _fit(
    batch: Batch,
    layout: Layout,
    offsets: Int64,
    times: Int64,
    sizes: Int64 | None,
    left: Int64 | None,
    out: npt.NDArray[Any],
    columns: _Columns,
) -> Int64 | None:
    """Copy the rows that have a layout; return the others, ``None`` for none."""
    plan = _plan(layout, batch.head, batch.channel)
    size = plan.item.itemsize
    if left is not None:
        offsets, times = offsets[left], times[left]
        sizes = None if sizes is None else sizes[left]
    places = len(batch.buffer) - size + 1
    inside = offsets < places
    if places <= 0 or not inside.all():
        # A row too near to the end of the buffer has another layout.
        rows = np.arange(len(out)) if left is None else left
        if places <= 0 or not inside.any():
            return rows
        sizes = None if sizes is None else sizes[inside]
        rest = _fit_items(batch, plan, offsets[inside], times[inside], sizes, rows[inside], out, columns, layout)
        return np.sort(np.concatenate([rows[~inside], rest])) if rest is not None else rows[~inside]
    return _fit_items(batch, plan, offsets, times, sizes, left, out, columns, layout)


def _fit_items(
    batch: Batch,
    plan: _Plan,
    offsets: Int64,
    times: Int64,
    sizes: Int64 | None,
    left: Int64 | None,
    out: npt.NDArray[Any],
    columns: _Columns,
    layout: Layout,
) -> Int64 | None:
    size = plan.item.itemsize
    if len(offsets) > 1 and len(offsets) * size > _MAX_COPY:
        # Long frame ids: halve, so that the copy stays small whatever the messages claim.
        rows = np.arange(len(out)) if left is None else left
        rests = [
            _fit_items(
                batch,
                plan,
                offsets[part],
                times[part],
                None if sizes is None else sizes[part],
                rows[part],
                out,
                columns,
                layout,
            )
            for part in (slice(None, len(offsets) // 2), slice(len(offsets) // 2, None))
        ]
        found = [rest for rest in rests if rest is not None]
        return np.concatenate(found) if found else None
    items = items_at(batch.buffer, plan.item, offsets)
    fits = items["length"] >= plan.least_length if sizes is None else sizes >= layout.size
    if sizes is None:
        fits &= items["log_time"] == times
    for name, value in plan.checks:
        fits &= items[name] == value
    if fits.all():
        _copy_columns(items, layout, out if left is None else left, out, columns)
        return None
    rows = np.arange(len(out)) if left is None else left
    if fits.any():
        _copy_columns(items[fits], layout, rows[fits], out, columns)
    return rows[~fits]


def _copy_columns(
    items: npt.NDArray[Any], layout: Layout, where: Any, out: npt.NDArray[Any], columns: _Columns
) -> None:
    whole = where is out
    rows = slice(None) if whole else where
    out["stamp_ns"][rows] = items["sec"].astype(np.int64) * 1_000_000_000 + items["nanosec"]
    for name, offset in zip(("position", "velocity", "effort"), layout.values, strict=True):
        out[name][rows] = items[name] if offset >= 0 else np.nan
    if layout.frame[1]:
        frames = items["frame"]
        constant = bool((frames == frames[0]).all())
        kept = frames[:1].copy() if constant else frames.copy()
        columns.frames.append((columns.at, len(out), kept) if whole else (columns.at + where, -1, kept))


def _with_frames(columns: _Columns) -> npt.NDArray[Any]:
    array = columns.array[: columns.at]
    if not columns.frames:
        return array
    texts = [np.char.decode(kept, "utf-8", "replace") for _, _, kept in columns.frames]
    width = max(text.dtype.itemsize // 4 for text in texts)
    wide = np.empty(len(array), [*((name, FIELDS[name]) for name in FIELDS.names or ()), ("frame_id", f"<U{width}")])
    for name in FIELDS.names or ():
        wide[name] = array[name]
    wide["frame_id"] = ""
    for (place, length, _), text in zip(columns.frames, texts, strict=True):
        rows: Any = slice(place, place + length) if length >= 0 else place
        wide["frame_id"][rows] = text
    return wide


def _message(batch: Batch, offset: int, size: int | None) -> bytes:
    view = batch.buffer.data
    if size is None:
        size = int.from_bytes(view[offset + 1 : offset + 9], "little") - 22
        offset += MCAP_HEAD
    return bytes(view[offset : offset + max(size, 0)])
