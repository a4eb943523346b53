"""Reading MCAP files by their message indexes, and without them when the file is damaged."""

from __future__ import annotations

import contextlib
import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pendulum_bags.reader.batches import MCAP_HEAD, Batch, Bytes, Int64, Stream
from pendulum_bags.storage import mcap_records as rec
from pendulum_msgs_py.errors import BagError

__all__ = ["Chunk", "McapSource", "decompress", "decompress_bounded"]

_HEAD = rec.RECORD_HEAD_SIZE
_FOOTER_REGION = rec.FOOTER_SIZE + len(rec.MAGIC)
_CHUNK_FIELDS = struct.Struct("<QQQII")
_GROUP_SIZE = 1 << 20  # decompressed bytes that are parsed at once
_MAX_CHUNK = 1 << 28  # decompressed bytes of one chunk: recorders write chunks of about 1 MB, bombs larger ones
_INDEX_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "size"],
        "formats": ["u1", "<u8", "<u2", "<u4"],
        "offsets": [0, 1, 9, 11],
        "itemsize": 15,
    }
)
_INDEX_ENTRY = np.dtype([("time", "<i8"), ("offset", "<i8")])
_Table = dict[int, list[tuple[int, int]]]


class _DamagedError(Exception):
    """The file is not what its footer, index or records claim."""


class _NoIndexError(Exception):
    """The file has no index, as the format allows: its records must be walked through."""


@dataclass(slots=True)
class Chunk:
    """One chunk: where its records stand in the file, and where its message indexes do (channel -> offset)."""

    start_ns: int
    stop_ns: int
    data_start: int
    data_size: int
    raw_size: int
    compression: str
    indexes: dict[int, int] = field(default_factory=dict)


