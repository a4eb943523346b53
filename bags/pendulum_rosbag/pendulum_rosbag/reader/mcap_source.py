"""Reading MCAP files by their message indexes, or sequentially if the file is damaged."""

from __future__ import annotations

import contextlib
import mmap
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import MCAP_HEAD, Batch, Bytes, Int64, within
from pendulum_rosbag.reader.checksums import Checksums, Comparison
from pendulum_rosbag.reader.mcap_chunks import CHUNK_FIELDS, Chunk, DamagedError, keep_staged, raw_content, read_text
from pendulum_rosbag.reader.mcap_index import indexed_counts, indexed_messages
from pendulum_rosbag.reader.mcap_scan import McapScan, MessageTable, find_extras
from pendulum_rosbag.reader.mcap_topics import McapTopics
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata

__all__ = ["McapSource"]

_HEAD = rec.RECORD_HEAD_SIZE
_FOOTER_REGION = rec.FOOTER_SIZE + len(rec.MAGIC)
_NOT_CLOSED = rec.record(rec.DATA_END, bytes(4))
"""What precedes the footer in a file that our recorder has not closed."""
_TRIES = 5
_GROUP_SIZE = 1 << 20  # decompressed bytes that are parsed at once


_UNREADABLE = (DamagedError, struct.error, ValueError, KeyError, OverflowError, IndexError)


class _NoIndexError(Exception):
    """The file has no index, as the format allows, and must be scanned."""


