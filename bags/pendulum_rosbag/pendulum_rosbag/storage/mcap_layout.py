"""Byte layout of an MCAP file that is complete at every instant while it grows.

MCAP readers start at the footer at the end of the file, so a file that grows by appending is broken when its writer
dies. This file has space to grow: a private record that every reader skips::

    magic  header | settled chunks | space to grow | staged chunks | summary A | summary B | data end, footer, magic
                                   ^ settled_end   ^ area.start    ^ area.stop

- Chunk and summary are written to invisible places: the summary to whichever of A and B the footer does not name, after
  a data end (Foxglove's reader needs it) and with a private checksum record (the footer's would cover the place that is
  written next). Two small writes make them visible: a record head for sequential readers, then the footer for index
  readers.
- Frequent seals make small chunks and a long index, so small chunks are only staged. When enough have accumulated, one
  large chunk replaces them behind the settled ones; readers see the same messages throughout. The full staging area is
  reused from its start, some megabytes later.
- When the space is used up, one write far beyond the end moves the end of the file; the hole occupies no disk space.
  ``finish`` cuts the rest off.
- Each commit lies within one memory page, which the kernel copies as a whole: a process killed at any instruction
  leaves the state before or after. (Foxglove's stream reader, which accepts nothing after the last record, sees the
  moment at which the end moves. At a power failure the disk may reorder pages: ``sync`` bounds the loss.)
- Messages stay in order of arrival: sorting by log time would delay messages that a killed recording should contain.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata
from pendulum_rosbag.storage.mcap_summary import Chunk, McapSummary
from pendulum_rosbag.storage.storage_file import write_at

__all__ = ["McapLayout"]

_PAGE = 4096
_DATA_END = rec.record(rec.DATA_END, bytes(4))
_TAIL_SIZE = len(_DATA_END) + rec.FOOTER_SIZE + len(rec.MAGIC)
_FIRST_ROOM = 1 << 20
_LARGEST_ROOM = 16 << 20
_FIRST_SLOT = 16 * _PAGE
_LARGEST_GROUP = 1 << 20
_HEAD = rec.RECORD_HEAD_SIZE


@dataclass(slots=True)
class _Slot:
    start: int
    capacity: int
    described: int = -1
    settled: int = 0
    group: int = -1
    staged: int = 0
    offsets_start: int = 0


@dataclass(frozen=True, slots=True)
class _Area:
    start: int
    stop: int


class McapLayout:
    """The bytes of one growing MCAP file, whose ``header`` is magic and header record.

    Methods raise OSError when the disk is full or fails; readers then see the file as before the call.
    """

    def __init__(self, path: Path, header: bytes, summary: McapSummary) -> None:
        self.path = path
        self.summary = summary
        self.settled_end = len(header)
        self._fd = -1
        self._size = 0
        self._slots: list[_Slot] = []
        self._live = 0
        # Start of the padding before the tail, after any staged chunks.
        self._chain_end = self.settled_end
        self._area = self._next_area = _Area(0, 0)
        self._cursor = 0
        self._create(header)

    def _create(self, header: bytes) -> None:
        temporary = self.path.with_name(f".{self.path.name}.tmp")
        try:
            self._fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
            self._size = _FIRST_ROOM + _FIRST_ROOM // 2 + 2 * _FIRST_SLOT
            self._slots = self._place_slots(_FIRST_SLOT)
            self._area = self._next_area = _Area(
                self._slots[0].start - _FIRST_ROOM // 2, self._slots[0].start - len(_DATA_END)
            )
            self._cursor = self._area.start
            write_at(self._fd, header + rec.padding_head(len(header), self._tail), 0)
            self._fill_slot(self._slots[0])
            write_at(self._fd, self._tail_bytes(self._slots[0]), self._tail)
            os.rename(temporary, self.path)
        except OSError:
            self.abandon()
            temporary.unlink(missing_ok=True)
            raise

    @property
    def is_open(self) -> bool:
        """Whether the file is still being written."""
        return self._fd >= 0

    @property
    def group_limit(self) -> int:
        """Bytes of messages that are staged before they settle as one chunk (less in a short file)."""
        return min(_LARGEST_GROUP, (self._area.stop - self._area.start) // 4)

    def can_stage(self, size: int) -> bool:
        """Return whether a chunk of this size [bytes] fits into the staging area."""
        if self._chain_end == self.settled_end:
            self._begin_group()
        return self._next_stage + size + _PAGE <= self._area.stop

    def can_settle(self, size: int) -> bool:
        """Return whether a chunk of this size [bytes] fits before the staged ones; without those it always does."""
        return self._chain_end == self.settled_end or self.settled_end + size + _PAGE <= self._area.start

    def stage(self, chunk: Chunk) -> int:
        """Write a small chunk, show it to sequential readers and return its offset."""
        start = self._next_stage
        blob, end = self._blob(chunk.parts, start, chunk.size)
        if self._chain_end == self.settled_end:
            write_at(self._fd, blob, start)
            write_at(self._fd, rec.padding_head(self.settled_end, start), self.settled_end)
        else:
            write_at(self._fd, blob[_HEAD:], start + _HEAD)
            write_at(self._fd, blob[:_HEAD], start)
        self._chain_end = end
        return start

    def settle(self, chunk: Chunk) -> int:
        """Write a large chunk in place of the staged ones, show it to sequential readers and return its offset."""
        if self._chain_end == self.settled_end and self.settled_end + chunk.size + _PAGE > self._area.start:
            self._grow(chunk.size + _PAGE)
        start = self.settled_end
        blob, end = self._blob(chunk.parts, start, chunk.size)
        write_at(self._fd, blob[_HEAD:], start + _HEAD)
        write_at(self._fd, blob[:_HEAD], start)
        if self._chain_end != start:
            self._cursor = self._chain_end
        if self._area != self._next_area:
            self._area = self._next_area
            self._cursor = self._area.start
        self.settled_end = self._chain_end = end
        return start

    def publish(self) -> None:
        """Show the current summary to index readers."""
        slot = self._slots[1 - self._live]
        if not self._fill_slot(slot):
            self._grow(0)
            return
        self._live = 1 - self._live
        write_at(self._fd, self._tail_bytes(slot), self._tail)

    def duplicate(self) -> int:
        """Return a duplicate descriptor, so that waiting for the disk does not block the writer."""
        return os.dup(self._fd)

    def finish(self, extras: Sequence[Attachment | Metadata] = ()) -> None:
        """Append attachments, metadata, summary and footer to the data and cut off the unused room."""
        indexes: list[bytes] = []
        start = self._chain_end
        for extra in extras:
            entry = extra.record()
            self._make_room(start + len(entry) + _PAGE)
            blob, end = self._blob([entry], start, len(entry))
            write_at(self._fd, blob[_HEAD:], start + _HEAD)
            write_at(self._fd, blob[:_HEAD], start)
            indexes.append(extra.index_record(start))
            if self.settled_end == start:
                self.settled_end = end
            self._chain_end = start = end
        summary_start = start + len(_DATA_END)
        body = b"".join([self.summary.description, self.summary.settled, self.summary.staged])
        tail, offsets_start = self.summary.tail(summary_start, indexes)
        content = body + tail
        footer = rec.footer_record(summary_start, offsets_start, content)
        whole = _DATA_END + content + footer + rec.MAGIC
        self._make_room(start + len(whole))
        write_at(self._fd, whole[_HEAD:], start + _HEAD)
        write_at(self._fd, whole[:_HEAD], start)
        os.ftruncate(self._fd, start + len(whole))

    def sync(self) -> None:
        """Wait until the file has reached the disk."""
        os.fsync(self._fd)

    def abandon(self) -> None:
        """Close without writing; the published content remains."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    @property
    def _tail(self) -> int:
        return self._size - _TAIL_SIZE

    @property
    def _summary_stop(self) -> int:
        return self._size - rec.FOOTER_SIZE - len(rec.MAGIC)

    @property
    def _next_stage(self) -> int:
        return self._cursor if self._chain_end == self.settled_end else self._chain_end

    def _tail_bytes(self, slot: _Slot) -> bytes:
        return _DATA_END + rec.footer_record(slot.start, slot.offsets_start) + rec.MAGIC

    def _place_slots(self, capacity: int) -> list[_Slot]:
        top = self._tail // _PAGE * _PAGE
        return [_Slot(top - 2 * capacity, capacity), _Slot(top - capacity, capacity)]

    def _blob(self, parts: Sequence[bytes], start: int, size: int) -> tuple[bytes, int]:
        end = start + size
        filler = b""
        if end % _PAGE > _PAGE - _HEAD:
            # The next commit writes nine bytes at ``end``, which must not straddle two pages.
            target = (end // _PAGE + 1) * _PAGE + _HEAD
            filler = rec.padding_head(end, target) + bytes(target - end - _HEAD)
            end = target
        return b"".join([*parts, filler, rec.padding_head(end, self._tail)]), end

    def _begin_group(self) -> None:
        """Choose the place of the next staged chunks, with space for the chunk that replaces them."""
        # Messages of 31 bytes and more have index entries of 16 and, one in each chunk, 15 bytes more.
        if self.settled_end + 2 * self.group_limit + self.group_limit // 64 + 2 * _PAGE > self._area.start:
            self._grow(0)
        if self._cursor + (self._area.stop - self._area.start) // 2 > self._area.stop:
            self._cursor = self._area.start

    def _make_room(self, end: int) -> None:
        if self._chain_end == self.settled_end:
            if end > self._area.start:
                self._grow(end - self._chain_end)
        elif end > self._area.stop:
            raise OSError(28, "No space left on device")  # (only when staged chunks could not be settled)

    def _fill_slot(self, slot: _Slot) -> bool:
        summary = self.summary
        description = summary.description
        body: bytes | bytearray
        if slot.described != len(description):
            # New topics move everything after them.
            start, body = slot.start, description + summary.settled + summary.staged
        elif slot.group != summary.group:
            start = slot.start + slot.described + slot.settled
            body = summary.settled[slot.settled :] + summary.staged
        else:
            start = slot.start + slot.described + slot.settled + slot.staged
            body = summary.staged[slot.staged :]
        tail, offsets_start = summary.tail(slot.start)
        tail += summary.checksum_record(tail)
        end = start + len(body) + len(tail)
        # The data end before the next slot's summary is the last thing in this slot.
        if end + _HEAD > slot.start + slot.capacity - len(_DATA_END):
            return False
        if slot.described < 0:
            write_at(self._fd, _DATA_END, slot.start - len(_DATA_END))
        write_at(self._fd, b"".join([body, tail, rec.padding_head(end, self._summary_stop)]), start)
        slot.described, slot.settled = len(description), len(summary.settled)
        slot.group, slot.staged = summary.group, len(summary.staged)
        slot.offsets_start = offsets_start
        return True

    def _grow(self, needed: int) -> None:
        capacity = max(_FIRST_SLOT, -(-2 * (self.summary.size + 4 * _PAGE) // _PAGE) * _PAGE)
        # Summaries are rewritten each time, so this space is proportional to them.
        room = max(min(max(_FIRST_ROOM, self.settled_end), _LARGEST_ROOM), 4 * self.summary.size)
        staging = min(max(room // 2, self._area.stop - self._area.start), 8 * _LARGEST_GROUP) // _PAGE * _PAGE
        old_size = self._size
        self._size += -(-(needed + room + staging + 2 * capacity) // _PAGE) * _PAGE
        live, keeper = self._slots[self._live], self._slots[1 - self._live]
        try:
            # Copy the current summary, padded up to the new end, into the other slot ...
            content = os.pread(self._fd, live.offsets_start - live.start, live.start)
            checksum = rec.summary_checksum_record(zlib.crc32(content))
            padding = rec.padding_head(keeper.start + len(content) + len(checksum), self._summary_stop)
            keeper.described = -1
            write_at(self._fd, _DATA_END + content + checksum + padding, keeper.start - len(_DATA_END))
            # ... and move the end of the file there in one write (without offsets, which are absolute).
            write_at(self._fd, _DATA_END + rec.footer_record(keeper.start, 0) + rec.MAGIC, self._tail)
        except OSError:
            self._size = old_size
            raise
        keeper.offsets_start = keeper.start + len(content)
        self._live = 1 - self._live
        # Show the new end to sequential readers and move the summaries there.
        write_at(self._fd, rec.padding_head(self._chain_end, self._tail), self._chain_end)
        slots = self._place_slots(capacity)
        if not self._fill_slot(slots[0]):
            raise BagError(f"{self.path}: a summary outgrew the {capacity} bytes that were made for it")
        write_at(self._fd, self._tail_bytes(slots[0]), self._tail)
        self._slots, self._live = slots, 0
        self._next_area = _Area(slots[0].start - staging, slots[0].start - len(_DATA_END))
        if self._chain_end == self.settled_end:
            self._area = self._next_area
            self._cursor = self._area.start
