"""Decompression with a bound: no chunk or file costs more memory than it claims, or than any recorder needs."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Batch, Bytes, Source, joined
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata

__all__ = ["UnpackedSource", "decompress", "decompress_bounded", "holds_packed_messages"]

_MAX_CHUNK = 1 << 28  # decompressed bytes of one chunk: recorders write about 1 MB, bombs more
_GROUP_SIZE = 1 << 20  # decompressed bytes that are parsed at once
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Start of a zstd frame, but of no CDR message, whose second byte is its byte order and kind (0 to 11)."""


def decompress(packed: Bytes, compression: str, size: int, name: str, *, torn: bool = False) -> bytes:
    """Return the content of a chunk (``zstd`` or ``lz4``), at most the bounded ``size`` in its head [bytes].

    ``torn`` returns the recoverable beginning of a chunk whose end was cut off. Raises a BagError that names the file
    for unknown compression, a chunk larger than any recorder's, or damaged bytes.
    """
    if size > _MAX_CHUNK:
        raise BagError(f"{name}: a chunk claims to hold {size} bytes; expected at most {_MAX_CHUNK}")
    if compression == "zstd":
        import zstandard

        try:
            if torn:
                return _beginning(io.BytesIO(packed.tobytes()), size)
            claimed = zstandard.frame_content_size(packed.data)  # -1 if the frame does not say
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
    if torn:
        return bytes(raw[:size])
    if len(raw) != size:
        raise BagError(f"{name}: a chunk holds {len(raw)} bytes; its head says {size}")
    return raw


def decompress_bounded(packed: BinaryIO, name: str, limit: int = _MAX_CHUNK) -> bytes:
    """Return the content of a zstd stream whose size is unknown; a BagError above ``limit`` bytes or if damaged."""
    import zstandard

    try:
        content = _beginning(packed, limit + 1)
    except (OSError, zstandard.ZstdError) as error:
        raise BagError(f"{name} cannot be decompressed: {error}") from None
    if len(content) > limit:
        raise BagError(f"{name} holds more than {limit} bytes when decompressed")
    return content


def _beginning(packed: BinaryIO, size: int) -> bytes:
    """Return the first bytes of a zstd stream, using no more memory than that."""
    import zstandard

    parts, left = [], size
    with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
        while left > 0 and (part := stream.read(min(left, 1 << 20))):
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


class UnpackedSource:
    """A storage file with separately compressed messages (``ros2 bag record --compression-mode message``)."""

    compressed = True

    def __init__(self, packed: Source) -> None:
        self.packed = packed
        self.path = packed.path
        self.streams = packed.streams
        self.start_ns = packed.start_ns
        self.stop_ns = packed.stop_ns
        self.damage = packed.damage
        self.unclosed = packed.unclosed
        self.unchecked = packed.unchecked

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield batches as :class:`Source`; a BagError if a message is damaged or claims an impossible size."""
        for batch in self.packed.batches(channels, start, stop):
            times: list[int] = []
            parts: list[bytes] = []
            size = 0
            for time, data in batch.payloads():
                parts.append(self._unpacked(data))
                times.append(time)
                size += len(parts[-1])
                if size >= _GROUP_SIZE:
                    yield _batch(batch.channel, times, parts)
                    times, parts, size = [], [], 0
            if times:
                yield _batch(batch.channel, times, parts)

    def extras(self) -> list[Attachment | Metadata]:
        """Return attachments and metadata of the file."""
        return self.packed.extras()

    def close(self) -> None:
        """Release the file."""
        self.packed.close()

    def _unpacked(self, data: bytes) -> bytes:
        # A recorder that could not compress a message in time may leave it uncompressed.
        if not data.startswith(_ZSTD_MAGIC):
            return data
        return decompress_bounded(io.BytesIO(data), f"a message of {self.path}")


def _batch(channel: int, times: list[int], parts: list[bytes]) -> Batch:
    buffer, offsets, sizes = joined(parts)
    return Batch(channel, buffer, offsets, np.array(times, np.int64), sizes)


def holds_packed_messages(source: Source) -> bool:
    """Return whether a file's first message is compressed, if no metadata says so."""
    for stream in source.streams:
        if stream.serialization != "cdr" or not stream.count:
            continue
        for batch in source.batches({stream.channel}, None, None):
            for _, data in batch.payloads():
                return data.startswith(_ZSTD_MAGIC)
    return False