class McapSource:
    """One MCAP file, read through a memory map.

    A file with a footer is read by its index. One without (its writer died), or with a wrong index, is scanned;
    ``damage`` then says what was found. ``unclosed`` marks a complete file that our recorder has not closed.

    Args:
        data: Its content, if it is not a plain file (a decompressed copy).
        verify: Checksums: ``None`` compares those of chunks that are read (of all if the file was not closed), ``True``
            all at once, leaving damaged chunks out, ``False`` none.

    Raises:
        BagError: The file cannot be opened or is no MCAP file.
    """

    def __init__(self, path: Path, data: bytes | None = None, *, verify: bool | None = None) -> None:
        self.path = path
        self._verify = verify
        self._checksums = Checksums(path, enabled=verify is not False)
        self.damage = ""
        self.unclosed = False
        self._map: mmap.mmap | None = None
        self.buffer: Bytes = self._open(data)
        if bytes(self.buffer[:8]) != rec.MAGIC:
            self.close()
            raise BagError(f"{path} does not begin as an MCAP file; expected the bytes {rec.MAGIC!r}")
        self._topics = McapTopics()
        self.metadata = self._topics.metadata
        self.chunks: list[Chunk] = []
        # Only after a scan: (time, offset) of messages outside of chunks, and inside each chunk, by channel.
        self._loose: MessageTable = {}
        self._scanned: list[MessageTable] = []
        self._counts: dict[int, int] = {}
        self.start_ns = 0
        self.stop_ns = 0
        try:
            self._read_summary()
        except _NoIndexError:
            self._scan("")
        except _UNREADABLE as error:
            self._scan(str(error) or type(error).__name__)
        if (verify or (self.unclosed and verify is None)) and not self._scanned:
            try:
                self._leave_out_damaged()
            except (DamagedError, BagError) as error:
                self._scan(str(error).removeprefix(f"{path}: "))  # the report of the damage names the file
        self.compressed = any(chunk.compression for chunk in self.chunks)
        self.streams = [
            self._topics.stream(channel, self._counts.get(channel, 0)) for channel in sorted(self._topics.channels)
        ]
        self.unchecked = self._without_checksums()

    def _without_checksums(self) -> str:
        bare = sum(not chunk.crc for chunk in self.chunks)
        if self._loose:
            return "messages outside of chunks have no checksum"
        return f"{bare} of {len(self.chunks)} chunks have no checksum" if bare else ""

    def extras(self) -> list[Attachment | Metadata]:
        """Return attachments and metadata that other programs put into the file."""
        return list(find_extras(self.buffer))

    def close(self) -> None:
        """Release the memory map once no array refers to it, and end running reads."""
        self._checksums.close()
        self.buffer = np.empty(0, np.uint8)
        if self._map is not None:
            with contextlib.suppress(BufferError):  # an array still refers to it and releases it later
                self._map.close()
            self._map = None

    def _open(self, data: bytes | None) -> Bytes:
        if data is not None:
            return np.frombuffer(data, np.uint8)
        try:
            with self.path.open("rb") as file:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:
            raise BagError(f"{self.path} is empty; expected an MCAP file") from None
        except OSError as error:
            raise BagError(f"{self.path} cannot be read: {error.strerror or error}") from error
        return np.frombuffer(self._map, np.uint8)

    def _read_summary(self) -> None:
        """Read the summary; repeat if a running recorder has published another one meanwhile."""
        for again in reversed(range(_TRIES)):
            shown = bytes(self.buffer[-_FOOTER_REGION:])
            try:
                self._take_summary()
                return
            except _UNREADABLE:
                if not again or bytes(self.buffer[-_FOOTER_REGION:]) == shown:
                    raise
            self.unclosed = False
            for known in (self._topics, self.chunks, self._counts):
                known.clear()

    def _take_summary(self) -> None:
        buffer, size = self.buffer, len(self.buffer)
        footer = size - _FOOTER_REGION
        if footer < 8 or bytes(buffer[-8:]) != rec.MAGIC:
            raise DamagedError("the file has no footer")
        opcode, length = rec.RECORD_HEAD.unpack(bytes(buffer[footer : footer + _HEAD]))
        if opcode != rec.FOOTER or length != 20:
            raise DamagedError("the footer is not whole")
        (at,) = struct.unpack("<Q", bytes(buffer[footer + _HEAD : footer + _HEAD + 8]))
        if at == 0:
            raise _NoIndexError
        if not 8 <= at <= footer:
            raise DamagedError(f"the footer points to byte {at} of {size}")
        (crc,) = struct.unpack("<I", bytes(buffer[footer + _HEAD + 16 : footer + _HEAD + 20]))
        if crc and self._verify is not False and zlib.crc32(buffer[at : footer + _HEAD + 16].data) != crc:
            raise DamagedError(f"the summary at byte {at} does not have its checksum")
        start = at
        grows = not crc and bytes(buffer[footer - len(_NOT_CLOSED) : footer]) == _NOT_CLOSED
        statistics = False
        while at < footer:
            opcode, length = rec.RECORD_HEAD.unpack(bytes(buffer[at : at + _HEAD]))
            at += _HEAD
            if at + length > footer:
                raise DamagedError(f"a summary record of {length} bytes does not fit the file")
            if opcode == rec.PADDING:
                self.unclosed = True  # complete, but its writer did not release the room to grow
                break
            if opcode == rec.SUMMARY_CHECKSUM and grows and self._verify is not False:
                content = bytes(buffer[at : at + length])
                if content != struct.pack("<I", zlib.crc32(buffer[start : at - _HEAD].data)):
                    raise DamagedError(f"the summary at byte {start} does not have its checksum")
            if opcode in (rec.SUMMARY_OFFSET, rec.SUMMARY_CHECKSUM):
                at += length
                continue
            statistics |= self._take_summary_record(opcode, bytes(buffer[at : at + length]))
            at += length
        if grows and not self.unclosed:
            raise DamagedError(f"the summary at byte {start} is not whole")
        if not statistics and not self.chunks:
            raise _NoIndexError
        if not self._describes_all():
            raise _NoIndexError  # the format allows topic descriptions next to their messages only
        if self.chunks:
            if not self._counts or any(not chunk.indexes for chunk in self.chunks):
                raise _NoIndexError
            if len({chunk.data_start for chunk in self.chunks}) != len(self.chunks):
                raise DamagedError("the index names a chunk twice")
            self.start_ns = min(chunk.start_ns for chunk in self.chunks)
            self.stop_ns = max(chunk.stop_ns for chunk in self.chunks)
            if self.unclosed:
                keep_staged(self.buffer, self.chunks)
            self._compare_counts()
        elif sum(self._counts.values()):
            raise _NoIndexError  # messages outside of chunks

    def _describes_all(self) -> bool:
        named = {channel for channel, count in self._counts.items() if count}
        named.update(*(chunk.indexes for chunk in self.chunks))
        return self._topics.describe_all(named)

    def _compare_counts(self) -> None:
        """Compare the message indexes, which have no checksum, with the counts; a DamagedError if they differ."""
        named = indexed_counts(self.chunks)
        for channel in sorted(named.keys() | self._counts.keys()):
            found, count = named.get(channel, 0), self._counts.get(channel, 0)
            if found != count:
                topic = self._topics.channels[channel][1]
                raise DamagedError(f"the message indexes name {found} messages on {topic}; the summary says {count}")

    def _take_summary_record(self, opcode: int, content: bytes) -> bool:
        if opcode == rec.CHUNK_INDEX:
            self.chunks.append(self._chunk_from_index(content))
        elif opcode == rec.STATISTICS:
            (size,) = struct.unpack_from("<I", content, 42)
            for channel, count in struct.iter_unpack("<HQ", content[46 : 46 + size]):
                self._counts[channel] = count
            return True
        elif opcode == rec.METADATA_INDEX:
            start, length = struct.unpack_from("<QQ", content)
            if start + length <= len(self.buffer):
                self._topics.take(rec.METADATA, bytes(self.buffer[start + _HEAD : start + length]))
        else:
            self._topics.take(opcode, content)
        return False

    def _chunk_from_index(self, content: bytes) -> Chunk:
        start, stop, offset, _, size = struct.unpack_from("<QQQQI", content)
        indexes = dict(struct.iter_unpack("<HQ", content[36 : 36 + size]))
        at = 36 + size + 8
        compression, at = read_text(content, at)
        packed, raw = struct.unpack_from("<QQ", content, at)
        data_start = offset + _HEAD + CHUNK_FIELDS.size + len(compression) + 8
        if data_start + packed > len(self.buffer) or any(at >= len(self.buffer) for at in indexes.values()):
            raise DamagedError("the index names a chunk beyond the end of the file")
        if self.buffer[offset] != rec.CHUNK:
            raise DamagedError("the index names a chunk where there is none")
        (crc,) = struct.unpack("<I", bytes(self.buffer[offset + _HEAD + 24 : offset + _HEAD + 28]))
        return Chunk(self.buffer, start, stop, data_start, packed, raw, compression, indexes, crc, offset)

    def _scan(self, damage: str) -> None:
        found = McapScan(self.buffer, self.path, self._topics, self._checksums.sound, damage)
        self.damage = found.damage
        self.chunks, self._scanned, self._loose = found.chunks, found.scanned, found.loose
        self._counts, self.start_ns, self.stop_ns = found.counts, found.start_ns, found.stop_ns

    def _leave_out_damaged(self) -> None:
        """Compare checksums and indexes of all chunks, drop damaged chunks, raise if an index is damaged."""
        kept: list[Chunk] = []
        lost: dict[int, int] = {}
        for number, chunk in enumerate(self.chunks):
            entries = {channel: self._entries(channel, chunk.buffer, [(number, 0)]) for channel in chunk.indexes}
            try:
                raw = raw_content(chunk, self.path)
                whole = not chunk.crc or zlib.crc32(raw.data) == chunk.crc
            except BagError:
                whole = False
            if not whole:
                self.damage = self.damage or f"the chunk at byte {chunk.offset} does not have its checksum"
                for channel, (times, _) in entries.items():
                    lost[channel] = lost.get(channel, 0) + len(times)
                continue
            for channel, (times, offsets) in entries.items():
                origin = partial(self._origin, channel, chunk.buffer, [(number, 0)])
                for batch in self._cut(Batch(channel, raw, offsets, times, origin=origin), None, None):
                    batch.check_heads()
            kept.append(chunk)
        bad = len(self.chunks) - len(kept)
        if bad:
            others = f", nor do {bad - 1} others" if bad > 1 else ""
            self.damage += f"{others}; {sum(lost.values())} messages are left out"
            self._counts = {channel: max(count - lost.get(channel, 0), 0) for channel, count in self._counts.items()}
            self.chunks = kept
            self.start_ns = min((chunk.start_ns for chunk in kept), default=0)
            self.stop_ns = max((chunk.stop_ns for chunk in kept), default=0)

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield all messages of some channels with start <= log time < stop, in file order."""
        for channel, entries in self._loose.items():
            if channel in channels:
                table = np.array(entries, np.int64)
                yield from self._cut(Batch(channel, self.buffer, table[:, 1], table[:, 0]), start, stop)
        with self._checksums.begin() as checksums:
            for buffer, index, members in self._groups(channels, start, stop, checksums):
                for channel in channels:
                    times, offsets = self._entries(channel, index, members)
                    origin = partial(self._origin, channel, index, members)
                    yield from self._cut(Batch(channel, buffer, offsets, times, origin=origin), start, stop)
            checksums.finish()

    def _groups(
        self, channels: set[int], start: int | None, stop: int | None, checksums: Comparison
    ) -> Iterator[tuple[Bytes, Bytes, list[tuple[int, int]]]]:
        """Yield buffers of many chunks, and their index, with (chunk number, offset of the chunk)."""
        plain: dict[int, list[tuple[int, int]]] = {}
        packed: list[tuple[int, int]] = []
        parts: list[Bytes] = []
        size = 0
        index = self.buffer
        for number, chunk in enumerate(self.chunks):
            if (start is not None and chunk.stop_ns < start) or (stop is not None and chunk.start_ns >= stop):
                continue
            if channels.isdisjoint(self._scanned[number] if self._scanned else chunk.indexes):
                continue
            if not chunk.compression:
                checksums.compare(chunk, raw_content(chunk, self.path))
                plain.setdefault(id(chunk.buffer), []).append((number, chunk.data_start))  # all in the same map
                continue
            if packed and (size >= _GROUP_SIZE or index is not chunk.buffer):
                yield np.concatenate(parts), index, packed
                packed, parts, size = [], [], 0
            index = chunk.buffer
            parts.append(raw_content(chunk, self.path))
            checksums.compare(chunk, parts[-1])
            packed.append((number, size))
            size += chunk.raw_size
        if packed:
            yield np.concatenate(parts), index, packed
        for members in plain.values():
            buffer = self.chunks[members[0][0]].buffer
            yield buffer, buffer, members

    def _entries(self, channel: int, index: Bytes, members: list[tuple[int, int]]) -> tuple[Int64, Int64]:
        """Return log times [ns] and record offsets of a channel's messages in a group of chunks."""
        if self._scanned:
            rows = [
                (time, base + offset)
                for number, base in members
                for time, offset in self._scanned[number].get(channel, ())
            ]
            table = np.array(rows, np.int64).reshape(-1, 2)
            return table[:, 0], table[:, 1]
        places = [
            (place, base) for number, base in members if (place := self.chunks[number].indexes.get(channel)) is not None
        ]
        return indexed_messages(self.path, channel, index, places)

    def _origin(self, channel: int, index: Bytes, members: Sequence[tuple[int, int]], time_ns: int, offset: int) -> str:
        """Return which message index lists a message of a group, by its log time [ns] and offset."""
        place = ""
        for number, base in members:
            times, offsets = self._entries(channel, index, [(number, base)])
            if bool(((times == time_ns) & (offsets == offset)).any()):
                place = f" of the chunk at byte {self.chunks[number].offset}"
                break
        return f"{self.path}: the message index{place}, topic {self._topics.channels[channel][1]},"

    def _cut(self, batch: Batch, start: int | None, stop: int | None) -> Iterator[Batch]:
        """Limit a batch to a time span and check that its records are inside the buffer."""
        if start is not None or stop is not None:
            keep = within(batch.times, start, stop)
            batch = replace(batch, offsets=batch.offsets[keep], times=batch.times[keep])
        if not len(batch.times):
            return
        if int(batch.offsets.min()) < 0 or int(batch.offsets.max()) + MCAP_HEAD > len(batch.buffer):
            raise BagError(f"{self.path}: a message index points outside of its chunk; try to repair the bag")
        yield batch
