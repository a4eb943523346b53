"""The interface between storage files and parsers: many messages of one topic in one buffer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.storage.mcap_records import MESSAGE, Attachment, Metadata

__all__ = ["MCAP_HEAD", "Batch", "Bytes", "Int64", "Source", "Stream", "items_at", "joined", "within"]

Bytes = npt.NDArray[np.uint8]
Int64 = npt.NDArray[np.int64]

MCAP_HEAD = 31
"""Bytes of an MCAP record before the message: opcode, length, channel, sequence, two times."""
_HEAD = np.dtype(
    {"names": ["opcode", "channel", "time"], "formats": ["u1", "<u2", "<i8"], "offsets": [0, 9, 15], "itemsize": 23}
)
_OVERLAP = "the bag names messages that overlap each other; try to repair it"


def _unknown_origin(*_: int) -> str:
    return "the message index"


def items_at(buffer: Bytes, item: np.dtype[Any], at: Int64) -> npt.NDArray[Any]:
    """Return copies of the items at byte offsets of a buffer, by a strided view with one row per byte."""
    places = max(len(buffer) - item.itemsize + 1, 0)
    anywhere: npt.NDArray[Any] = np.ndarray((places,), f"V{item.itemsize}", buffer.data, strides=(1,))
    return anywhere[at].view(item)


def joined(datas: Sequence[bytes]) -> tuple[Bytes, Int64, Int64]:
    """Return messages in one buffer, their offsets there and their sizes."""
    sizes = np.fromiter(map(len, datas), np.int64, len(datas))
    return np.frombuffer(b"".join(datas), np.uint8), np.cumsum(sizes) - sizes, sizes


def within(times: Int64, start: int | None, stop: int | None) -> npt.NDArray[np.bool_]:
    """Return which log times [ns] lie in the half-open span from start to stop; ``None`` is unlimited."""
    inside = np.ones(len(times), bool)
    if start is not None:
        inside &= times >= start
    if stop is not None:
        inside &= times < stop
    return inside


@dataclass(slots=True)
class Batch:
    """Messages of one channel of a storage file.

    Args:
        channel: Channel id (MCAP) or topic id (SQLite).
        buffer: Bytes of all messages of the batch, shape (n,).
        offsets: Offset of each message (SQLite) or message record (MCAP) in ``buffer``, shape (k,).
        times: Log time of each message [ns], shape (k,).
        sizes: Bytes of each message, shape (k,); ``None`` for MCAP, whose records carry their length.
        origin: Names the index that lists a message (by log time [ns] and offset), for errors.
    """

    channel: int
    buffer: Bytes
    offsets: Int64
    times: Int64
    sizes: Int64 | None = None
    origin: Callable[[int, int], str] = _unknown_origin

    @property
    def head(self) -> int:
        """Bytes between an offset and the first byte of its message."""
        return MCAP_HEAD if self.sizes is None else 0

    def check_heads(self) -> None:
        """Compare an MCAP message index, which has no checksum, with the messages; a BagError if they differ."""
        if self.sizes is not None:
            return
        heads = items_at(self.buffer, _HEAD, self.offsets)
        same = (heads["opcode"] == MESSAGE) & (heads["channel"] == self.channel) & (heads["time"] == self.times)
        if not same.all():
            wrong = int(np.argmin(same))
            time, offset = int(self.times[wrong]), int(self.offsets[wrong])
            raise BagError(
                f"{self.origin(time, offset)} names a message at {time * 1e-9:.3f} s where there is none; "
                "try to repair the bag"
            )

    def payloads(self) -> Iterator[tuple[int, bytes]]:
        """Yield (log time [ns], message bytes) one by one."""
        self.check_heads()
        view = self.buffer.data
        # Messages do not overlap, so together they are no larger than the buffer. An index that says otherwise is
        # damaged, or a bomb that names one large message a million times.
        left = len(view)
        if self.sizes is not None:
            for time, start, size in zip(self.times.tolist(), self.offsets.tolist(), self.sizes.tolist(), strict=True):
                left -= size
                if left < 0:
                    raise BagError(_OVERLAP)
                yield time, bytes(view[start : start + size])
            return
        for time, start in zip(self.times.tolist(), self.offsets.tolist(), strict=True):
            size = int.from_bytes(view[start + 1 : start + 9], "little") - 22
            left -= max(size, 0)
            if left < 0:
                raise BagError(_OVERLAP)
            yield time, bytes(view[start + MCAP_HEAD : start + MCAP_HEAD + size])


@dataclass(frozen=True, slots=True)
class Stream:
    """A topic inside one storage file; ``definition`` is its message definition text, if the file has one."""

    channel: int
    topic: str
    type: str
    count: int
    definition: str = ""
    encoding: str = ""
    hash: str = ""
    qos: str = ""
    serialization: str = "cdr"


class Source(Protocol):
    """A storage file that is open for reading."""

    path: Path
    streams: list[Stream]
    compressed: bool
    start_ns: int
    stop_ns: int
    damage: str
    unclosed: bool
    unchecked: str

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield all messages of some channels with start <= log time < stop, in the order of the file."""
        ...

    def extras(self) -> list[Attachment | Metadata]:
        """Return attachments and metadata that other programs put into the file."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...
