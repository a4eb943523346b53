"""The summary of a growing MCAP file: topics, counts and the index of chunks."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["Chunk", "McapSummary", "build_chunk"]

Compressor = Callable[[bytes], bytes]


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk with its message indexes as bytes, at an offset that is not yet known."""

    parts: list[bytes]
    size: int
    length: int
    start_ns: int
    stop_ns: int
    index_places: list[tuple[int, int]]
    compression: str
    packed_size: int
    raw_size: int

    def index_record(self, offset: int) -> bytes:
        """Return its index record; ``offset`` is its place in the file [bytes]."""
        return rec.chunk_index_record(
            self.start_ns,
            self.stop_ns,
            offset,
            self.length,
            [(channel, offset + place) for channel, place in self.index_places],
            self.size - self.length,
            self.compression,
            self.packed_size,
            self.raw_size,
        )


def build_chunk(
    raw: bytes,
    indexes: Sequence[tuple[int, bytes]],
    span: tuple[int, int],
    compressor: tuple[str, Compressor] | None = None,
) -> Chunk:
    """Return a chunk of schema, channel and message records.

    ``indexes``: channel id and entries (log time and offset in ``raw``, uint64 each), in file order; ``span``: first
    and last log time [ns]; ``compressor``: its name in the format, and the function.
    """
    name, packed = (compressor[0], compressor[1](raw)) if compressor else ("", raw)
    text = name.encode()
    content_size = 8 + 8 + 8 + 4 + 4 + len(text) + 8 + len(packed)
    head = rec.RECORD_HEAD.pack(rec.CHUNK, content_size)
    head += struct.pack("<QQQII", *span, len(raw), zlib.crc32(raw), len(text))
    parts = [head + text + struct.pack("<Q", len(packed)), packed]
    length = size = rec.RECORD_HEAD_SIZE + content_size
    places = []
    for channel, entries in indexes:
        places.append((channel, size))
        entry_head = rec.RECORD_HEAD.pack(rec.MESSAGE_INDEX, 6 + len(entries))
        parts += [entry_head + struct.pack("<HI", channel, len(entries)), entries]
        size += len(entry_head) + 6 + len(entries)
    return Chunk(parts, size, length, *span, places, name, len(packed), len(raw))


class McapSummary:
    """Topics, counts and the index of chunks as bytes; *settled* chunks replace small *staged* ones."""

    def __init__(self) -> None:
        self.channels: dict[int, bytes] = {}
        self.counts: dict[int, int] = {}
        self.count = 0
        self.start_ns = 0
        self.stop_ns = 0
        self.settled = bytearray()
        self.staged = bytearray()
        self.group = 0
        self._settled_chunks = 0
        self.staged_chunks = 0
        self._schemas: list[bytes] = []
        self.description = b""
        """Records of definitions and topics, with which each summary begins."""
        self._settled_crc = 0
        self._staged_crc = 0

    @property
    def schemas(self) -> int:
        """Number of message definitions; ids count from 1."""
        return len(self._schemas)

    def add_schema(self, record: bytes) -> None:
        """Add a message definition."""
        self._schemas.append(record)
        self._describe()

    def add_channel(self, channel_id: int, record: bytes) -> None:
        """Add a topic."""
        self.channels[channel_id] = record
        self.counts[channel_id] = 0
        self._describe()

    def _describe(self) -> None:
        self.description = b"".join([*self._schemas, *self.channels.values()])
        self._settled_crc = zlib.crc32(self.settled, zlib.crc32(self.description))
        self._staged_crc = zlib.crc32(self.staged, self._settled_crc)

    def add_messages(self, counts: dict[int, int], span: tuple[int, int]) -> None:
        """Count messages: channel id -> number, with their first and last log time [ns]."""
        self.start_ns = span[0] if not self.count else min(self.start_ns, span[0])
        self.stop_ns = max(self.stop_ns, span[1])
        for channel, number in counts.items():
            self.counts[channel] += number
            self.count += number

    def stage(self, record: bytes) -> None:
        """Add a staged chunk's index record."""
        self.staged += record
        self._staged_crc = zlib.crc32(record, self._staged_crc)
        self.staged_chunks += 1

    def settle(self, record: bytes) -> None:
        """Replace the staged chunks by one settled chunk's index record."""
        self.settled += record
        self._settled_crc = self._staged_crc = zlib.crc32(record, self._settled_crc)
        self._settled_chunks += 1
        self.staged.clear()
        self.staged_chunks = 0
        self.group += 1

    @property
    def size(self) -> int:
        """Bytes of all records except those that close the summary."""
        return len(self.description) + len(self.settled) + len(self.staged)

    def checksum_record(self, tail: bytes) -> bytes:
        """Return the checksum record that ends a growing file's summary, over the summary and this tail."""
        return rec.summary_checksum_record(zlib.crc32(tail, self._staged_crc))

    def tail(self, start: int, indexes: Sequence[bytes] = ()) -> tuple[bytes, int]:
        """Return the records that close a summary at offset ``start``, and where its offsets begin [bytes]."""
        kinds = {
            opcode: b"".join(index for index in indexes if index[0] == opcode)
            for opcode in (rec.ATTACHMENT_INDEX, rec.METADATA_INDEX)
        }
        statistics = rec.statistics_record(
            message_count=self.count,
            schema_count=len(self._schemas),
            attachment_count=sum(index[0] == rec.ATTACHMENT_INDEX for index in indexes),
            metadata_count=sum(index[0] == rec.METADATA_INDEX for index in indexes),
            chunk_count=self._settled_chunks + self.staged_chunks,
            start_ns=self.start_ns,
            stop_ns=self.stop_ns,
            channel_counts=self.counts,
        )
        schemas = sum(map(len, self._schemas))
        groups = (
            (rec.SCHEMA, schemas),
            (rec.CHANNEL, len(self.description) - schemas),
            (rec.CHUNK_INDEX, len(self.settled) + len(self.staged)),
            (rec.STATISTICS, len(statistics)),
            *((opcode, len(records)) for opcode, records in kinds.items()),
        )
        offsets = b""
        at = start
        for opcode, length in groups:
            if length:
                offsets += rec.summary_offset_record(opcode, at, length)
                at += length
        return b"".join([statistics, *kinds.values(), offsets]), at
