"""Message indexes of an MCAP file: log times and offsets of the messages of many chunks at once."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Bytes, Int64, items_at
from pendulum_rosbag.reader.mcap_chunks import Chunk
from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["indexed_counts", "indexed_messages"]

_INDEX_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "size"],
        "formats": ["u1", "<u8", "<u2", "<u4"],
        "offsets": [0, 1, 9, 11],
        "itemsize": 15,
    }
)
_HEAD = struct.Struct("<BQHI")
_INDEX_ENTRY = np.dtype([("time", "<i8"), ("offset", "<i8")])


def indexed_counts(chunks: Sequence[Chunk]) -> dict[int, int]:
    """Return how many messages the indexes of some chunks name, by channel id.

    Only their heads are read, which costs next to nothing. Raises struct.error for an index beyond the end of the file.
    """
    counts: dict[int, int] = {}
    for chunk in chunks:
        view = chunk.buffer.data
        for channel, at in chunk.indexes.items():
            *_, size = _HEAD.unpack_from(view, at)
            counts[channel] = counts.get(channel, 0) + size // 16
    return counts


def indexed_messages(path: Path, channel: int, index: Bytes, places: Sequence[tuple[int, int]]) -> tuple[Int64, Int64]:
    """Return log times [ns] and record offsets of a channel's messages; a BagError for damaged indexes.

    ``index``: bytes that hold the message indexes, shape (n,); ``places``: offset of each index there, and what to add
    to its offsets.
    """
    if not places:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    at, base = np.array(places, np.int64).T
    heads = _take(path, index, _INDEX_HEAD, at)
    if len(np.unique(at)) != len(at):
        raise BagError(f"{path}: two chunks name one message index; try to repair the bag")
    counts = heads["size"].astype(np.int64) // 16
    whole = (heads["opcode"] == rec.MESSAGE_INDEX) & (heads["channel"] == channel)
    whole &= (heads["length"] == heads["size"] + np.uint64(6)) & (at + 15 + 16 * counts <= len(index))
    if not whole.all():
        wrong = int(at[~whole][0])
        raise BagError(f"{path}: the message index at byte {wrong} is damaged; try to repair the bag")
    first = np.cumsum(counts) - counts
    rows_at = np.repeat(at + 15 - 16 * first, counts) + 16 * np.arange(int(counts.sum()))
    table = _take(path, index, _INDEX_ENTRY, rows_at)
    offsets = table["offset"] + np.repeat(base, counts)
    # Nearly always they ascend.
    if not (offsets[1:] > offsets[:-1]).all() and len(np.unique(offsets)) != len(offsets):
        raise BagError(f"{path}: a message index names a message twice; try to repair the bag")
    return table["time"], offsets


def _take(path: Path, buffer: Bytes, item: np.dtype[Any], at: Int64) -> Any:
    if len(at) and not 0 <= int(at.max()) <= len(buffer) - item.itemsize:
        raise BagError(f"{path}: a message index lies beyond the end of the file; try to repair the bag")
    return items_at(buffer, item, at)
