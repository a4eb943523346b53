"""MCAP records as bytes (https://mcap.dev/spec): opcode (one byte), length (uint64), content, little-endian."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = [
    "ATTACHMENT",
    "ATTACHMENT_INDEX",
    "CHANNEL",
    "CHUNK",
    "CHUNK_INDEX",
    "DATA_END",
    "FOOTER",
    "FOOTER_SIZE",
    "HEADER",
    "MAGIC",
    "MESSAGE",
    "MESSAGE_HEADER",
    "MESSAGE_INDEX",
    "METADATA",
    "METADATA_INDEX",
    "PADDING",
    "RECORD_HEAD",
    "RECORD_HEAD_SIZE",
    "SCHEMA",
    "STATISTICS",
    "SUMMARY_CHECKSUM",
    "SUMMARY_OFFSET",
    "Attachment",
    "Metadata",
    "channel_record",
    "chunk_index_record",
    "footer_record",
    "header_record",
    "padding_head",
    "record",
    "schema_record",
    "statistics_record",
    "summary_checksum_record",
    "summary_offset_record",
]

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x09, 0x10)
PADDING = 0x80
"""Private opcode (0x80 to 0xFF are free for applications): readers skip the record."""
SUMMARY_CHECKSUM = 0x81
"""Private opcode: checksum of the records before it, back to the beginning of a summary."""

RECORD_HEAD = struct.Struct("<BQ")
RECORD_HEAD_SIZE = RECORD_HEAD.size
MESSAGE_HEADER = struct.Struct("<BQHIQQ")
"""opcode, length, channel id, sequence, log time, publish time; the message bytes follow."""
_FOOTER = struct.Struct("<QQI")
FOOTER_SIZE = RECORD_HEAD_SIZE + _FOOTER.size
_STATISTICS = struct.Struct("<QHIIIIQQI")


def record(opcode: int, content: bytes) -> bytes:
    """Return a complete record."""
    return RECORD_HEAD.pack(opcode, len(content)) + content


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def _text_map(items: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in items.items())
    return struct.pack("<I", len(body)) + body


def header_record(library: str) -> bytes:
    """Return the header of a ROS 2 file."""
    return record(HEADER, _text("ros2") + _text(library))


def schema_record(schema_id: int, name: str, encoding: str, definition: str) -> bytes:
    """Return a message definition under an id of 1 or more."""
    data = definition.encode(errors="surrogateescape")
    head = struct.pack("<H", schema_id) + _text(name) + _text(encoding) + struct.pack("<I", len(data))
    return record(SCHEMA, head + data)


def channel_record(
    channel_id: int, schema_id: int, topic: str, message_encoding: str, metadata: Mapping[str, str]
) -> bytes:
    """Return a channel record: one topic and the encoding of its messages, such as ``cdr``."""
    head = struct.pack("<HH", channel_id, schema_id)
    return record(CHANNEL, head + _text(topic) + _text(message_encoding) + _text_map(metadata))


@dataclass(frozen=True)
class Attachment:
    """An attachment: ``content`` is that of its record, with log time, names, data and checksum as laid out there."""

    content: bytes
    name: str
    media_type: str
    data_size: int

    def record(self) -> bytes:
        """Return the complete record."""
        return record(ATTACHMENT, self.content)

    def index_record(self, offset: int) -> bytes:
        """Return its index record; ``offset`` is its place in the file [bytes]."""
        head = struct.pack("<QQ", offset, RECORD_HEAD_SIZE + len(self.content)) + self.content[:16]
        size = struct.pack("<Q", self.data_size)
        return record(ATTACHMENT_INDEX, head + size + _text(self.name) + _text(self.media_type))


@dataclass(frozen=True)
class Metadata:
    """A named map of strings."""

    name: str
    items: Mapping[str, str]

    def record(self) -> bytes:
        """Return the complete record."""
        return record(METADATA, _text(self.name) + _text_map(self.items))

    def index_record(self, offset: int) -> bytes:
        """Return its index record; ``offset`` is its place in the file [bytes]."""
        return record(METADATA_INDEX, struct.pack("<QQ", offset, len(self.record())) + _text(self.name))


def statistics_record(
    *,
    message_count: int,
    schema_count: int,
    attachment_count: int,
    metadata_count: int,
    chunk_count: int,
    start_ns: int,
    stop_ns: int,
    channel_counts: Mapping[int, int],
) -> bytes:
    """Return counts and time span of the file."""
    channels = len(channel_counts)
    counts = (message_count, schema_count, channels, attachment_count, metadata_count, chunk_count)
    head = _STATISTICS.pack(*counts, start_ns, stop_ns, 10 * channels)
    return record(STATISTICS, head + b"".join(struct.pack("<HQ", *item) for item in channel_counts.items()))


def summary_offset_record(opcode: int, start: int, length: int) -> bytes:
    """Return where the summary's records of one kind begin, and their length [bytes]."""
    return record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, length))


def summary_checksum_record(crc: int) -> bytes:
    """Return a growing file's summary checksum; that of a footer would cover bytes still to be written."""
    return record(SUMMARY_CHECKSUM, struct.pack("<I", crc))


def footer_record(summary_start: int, summary_offset_start: int, summary: bytes | None = None) -> bytes:
    """Return the footer, with a checksum if the summary's bytes are given."""
    if summary is None:
        return record(FOOTER, _FOOTER.pack(summary_start, summary_offset_start, 0))
    head = RECORD_HEAD.pack(FOOTER, _FOOTER.size) + struct.pack("<QQ", summary_start, summary_offset_start)
    return head + struct.pack("<I", zlib.crc32(head, zlib.crc32(summary)))


def padding_head(start: int, stop: int) -> bytes:
    """Return the head of a private record that spans the bytes from ``start`` to ``stop``."""
    return RECORD_HEAD.pack(PADDING, stop - start - RECORD_HEAD_SIZE)


def chunk_index_record(
    start_ns: int,
    stop_ns: int,
    offset: int,
    length: int,
    message_indexes: Sequence[tuple[int, int]],
    message_index_length: int,
    compression: str,
    packed_size: int,
    raw_size: int,
) -> bytes:
    """Return the index of a chunk; ``message_indexes`` are channels and offsets of their message indexes, in order."""
    offsets = b"".join(struct.pack("<HQ", *item) for item in message_indexes)
    return record(
        CHUNK_INDEX,
        struct.pack("<QQQQI", start_ns, stop_ns, offset, length, len(offsets))
        + offsets
        + struct.pack("<Q", message_index_length)
        + _text(compression)
        + struct.pack("<QQ", packed_size, raw_size),
    )
