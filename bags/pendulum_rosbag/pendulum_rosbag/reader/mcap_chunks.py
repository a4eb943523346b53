"""Chunks of an MCAP file as a reader sees them, and the texts in its records."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pendulum_rosbag.reader.batches import Bytes
from pendulum_rosbag.reader.decompression import decompress
from pendulum_rosbag.storage import mcap_records as rec

__all__ = [
    "CHUNK_FIELDS",
    "Chunk",
    "DamagedError",
    "keep_staged",
    "raw_content",
    "read_metadata",
    "read_text",
    "read_text_map",
    "records_in",
]

_HEAD = rec.RECORD_HEAD_SIZE
_LARGEST_FILLER = 8192
_MOST_STAGED = 64 << 20
CHUNK_FIELDS = struct.Struct("<QQQII")
"""Head of a chunk: first and last log time [ns], content size and checksum, length of the compression's name."""


class DamagedError(Exception):
    """The file is not what its footer, index or records claim."""


@dataclass(slots=True)
class Chunk:
    """One chunk: where its records and its message indexes (channel -> offset) are in a buffer."""

    buffer: Bytes
    start_ns: int
    stop_ns: int
    data_start: int
    data_size: int
    raw_size: int
    compression: str
    indexes: dict[int, int] = field(default_factory=dict)
    crc: int = 0
    """Checksum of the uncompressed content; 0 if its writer made none."""
    offset: int = 0
    """Offset of the chunk's record in the file."""


def raw_content(chunk: Chunk, path: Path) -> Bytes:
    """Return the records of a chunk, decompressed; a BagError with the file's name if they cannot be."""
    packed = chunk.buffer[chunk.data_start : chunk.data_start + chunk.data_size]
    if not chunk.compression:
        return packed
    return np.frombuffer(decompress(packed, chunk.compression, chunk.raw_size, str(path)), np.uint8)


def keep_staged(buffer: Bytes, chunks: Sequence[Chunk]) -> None:
    """Copy the staged chunks of a file that our recorder has not closed.

    A running recorder overwrites them some megabytes later, or cuts them off when it ends.
    """
    in_order = sorted(chunks, key=lambda chunk: chunk.data_start)
    end = 0
    for position, chunk in enumerate(in_order):
        if chunk.data_start - end > _LARGEST_FILLER:
            staged = in_order[position:]
            break
        end = max(_index_end(buffer, chunk), chunk.data_start + chunk.data_size)
    else:
        return
    start = staged[0].data_start
    stop = max(_index_end(buffer, chunk) for chunk in staged)
    if stop - start > _MOST_STAGED:
        return  # not written by our recorder
    copy = np.array(buffer[start:stop])
    for chunk in staged:
        chunk.buffer = copy
        chunk.data_start -= start
        chunk.indexes = {channel: at - start for channel, at in chunk.indexes.items()}


def _index_end(buffer: Bytes, chunk: Chunk) -> int:
    at = max(chunk.indexes.values())
    return at + _HEAD + int(rec.RECORD_HEAD.unpack(bytes(buffer[at : at + _HEAD]))[1])


def records_in(raw: Bytes) -> tuple[list[tuple[int, int, int]], int]:
    """Return the whole records of a chunk's content as (opcode, offset, length), and where the last one ends."""
    found = []
    at, size = 0, len(raw)
    view = raw.data
    while at + _HEAD <= size:
        opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
        if at + _HEAD + length > size or (opcode == rec.MESSAGE and length < 22):
            break
        found.append((opcode, at, length))
        at += _HEAD + length
    return found, at


def read_text(content: bytes, at: int, errors: str = "strict") -> tuple[str, int]:
    """Return the text at an offset of a record, and where it ends."""
    (size,) = struct.unpack_from("<I", content, at)
    end = at + 4 + size
    if end > len(content):
        raise struct.error("text beyond the end of its record")
    return content[at + 4 : end].decode(errors=errors), end


def read_text_map(content: bytes, at: int) -> dict[str, str]:
    """Return the map of texts at an offset of a record."""
    (size,) = struct.unpack_from("<I", content, at)
    end, at = at + 4 + size, at + 4
    items = {}
    while at < end:
        key, at = read_text(content, at)
        items[key], at = read_text(content, at)
    return items


def read_metadata(content: bytes) -> rec.Metadata:
    """Return the metadata in a record."""
    name, at = read_text(content, 0)
    return rec.Metadata(name, read_text_map(content, at))