class McapSource:
    """One MCAP file, read through a memory map.

    A file with a footer is read by its index. A file without one (its writer died), or with an index that does not
    fit the file, is scanned from the start; then ``damage`` says what was found. ``unclosed`` is true for a file of
    our recorder that is complete but was not closed.

    Args:
        path: The file.
        data: Its content, when it is not a plain file (a decompressed copy).

    Raises:
        BagError: The file cannot be opened or is no MCAP file at all.
    """

    def __init__(self, path: Path, data: bytes | None = None) -> None:
        self.path = path
        self.damage = ""
        self.unclosed = False
        self.metadata: dict[str, dict[str, str]] = {}
        self._map: mmap.mmap | None = None
        self.buffer: Bytes = self._open(data)
        if bytes(self.buffer[:8]) != rec.MAGIC:
            self.close()
            raise BagError(f"{path} does not begin as an MCAP file; expected the bytes {rec.MAGIC!r}")
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        self.chunks: list[Chunk] = []
        # Only after a scan: (time, offset) of messages outside of chunks by channel, and inside of each chunk.
        self._loose: _Table = {}
        self._scanned: list[_Table] = []
        self._counts: dict[int, int] = {}
        self.start_ns = 0
        self.stop_ns = 0
        try:
            self._read_summary()
        except _NoIndexError:
            self._scan("")
        except (_DamagedError, struct.error, ValueError, KeyError, OverflowError, IndexError) as error:
            self._scan(str(error) or type(error).__name__)
        self.compressed = any(chunk.compression for chunk in self.chunks)
        self.streams = [self._stream(channel) for channel in sorted(self._channels)]

    def close(self) -> None:
        """Release the memory map once no array refers to it any more."""
        self.buffer = np.empty(0, np.uint8)
        if self._map is not None:
            with contextlib.suppress(BufferError):  # an array still looks into it; it goes with that array
                self._map.close()
            self._map = None

    # -- opening -----------------------------------------------------------------------------------------------

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
        buffer, size = self.buffer, len(self.buffer)
        footer = size - _FOOTER_REGION
        if footer < 8 or bytes(buffer[-8:]) != rec.MAGIC:
            raise _DamagedError("the file has no footer")
        opcode, length = rec.RECORD_HEAD.unpack(bytes(buffer[footer : footer + _HEAD]))
        if opcode != rec.FOOTER or length != 20:
            raise _DamagedError("the footer is not whole")
        (at,) = struct.unpack("<Q", bytes(buffer[footer + _HEAD : footer + _HEAD + 8]))
        if at == 0:
            raise _NoIndexError
        if not 8 <= at <= footer:
            raise _DamagedError(f"the footer points to byte {at} of {size}")
        statistics = False
        while at < footer:
            opcode, length = rec.RECORD_HEAD.unpack(bytes(buffer[at : at + _HEAD]))
            at += _HEAD
            if at + length > footer:
                raise _DamagedError(f"a summary record of {length} bytes does not fit the file")
            if opcode == rec.PADDING:
                self.unclosed = True  # complete, but its writer did not give back the room to grow
                break
            if opcode == rec.SUMMARY_OFFSET:
                at += length
                continue
            statistics |= self._take_summary_record(opcode, bytes(buffer[at : at + length]))
            at += length
        if not statistics and not self.chunks:
            raise _NoIndexError
        if self.chunks:
            if not self._counts or any(not chunk.indexes for chunk in self.chunks):
                raise _NoIndexError
            if len({chunk.data_start for chunk in self.chunks}) != len(self.chunks):
                raise _DamagedError("the index names a chunk twice")
            self.start_ns = min(chunk.start_ns for chunk in self.chunks)
            self.stop_ns = max(chunk.stop_ns for chunk in self.chunks)
        elif sum(self._counts.values()):
            raise _NoIndexError  # messages outside of chunks

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
                self._take_description(rec.METADATA, bytes(self.buffer[start + _HEAD : start + length]))
        else:
            self._take_description(opcode, content)
        return False

    def _take_description(self, opcode: int, content: bytes) -> None:
        if opcode == rec.SCHEMA:
            (key,) = struct.unpack_from("<H", content)
            name, at = _text(content, 2)
            encoding, at = _text(content, at)
            definition, at = _text(content, at)
            self._schemas[key] = (name, encoding, definition)
        elif opcode == rec.CHANNEL:
            key, schema = struct.unpack_from("<HH", content)
            topic, at = _text(content, 4)
            encoding, at = _text(content, at)
            self._channels[key] = (schema, topic, encoding, _text_map(content, at))
        elif opcode == rec.METADATA:
            name, at = _text(content, 0)
            self.metadata[name] = _text_map(content, at)

    def _chunk_from_index(self, content: bytes) -> Chunk:
        start, stop, offset, _, size = struct.unpack_from("<QQQQI", content)
        indexes = dict(struct.iter_unpack("<HQ", content[36 : 36 + size]))
        at = 36 + size + 8
        compression, at = _text(content, at)
        packed, raw = struct.unpack_from("<QQ", content, at)
        data_start = offset + _HEAD + _CHUNK_FIELDS.size + len(compression) + 8
        if data_start + packed > len(self.buffer) or any(at >= len(self.buffer) for at in indexes.values()):
            raise _DamagedError("the index names a chunk beyond the end of the file")
        if self.buffer[offset] != rec.CHUNK:
            raise _DamagedError("the index names a chunk where there is none")
        return Chunk(start, stop, data_start, packed, raw, compression, indexes)

    def _stream(self, channel: int) -> Stream:
        schema, topic, encoding, metadata = self._channels[channel]
        name, schema_encoding, definition = self._schemas.get(schema, ("", "", ""))
        return Stream(
            channel,
            topic,
            name,
            self._counts.get(channel, 0),
            definition,
            schema_encoding,
            qos=metadata.get("offered_qos_profiles", ""),
            serialization=encoding,
        )

    # -- scanning ----------------------------------------------------------------------------------------------

    def _scan(self, damage: str) -> None:
        """Find all whole records from the start of the file; what is cut off at its end is left out."""
        self.damage = damage
        self.chunks.clear()
        self._counts.clear()
        self.start_ns, self.stop_ns = 2**63 - 1, 0
        size = len(self.buffer)
        view = self.buffer.data
        at = 8
        while at + _HEAD <= size:
            opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
            body = at + _HEAD
            if opcode in (rec.DATA_END, rec.FOOTER):
                break
            if opcode == 0 or body + length > size:
                rest = size - at
                self.damage = self.damage or f"the last {rest} bytes are no whole record"
                break
            if opcode == rec.CHUNK:
                self._scan_chunk(body, length)
            elif opcode == rec.MESSAGE:
                if length < 22:
                    self.damage = self.damage or f"the message at byte {at} is not whole"
                else:
                    self._note(view, at, self._loose, at)
            elif opcode in (rec.SCHEMA, rec.CHANNEL, rec.METADATA):
                self._try_description(opcode, bytes(view[body : body + length]))
            at = body + length
        if not self._counts:
            self.start_ns = 0

    def _try_description(self, opcode: int, content: bytes) -> None:
        try:
            self._take_description(opcode, content)
        except (struct.error, UnicodeDecodeError):
            self.damage = self.damage or "a record of a topic is not readable"

    def _scan_chunk(self, body: int, length: int) -> None:
        view = self.buffer.data
        try:
            start, stop, raw_size, crc, text_size = _CHUNK_FIELDS.unpack_from(view, body)
            compression, at = _text(bytes(view[body + 28 : body + 32 + text_size]), 0)
            at += body + 28
            (packed,) = struct.unpack_from("<Q", view, at)
            at += 8
            if at + packed > body + length:
                raise _DamagedError("chunk")
            chunk = Chunk(start, stop, at, packed, raw_size, compression)
            raw = self._raw(chunk)
            if crc and zlib.crc32(raw.data) != crc:
                raise _DamagedError("checksum")
            records = self._records(raw)
        except (_DamagedError, BagError, struct.error, UnicodeDecodeError):
            self.damage = self.damage or f"the chunk at byte {body - _HEAD} is not whole"
            return
        scanned: _Table = {}
        for opcode, offset, size in records:
            if opcode == rec.MESSAGE:
                self._note(raw, offset, scanned, offset)
            elif opcode in (rec.SCHEMA, rec.CHANNEL):
                self._try_description(opcode, bytes(raw[offset + _HEAD : offset + _HEAD + size]))
        self._scanned.append(scanned)
        self.chunks.append(chunk)

    @staticmethod
    def _records(raw: Any) -> list[tuple[int, int, int]]:
        found = []
        at, size = 0, len(raw)
        view = memoryview(raw)
        while at + _HEAD <= size:
            opcode, length = rec.RECORD_HEAD.unpack_from(view, at)
            if at + _HEAD + length > size or (opcode == rec.MESSAGE and length < 22):
                raise _DamagedError("a record does not fit its chunk")
            found.append((opcode, at, length))
            at += _HEAD + length
        return found

    def _note(self, raw: Any, offset: int, into: _Table, position: int) -> None:
        channel, _, time = struct.unpack_from("<HIq", raw, offset + _HEAD)
        into.setdefault(channel, []).append((time, position))
        self._counts[channel] = self._counts.get(channel, 0) + 1
        self.start_ns = min(self.start_ns, time)
        self.stop_ns = max(self.stop_ns, time)

    # -- reading -----------------------------------------------------------------------------------------------

    def _raw(self, chunk: Chunk) -> Bytes:
        packed = self.buffer[chunk.data_start : chunk.data_start + chunk.data_size]
        if not chunk.compression:
            return packed
        return np.frombuffer(decompress(packed, chunk.compression, chunk.raw_size, str(self.path)), np.uint8)

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield all messages of some channels with start <= log time < stop, in the order of the file."""
        for channel, entries in self._loose.items():
            if channel in channels:
                table = np.array(entries, np.int64)
                yield from self._cut(Batch(channel, self.buffer, table[:, 1], table[:, 0]), start, stop)
        for buffer, members in self._groups(channels, start, stop):
            for channel in channels:
                times, offsets = self._entries(channel, members)
                if len(times):
                    yield from self._cut(Batch(channel, buffer, offsets, times), start, stop)

    def _groups(
        self, channels: set[int], start: int | None, stop: int | None
    ) -> Iterator[tuple[Bytes, list[tuple[int, int]]]]:
        """Yield buffers that hold many chunks, each with (number of the chunk, where it begins in the buffer)."""
        plain: list[tuple[int, int]] = []
        packed: list[tuple[int, int]] = []
        parts: list[Bytes] = []
        size = 0
        for number, chunk in enumerate(self.chunks):
            if (start is not None and chunk.stop_ns < start) or (stop is not None and chunk.start_ns >= stop):
                continue
            if channels.isdisjoint(self._scanned[number] if self._scanned else chunk.indexes):
                continue
            if not chunk.compression:
                plain.append((number, chunk.data_start))  # they all lie in the same map
                continue
            parts.append(self._raw(chunk))
            packed.append((number, size))
            size += chunk.raw_size
            if size >= _GROUP_SIZE:
                yield np.concatenate(parts), packed
                packed, parts, size = [], [], 0
        if packed:
            yield np.concatenate(parts), packed
        if plain:
            yield self.buffer, plain

    def _entries(self, channel: int, members: list[tuple[int, int]]) -> tuple[Int64, Int64]:
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
            (index, base)
            for number, base in members
            if (index := self.chunks[number].indexes.get(channel)) is not None
        ]
        if not places:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        at, base = np.array(places, np.int64).T
        heads = self._take(_INDEX_HEAD, at)
        if len(np.unique(at)) != len(at):
            raise BagError(f"{self.path}: two chunks name one message index; try to repair the bag")
        counts = heads["size"].astype(np.int64) // 16
        whole = (heads["opcode"] == rec.MESSAGE_INDEX) & (heads["channel"] == channel)
        whole &= (heads["length"] == heads["size"] + np.uint64(6)) & (
            at + 15 + 16 * counts <= len(self.buffer)
        )
        if not whole.all():
            wrong = int(at[~whole][0])
            raise BagError(
                f"{self.path}: the message index at byte {wrong} is damaged; try to repair the bag"
            )
        first = np.cumsum(counts) - counts
        rows_at = np.repeat(at + 15 - 16 * first, counts) + 16 * np.arange(int(counts.sum()))
        table = self._take(_INDEX_ENTRY, rows_at)
        return table["time"], table["offset"] + np.repeat(base, counts)

    def _take(self, item: np.dtype[Any], at: Int64) -> Any:
        """Return copies of the items that begin at some bytes of the file."""
        places = max(len(self.buffer) - item.itemsize + 1, 0)
        if len(at) and not 0 <= int(at.max()) < places:
            raise BagError(
                f"{self.path}: a message index lies beyond the end of the file; try to repair the bag"
            )
        anywhere: np.ndarray[Any, Any] = np.ndarray(
            (places,), f"V{item.itemsize}", self.buffer.data, strides=(1,)
        )
        return anywhere[at].view(item)

    def _cut(self, batch: Batch, start: int | None, stop: int | None) -> Iterator[Batch]:
        """Limit a batch to a time span and check that its records lie inside the buffer."""
        if start is not None or stop is not None:
            keep = np.ones(len(batch.times), bool)
            if start is not None:
                keep &= batch.times >= start
            if stop is not None:
                keep &= batch.times < stop
            batch = Batch(batch.channel, batch.buffer, batch.offsets[keep], batch.times[keep])
        if not len(batch.times):
            return
        if int(batch.offsets.min()) < 0 or int(batch.offsets.max()) + MCAP_HEAD > len(batch.buffer):
            raise BagError(f"{self.path}: a message index points outside of its chunk; try to repair the bag")
        yield batch


def decompress(packed: Bytes, compression: str, size: int, name: str) -> bytes:
    """Return the content of a chunk.

    Never more is decompressed than the head of the chunk says, and that has a bound.

    Raises:
        BagError: Unknown compression, a chunk larger than any recorder's, or the bytes are damaged.
    """
    if size > _MAX_CHUNK:
        raise BagError(f"{name}: a chunk claims to hold {size} bytes; expected at most {_MAX_CHUNK}")
    if compression == "zstd":
        import zstandard

        try:
            claimed = zstandard.frame_content_size(packed.data)  # -1 where the frame does not say
            if claimed not in (-1, size):
                raise BagError(f"{name}: a chunk claims to hold {claimed} bytes; its head says {size}")
            raw = zstandard.ZstdDecompressor().decompress(packed.data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise BagError(f"{name}: a compressed chunk is damaged ({error})") from None
    elif compression == "lz4":
        import lz4.frame

        try:
            raw = lz4.frame.LZ4FrameDecompressor().decompress(packed.tobytes(), max_length=size + 1)
        except (RuntimeError, EOFError) as error:
            raise BagError(f"{name}: a compressed chunk is damaged ({error})") from None
    else:
        raise BagError(f"{name}: chunk compression is {compression!r}; expected zstd, lz4 or none")
    if len(raw) != size:
        raise BagError(f"{name}: a chunk holds {len(raw)} bytes; its head says {size}")
    return raw


def decompress_bounded(packed: BinaryIO, name: str, limit: int = _MAX_CHUNK) -> bytes:
    """Return the content of a zstd stream that does not say how much it holds, or cannot be believed.

    Raises:
        BagError: It holds more than ``limit`` bytes, or is damaged.
    """
    import zstandard

    parts, size = [], 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while part := stream.read(1 << 20):
                parts.append(part)
                size += len(part)
                if size > limit:
                    raise BagError(f"{name} holds more than {limit} bytes when decompressed")
    except (OSError, zstandard.ZstdError) as error:
        if isinstance(error, BagError):
            raise
        raise BagError(f"{name} cannot be decompressed: {error}") from None
    return b"".join(parts)


def _text(content: bytes, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", content, at)
    end = at + 4 + size
    if end > len(content):
        raise struct.error("text beyond the end of its record")
    return content[at + 4 : end].decode(), end


def _text_map(content: bytes, at: int) -> dict[str, str]:
    (size,) = struct.unpack_from("<I", content, at)
    end, at = at + 4 + size, at + 4
    items = {}
    while at < end:
        key, at = _text(content, at)
        items[key], at = _text(content, at)
    return items
