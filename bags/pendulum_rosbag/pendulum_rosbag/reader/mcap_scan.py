"""Sequential reading of an MCAP file that is damaged, was not closed, or has no index.

Also finds attachments and metadata, which no message index lists, in a file that was cut off.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Bytes
from pendulum_rosbag.reader.decompression import decompress
from pendulum_rosbag.reader.mcap_chunks import (
    CHUNK_FIELDS,
    Chunk,
    DamagedError,
    raw_content,
    read_metadata,
    read_text,
    records_in,
)
from pendulum_rosbag.reader.mcap_topics import McapTopics
from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["McapScan", "MessageTable", "find_extras"]

_HEAD = rec.RECORD_HEAD_SIZE
MessageTable = dict[int, list[tuple[int, int]]]
"""(Log time [ns], offset) of the messages of each channel."""
_OURS = "rosbag2"
"""Name of the metadata that every writer of rosbag2 files writes itself."""


class McapScan:
    """All whole records from the start of the file; a torn end is left out.

    ``sound`` collects the offsets of chunks with a correct checksum. Afterwards ``chunks`` are in file order,
    ``scanned`` has each one's messages, ``loose`` those outside of chunks, ``counts`` the number per channel;
    ``start_ns`` and ``stop_ns`` are log times [ns], ``damage`` is the first damage found, or empty.
    """

    def __init__(self, buffer: Bytes, path: Path, topics: McapTopics, sound: set[int], damage: str) -> None:
        self._buffer = buffer
        self._path = path
        self._topics = topics
        self._sound = sound
        self.damage = damage
        self.chunks: list[Chunk] = []
        self.scanned: list[MessageTable] = []
        self.loose: MessageTable = {}
        self.counts: dict[int, int] = {}
        self.start_ns, self.stop_ns = 2**63 - 1, 0
        self._walk()

    def _walk(self) -> None:
        size = len(self._buffer)
        view = self._buffer.data
        at = 8
        while at + _HEAD <= size:
            opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
            body = at + _HEAD
            if opcode in (rec.DATA_END, rec.FOOTER):
                break
            if opcode == 0 or body + length > size:
                rest = size - at
                self.damage = self.damage or f"the last {rest} bytes are no whole record"
                if opcode == rec.CHUNK:
                    self._scan_torn_chunk(body)
                break
            if opcode == rec.CHUNK:
                self._scan_chunk(body, length)
            elif opcode == rec.MESSAGE:
                if length < 22:
                    self.damage = self.damage or f"the message at byte {at} is not whole"
                else:
                    self._note(view, at, self.loose, at)
            elif opcode in (rec.SCHEMA, rec.CHANNEL, rec.METADATA):
                self._try_description(opcode, bytes(view[body : body + length]))
            at = body + length
        if not self.counts:
            self.start_ns = 0

    def _try_description(self, opcode: int, content: bytes) -> None:
        try:
            self._topics.take(opcode, content)
        except (struct.error, UnicodeDecodeError):
            self.damage = self.damage or "a record of a topic is not readable"

    def _scan_chunk(self, body: int, length: int) -> None:
        try:
            chunk, crc = self._chunk_at(body)
            if chunk.data_start + chunk.data_size > body + length:
                raise DamagedError("chunk")
            raw = raw_content(chunk, self._path)
            if crc and zlib.crc32(raw.data) != crc:
                raise DamagedError("checksum")
            records, end = records_in(raw)
            if end != len(raw):
                raise DamagedError("a record does not fit its chunk")
            chunk.crc = crc
            self._sound.add(chunk.offset)
        except (DamagedError, BagError, struct.error, UnicodeDecodeError):
            self.damage = self.damage or f"the chunk at byte {body - _HEAD} is not whole"
            return
        self._take_chunk(chunk, raw, records)

    def _scan_torn_chunk(self, body: int) -> None:
        """Take the whole records of a chunk whose end was cut off; no checksum covers them."""
        try:
            chunk, _ = self._chunk_at(body)
            packed = self._buffer[chunk.data_start :]
            raw = packed
            if chunk.compression:
                content = decompress(packed, chunk.compression, chunk.raw_size, str(self._path), torn=True)
                raw = np.frombuffer(content, np.uint8)
            records, end = records_in(raw)
        except (BagError, struct.error, UnicodeDecodeError):
            return
        # Stored decompressed, so that later reads need not decompress the torn chunk again.
        whole = Chunk(np.ascontiguousarray(raw[:end]), chunk.start_ns, chunk.stop_ns, 0, end, end, "")
        self._take_chunk(whole, raw, records)

    def _chunk_at(self, body: int) -> tuple[Chunk, int]:
        view = self._buffer.data
        start, stop, raw_size, crc, text_size = CHUNK_FIELDS.unpack_from(view, body)
        compression, at = read_text(bytes(view[body + 28 : body + 32 + text_size]), 0)
        at += body + 28
        (packed,) = struct.unpack_from("<Q", view, at)
        return Chunk(self._buffer, start, stop, at + 8, packed, raw_size, compression, offset=body - _HEAD), crc

    def _take_chunk(self, chunk: Chunk, raw: Bytes, records: list[tuple[int, int, int]]) -> None:
        scanned: MessageTable = {}
        for opcode, offset, size in records:
            if opcode == rec.MESSAGE:
                self._note(raw, offset, scanned, offset)
            elif opcode in (rec.SCHEMA, rec.CHANNEL):
                self._try_description(opcode, bytes(raw[offset + _HEAD : offset + _HEAD + size]))
        self.scanned.append(scanned)
        self.chunks.append(chunk)

    def _note(self, raw: Any, offset: int, into: MessageTable, position: int) -> None:
        channel, _, time = struct.unpack_from("<HIq", raw, offset + _HEAD)
        into.setdefault(channel, []).append((time, position))
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = min(self.start_ns, time)
        self.stop_ns = max(self.stop_ns, time)


def find_extras(buffer: Bytes) -> Iterator[rec.Attachment | rec.Metadata]:
    """Yield the attachments and metadata in a file's bytes, except ``metadata.yaml`` and broken records."""
    view, size, at = buffer.data, len(buffer), len(rec.MAGIC)
    while at + _HEAD <= size:
        opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
        body = at + _HEAD
        at = body + length
        if opcode in (0, rec.DATA_END, rec.FOOTER) or at > size:
            return
        if opcode not in (rec.ATTACHMENT, rec.METADATA):
            continue
        content = bytes(view[body:at])
        try:
            extra = _attachment(content) if opcode == rec.ATTACHMENT else read_metadata(content)
        except (struct.error, UnicodeDecodeError):
            continue
        if not isinstance(extra, rec.Metadata) or extra.name != _OURS:
            yield extra


def _attachment(content: bytes) -> rec.Attachment:
    name, at = read_text(content, 16)
    media_type, at = read_text(content, at)
    (size,) = struct.unpack_from("<Q", content, at)
    if at + 8 + size + 4 != len(content):
        raise struct.error("attachment does not fill its record")
    return rec.Attachment(content, name, media_type, size)
