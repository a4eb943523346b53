"""Bags whose messages were compressed one by one (``ros2 bag record --compression-mode message``)."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np

from pendulum_rosbag.reader.batches import Batch, Source, joined
from pendulum_rosbag.reader.decompression import decompress_bounded
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata

__all__ = ["UnpackedSource", "holds_packed_messages"]

_GROUP_SIZE = 1 << 20  # decompressed bytes that are parsed at once
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""How a zstd frame begins; no CDR message does, whose second byte says its byte order and kind (0 to 11)."""


class UnpackedSource:
    """A storage file whose messages are decompressed on their way to the parsers.

    Args:
        packed: The file as it is.
    """

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
        """Yield all messages of some channels with start <= log time < stop, in the order of the file.

        Raises:
            BagError: A message cannot be decompressed, or claims to be larger than any message.
        """
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
        # (a recorder that could not compress a message in time may leave it as it was)
        if not data.startswith(_ZSTD_MAGIC):
            return data
        return decompress_bounded(io.BytesIO(data), f"a message of {self.path}")


def _batch(channel: int, times: list[int], parts: list[bytes]) -> Batch:
    buffer, offsets, sizes = joined(parts)
    return Batch(channel, buffer, offsets, np.array(times, np.int64), sizes)


def holds_packed_messages(source: Source) -> bool:
    """Tell by its first message whether the messages of a file are compressed, where no metadata says so."""
    for stream in source.streams:
        if stream.serialization != "cdr" or not stream.count:
            continue
        for batch in source.batches({stream.channel}, None, None):
            for _, data in batch.payloads():
                return data.startswith(_ZSTD_MAGIC)
    return False
