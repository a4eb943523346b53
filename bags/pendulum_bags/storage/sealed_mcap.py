"""An MCAP file that is complete at every instant, also while it is being written.

MCAP readers find everything from the footer at the end of the file, so a file that grows by appending is broken
whenever its writer dies. Here the file is laid out with room to grow, and the room is a private record that every
reader skips::

    magic  header | chunk, indexes | ... | room to grow | summary A | summary B | data end, footer, magic
                                         ^ data_end     ^ limit

A new chunk is written into the room and the summary that lists it into whichever of the two places the footer does
not point to. Until then no reader can see any of it. Two small writes then make it visible: the chunk's own head
(opcode and length, for readers that go through the file in order) and the footer (for readers that use the index).
When the room is used up, one write far beyond the end moves the end of the file; the bytes between are a hole that
occupies no disk. ``close`` puts summary and footer right behind the data and cuts the rest off.

Each of these commits lies within one page of memory, which the kernel copies as a whole: a process that is killed
between any two instructions leaves the state before or after, never between. (A power failure is another matter,
because the disk may reorder pages: ``sync`` bounds what it can cost.)
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pendulum_bags.storage import mcap_records as rec
from pendulum_bags.storage.message_types import MessageType
from pendulum_msgs_py.errors import BagError

__all__ = ["SealedMcapFile"]

_PAGE = 4096
_TAIL_SIZE = rec.RECORD_HEAD_SIZE + 4 + rec.FOOTER_SIZE + len(rec.MAGIC)
_FIRST_ROOM = 1 << 20
_LARGEST_ROOM = 16 << 20
_FIRST_SLOT = 16 * _PAGE
_HEAD = rec.RECORD_HEAD_SIZE


@dataclass(slots=True)
class _Slot:
    """One of the two places for a summary: from ``start``, ``capacity`` bytes."""

    start: int
    capacity: int
    description_size: int = -1
    indexes: int = 0
    index_end: int = 0
    offsets_start: int = 0


@dataclass(slots=True)
class _Channel:
    record: bytes
    count: int = 0
    sequence: int = 0


class SealedMcapFile:
    """Append messages to a new MCAP file; after each ``seal`` they are in the file for every reader.

    Args:
        path: File to create.
        compression: ``None`` or ``"zstd"`` (by chunk).
        level: Zstd level.

    Raises:
        BagError: The file exists, or cannot be written.
    """

    suffix = ".mcap"

    def __init__(self, path: Path, *, compression: str | None = None, level: int = 1) -> None:
        if path.exists():
            raise BagError(f"{path} exists already; expected a new file")
        self.path = path
        self._compressor = _zstd_compressor(level) if compression == "zstd" else None
        self._compression = compression or ""
        self._schemas: dict[tuple[str, str], int] = {}
        self._schema_records: list[bytes] = []
        self._channels: dict[int, _Channel] = {}
        self._chunks: list[rec.ChunkIndex] = []
        self._index_records: list[bytes] = []
        self._index_size = 0
        self._pending: list[bytes] = []
        self._pending_size = 0
        self._pending_index: dict[int, list[int]] = {}
        self._pending_span = (2**63 - 1, 0)
        self._stale = False
        self.count = 0
        self.start_ns = 0
        self.stop_ns = 0
        self._fd = -1
        self._slots: list[_Slot] = []
        self._live = 0
        self._size = 0
        self._limit = 0
        self._create()

    @property
    def data_size(self) -> int:
        """Bytes of data so far, sealed or not (the file itself may end later)."""
        return self._data_end + self._pending_size

    @property
    def pending_size(self) -> int:
        """Bytes of messages that are not sealed yet."""
        return self._pending_size

    # -- what a bag writer calls -------------------------------------------------------------------------------

    def add_channel(self, channel_id: int, topic: str, type: MessageType, qos: str) -> None:
        """Describe a topic before its first message (ids from 1; QoS profiles as YAML text)."""
        key = (type.name, type.definition)
        schema_id = self._schemas.get(key, 0)
        new = b""
        if not schema_id:
            schema_id = self._schemas[key] = len(self._schemas) + 1
            new = rec.schema_record(schema_id, type.name, type.encoding, type.definition)
            self._schema_records.append(new)
        channel = rec.channel_record(channel_id, schema_id, topic, {"offered_qos_profiles": qos})
        self._channels[channel_id] = _Channel(channel)
        # In the chunk too, so that a reader that goes through the file in order knows the topic.
        self._pending += [new, channel]
        self._pending_size += len(new) + len(channel)
        self._stale = True

    def write(self, channel_id: int, log_time_ns: int, data: bytes) -> None:
        """Add one message to the chunk that is being filled."""
        channel = self._channels[channel_id]
        index = self._pending_index.get(channel_id)
        if index is None:
            index = self._pending_index[channel_id] = []
        index += (log_time_ns, self._pending_size)
        channel.sequence += 1
        size = len(data)
        self._pending += (
            rec.MESSAGE_HEADER.pack(
                rec.MESSAGE, size + 22, channel_id, channel.sequence, log_time_ns, log_time_ns
            ),
            data,
        )
        self._pending_size += size + 31
        start, stop = self._pending_span
        if log_time_ns < start or log_time_ns > stop:
            self._pending_span = (min(start, log_time_ns), max(stop, log_time_ns))

    def seal(self) -> None:
        """Make everything that was written visible to readers of the file.

        Raises:
            OSError: The disk is full or fails. The file still shows what was sealed before.
        """
        if self._pending_index:
            index, blob = self._build_chunk()
            self._place(blob)
            self._stale = True
            self._chunks.append(index)
            entry = index.to_record()
            self._index_records.append(entry)
            self._index_size += len(entry)
            first, last = self._pending_span
            self.start_ns = first if not self.count else min(self.start_ns, first)
            self.stop_ns = max(self.stop_ns, last)
            for channel_id, entries in self._pending_index.items():
                self._channels[channel_id].count += len(entries) // 2
                self.count += len(entries) // 2
            self._pending.clear()
            self._pending_size = 0
            self._pending_index.clear()
            self._pending_span = (2**63 - 1, 0)
        if self._stale:
            self._publish_summary()
            self._stale = False

    def sync(self) -> None:
        """Wait until what was sealed has reached the disk."""
        os.fdatasync(self._fd)

    def close(self, metadata: str = "") -> None:
        """Seal, put summary and footer behind the data, cut off the unused room and close.

        Args:
            metadata: Text of ``metadata.yaml``, stored as rosbag2 does for files without their folder.
        """
        if self._fd < 0:
            return
        try:
            try:
                self.seal()
            finally:
                # Also after a failed seal: on a full disk the unused room is worth giving back.
                self._compact(metadata)
            os.fsync(self._fd)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close without writing anything more: the file shows what was sealed."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    # -- layout ------------------------------------------------------------------------------------------------

    def _create(self) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            library = f"pendulum_bags {version('pendulum_bags')}"
        except PackageNotFoundError:
            library = "pendulum_bags"
        head = rec.MAGIC + rec.header_record(library)
        temporary = self.path.with_name(f".{self.path.name}.tmp")
        try:
            self._fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
            self._data_end = len(head)
            self._size = _FIRST_ROOM
            self._slots = self._place_slots(_FIRST_SLOT)
            self._limit = self._slots[0].start
            self._write(head + rec.padding_head(len(head), self._tail), 0)
            slot = self._slots[0]
            self._fill_slot(slot)
            self._write(self._tail_bytes(slot), self._tail)
            os.rename(temporary, self.path)
        except OSError:
            self.abandon()
            temporary.unlink(missing_ok=True)
            raise

    @property
    def _tail(self) -> int:
        return self._size - _TAIL_SIZE

    def _tail_bytes(self, slot: _Slot) -> bytes:
        data_end = rec.record(rec.DATA_END, bytes(4))
        return data_end + rec.footer_record(slot.start, slot.offsets_start) + rec.MAGIC

    def _place_slots(self, capacity: int) -> list[_Slot]:
        top = self._tail // _PAGE * _PAGE
        return [_Slot(top - 2 * capacity, capacity), _Slot(top - capacity, capacity)]

    @property
    def _summary_stop(self) -> int:
        """Where the padding behind a summary ends and the footer begins."""
        return self._size - rec.FOOTER_SIZE - len(rec.MAGIC)

    def _write(self, data: bytes | Sequence[bytes], offset: int) -> None:
        view = memoryview(data if isinstance(data, bytes) else b"".join(data))
        while view:
            done = os.pwrite(self._fd, view, offset)
            view = view[done:]
            offset += done

    def _place(self, blob: list[bytes]) -> None:
        """Write records at ``data_end`` and commit them for readers that go through the file in order."""
        size = sum(map(len, blob))
        start = self._data_end
        end = start + size
        filler: list[bytes] = []
        if end % _PAGE > _PAGE - _HEAD:
            # The next commit writes nine bytes at ``end``: they must not straddle two pages.
            target = (end // _PAGE + 1) * _PAGE + _HEAD
            filler = [rec.padding_head(end, target), bytes(target - end - _HEAD)]
            end = target
        if end + _HEAD > self._limit:
            self._grow(end + _HEAD - start)
        whole = b"".join([*blob, *filler, rec.padding_head(end, self._tail)])
        self._write(whole[_HEAD:], start + _HEAD)
        self._write(whole[:_HEAD], start)
        self._data_end = end

    def _summary_head(self) -> list[bytes]:
        return [*self._schema_records, *(channel.record for channel in self._channels.values())]

    def _summary_tail(
        self, start: int, position: int, metadata_indexes: Sequence[bytes] = ()
    ) -> tuple[bytes, int]:
        """Return statistics and offsets for a summary that began at ``start``; and where the offsets begin."""
        statistics = rec.statistics_record(
            message_count=self.count,
            schema_count=len(self._schema_records),
            metadata_count=len(metadata_indexes),
            chunk_count=len(self._chunks),
            start_ns=self.start_ns,
            stop_ns=self.stop_ns,
            channel_counts={key: channel.count for key, channel in self._channels.items()},
        )
        extra = b"".join(metadata_indexes)
        schemas = sum(map(len, self._schema_records))
        channels = sum(len(channel.record) for channel in self._channels.values())
        groups = (
            (rec.SCHEMA, schemas),
            (rec.CHANNEL, channels),
            (rec.CHUNK_INDEX, position - start - schemas - channels),
            (rec.STATISTICS, len(statistics)),
            (rec.METADATA_INDEX, len(extra)),
        )
        offsets = b""
        at = start
        for opcode, length in groups:
            if length:
                offsets += rec.summary_offset_record(opcode, at, length)
                at += length
        return statistics + extra + offsets, at

    def _fill_slot(self, slot: _Slot) -> bool:
        """Bring a slot up to date; False when it is too small."""
        head = self._summary_head()
        size = sum(map(len, head))
        if slot.description_size != size:
            # New topics: everything behind them moves.
            body = head + self._index_records
            start = slot.start
        else:
            body = self._index_records[slot.indexes :]
            start = slot.index_end
        index_end = start + sum(map(len, body))
        tail, offsets_start = self._summary_tail(slot.start, index_end)
        end = index_end + len(tail)
        if end + _HEAD > slot.start + slot.capacity:
            return False
        self._write([*body, tail, rec.padding_head(end, self._summary_stop)], start)
        slot.description_size = size
        slot.indexes = len(self._index_records)
        slot.index_end = index_end
        slot.offsets_start = offsets_start
        return True

    def _publish_summary(self) -> None:
        slot = self._slots[1 - self._live]
        if not self._fill_slot(slot):
            self._grow(0)
            return
        self._live = 1 - self._live
        self._write(self._tail_bytes(slot), self._tail)

    def _grow(self, needed: int) -> None:
        """Move the end of the file away, so that ``needed`` bytes of data and larger summaries fit."""
        summary = sum(map(len, self._summary_head())) + self._index_size + 4 * _PAGE
        capacity = max(_FIRST_SLOT, -(-2 * summary // _PAGE) * _PAGE)
        room = min(max(_FIRST_ROOM, self._data_end), _LARGEST_ROOM)
        old_size = self._size
        self._size += -(-(needed + room + 2 * capacity) // _PAGE) * _PAGE
        live, keeper = self._slots[self._live], self._slots[1 - self._live]
        try:
            # The summary in force, continued by padding up to the new end, in the place that is not in force ...
            content = os.pread(self._fd, live.offsets_start - live.start, live.start)
            padding = rec.padding_head(keeper.start + len(content), self._summary_stop)
            self._write(content + padding, keeper.start)
            # ... then the end of the file moves there in one write (offsets name absolute places: the copy has none).
            tail = rec.record(rec.DATA_END, bytes(4)) + rec.footer_record(keeper.start, 0) + rec.MAGIC
            self._write(tail, self._tail)
        except OSError:
            self._size = old_size
            raise
        keeper.description_size = live.description_size
        keeper.indexes = live.indexes
        keeper.index_end = keeper.start + live.index_end - live.start
        keeper.offsets_start = keeper.start + len(content)
        self._live = 1 - self._live
        # Readers in order learn of the new end, and the summaries move to it.
        self._write(rec.padding_head(self._data_end, self._tail), self._data_end)
        slots = self._place_slots(capacity)
        if not self._fill_slot(slots[0]):
            raise BagError(f"{self.path}: a summary outgrew the {capacity} bytes that were made for it")
        self._write(self._tail_bytes(slots[0]), self._tail)
        self._slots, self._live, self._limit = slots, 0, slots[0].start

    def _compact(self, metadata: str) -> None:
        indexes: list[bytes] = []
        if metadata:
            entry = rec.metadata_record("rosbag2", {"serialized_metadata": metadata})
            indexes.append(rec.metadata_index_record(self._data_end, len(entry), "rosbag2"))
            self._place([entry])
        start = self._data_end
        data_end = rec.record(rec.DATA_END, bytes(4))
        summary_start = start + len(data_end)
        body = b"".join([*self._summary_head(), *self._index_records])
        tail, offsets_start = self._summary_tail(summary_start, summary_start + len(body), indexes)
        summary = body + tail
        whole = data_end + summary + rec.footer_record(summary_start, offsets_start, summary) + rec.MAGIC
        if start + len(whole) > self._limit:
            self._grow(len(whole))
        self._write(whole[_HEAD:], start + _HEAD)
        self._write(whole[:_HEAD], start)
        os.ftruncate(self._fd, start + len(whole))

    def _build_chunk(self) -> tuple[rec.ChunkIndex, list[bytes]]:
        offset = self._data_end
        raw = b"".join(self._pending)
        packed = self._compressor(raw) if self._compressor else raw
        compression = self._compression.encode()
        start, stop = self._pending_span
        content_size = 8 + 8 + 8 + 4 + 4 + len(compression) + 8 + len(packed)
        head = rec.RECORD_HEAD.pack(rec.CHUNK, content_size) + struct.pack(
            "<QQQII", start, stop, len(raw), zlib.crc32(raw), len(compression)
        )
        blob = [head, compression, struct.pack("<Q", len(packed)), packed]
        length = _HEAD + content_size
        offsets: dict[int, int] = {}
        at = offset + length
        for channel_id, entries in self._pending_index.items():
            offsets[channel_id] = at
            body = struct.pack(f"<HI{len(entries)}Q", channel_id, 8 * len(entries), *entries)
            blob += [rec.RECORD_HEAD.pack(rec.MESSAGE_INDEX, len(body)), body]
            at += _HEAD + len(body)
        index = rec.ChunkIndex(
            start,
            stop,
            offset,
            length,
            offsets,
            at - offset - length,
            self._compression,
            len(packed),
            len(raw),
        )
        return index, blob


def _zstd_compressor(level: int) -> Any:
    import zstandard

    return zstandard.ZstdCompressor(level=level).compress
