"""The rows of a rosbag2 ``messages`` table straight from the pages of an SQLite file, thousands at a time.

The SQL interface makes a Python tuple of every row; the b-tree pages hold the same rows side by side. Reading them
as arrays is several times faster, and works on what is left of a file that SQLite refuses to open.

File format: https://www.sqlite.org/fileformat2.html (sections 1.6 b-tree pages, 2.1 records).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pendulum_rosbag.reader.batches import Bytes, Int64

__all__ = ["MessageRows", "leaf_pages", "message_rows", "page_size"]

_LEAF, _INTERIOR = 0x0D, 0x05
_BLOCK = 2048  # leaf pages parsed at once
_INTEGER_SIZES = np.array([-1, 1, 2, 3, 4, 6, 8, -1, 0, 0])
"""Bytes of an integer by its serial type (8 and 9 are the constants 0 and 1; -1 for what is no integer)."""


@dataclass(slots=True)
class MessageRows:
    """Rows of the table as columns, in the order of the pages.

    Args:
        row_ids: ``id``, shape (n,).
        topics: ``topic_id``, shape (n,).
        times: ``timestamp`` [ns], shape (n,).
        offsets: Where the message bytes begin in the file, shape (n,).
        sizes: Bytes of each message, shape (n,).
        local: Whether all of them stand on the page (large messages continue on overflow pages), shape (n,).
        left_out: Number of cells on these pages that are no such rows.
    """

    row_ids: Int64
    topics: Int64
    times: Int64
    offsets: Int64
    sizes: Int64
    local: np.ndarray[tuple[int], np.dtype[np.bool_]]
    left_out: int = 0


def page_size(buffer: Bytes) -> int:
    """Return the page size that the head of an SQLite file names, 0 when it is none."""
    if len(buffer) < 100 or bytes(buffer[:16]) != b"SQLite format 3\0":
        return 0
    size = int(buffer[16]) << 8 | int(buffer[17])
    size = 65536 if size == 1 else size
    return size if size >= 512 and size & (size - 1) == 0 else 0


def leaf_pages(buffer: Bytes, size: int, root: int) -> Int64 | None:
    """Return where the leaves of a table begin in the file, in the order of row ids.

    Args:
        buffer: The whole file.
        size: Page size [bytes].
        root: Number of the table's root page.

    Returns:
        Byte offsets, shape (k,); ``None`` when the pages do not form a tree.
    """
    pages = np.array([root], np.int64)
    for _ in range(20):  # no file is deeper
        if len(pages) * size > len(buffer):
            return None  # a page has one parent, so there cannot be more of them than the file holds
        starts = (pages - 1) * size
        if len(starts) == 0 or int(starts.min()) < 0 or int(starts.max()) + size > len(buffer):
            return None
        kinds = buffer[starts + np.where(starts == 0, 100, 0)]
        if (kinds == _LEAF).all():
            return starts
        if not (kinds == _INTERIOR).all():
            return None
        pages = np.concatenate([_children(buffer, int(start), size) for start in starts])
    return None


def _children(buffer: Bytes, start: int, size: int) -> Int64:
    head = start + (100 if start == 0 else 0)
    count = min(int(buffer[head + 3]) << 8 | int(buffer[head + 4]), (start + size - head - 12) // 2)
    pointers = np.frombuffer(buffer, ">u2", count, head + 12).astype(np.int64) + start
    last = np.array([head + 8], np.int64)
    at = np.concatenate([pointers, last])
    return _big_endian(buffer, at, 4)


def message_rows(buffer: Bytes, size: int, leaves: Int64) -> Iterator[MessageRows]:
    """Yield the rows on leaf pages, some thousand pages at a time; cells that are no message rows are left out.

    Args:
        buffer: The whole file, or what is left of it.
        size: Page size [bytes].
        leaves: Where the leaves begin, shape (k,).
    """
    usable = size - int(buffer[20])
    for begin in range(0, len(leaves), _BLOCK):
        yield _rows(buffer, size, usable, leaves[begin : begin + _BLOCK])


def _rows(buffer: Bytes, size: int, usable: int, leaves: Int64) -> MessageRows:
    heads = leaves + np.where(leaves == 0, 100, 0)
    counts = _big_endian(buffer, heads + 3, 2)
    counts = np.where(counts * 2 + 8 <= size, counts, 0)
    first = np.cumsum(counts) - counts
    total = int(counts.sum())
    page = np.repeat(leaves, counts)
    pointer_at = np.repeat(heads + 8 - 2 * first, counts) + 2 * np.arange(total)
    cells = page + _big_endian(buffer, pointer_at, 2)
    # A cell of a message row has at least two bytes of sizes, five of record head and some data.
    fits = (cells > page) & (cells + 16 <= np.minimum(page + size, len(buffer)))
    cells, page = cells[fits], page[fits]
    payload, at = _varints(buffer, cells)
    row_ids, at = _varints(buffer, at)
    body = at
    head_size, at = _varints(buffer, at)
    identity, at = _varints(buffer, at)
    topic_type, at = _varints(buffer, at)
    time_type, at = _varints(buffer, at)
    data_type, at = _varints(buffer, at)
    values = body + head_size
    topic_size = _INTEGER_SIZES[np.clip(topic_type, 0, 9)]
    time_size = _INTEGER_SIZES[np.clip(time_type, 0, 9)]
    sizes = (data_type - 12) // 2
    offsets = values + topic_size + time_size
    ends = offsets + sizes
    good = (identity == 0) & (at == values) & (topic_type < 10) & (time_type < 10)
    good &= (topic_size >= 0) & (time_size >= 0) & (data_type >= 12) & (data_type % 2 == 0)
    good &= (ends == body + payload) & (offsets <= page + size)
    local = payload <= usable - 35
    good &= ~local | (ends <= np.minimum(page + size, len(buffer)))
    keep = np.flatnonzero(good)
    topics = _integers(buffer, values[keep], topic_type[keep])
    times = _integers(buffer, (values + topic_size)[keep], time_type[keep])
    return MessageRows(row_ids[keep], topics, times, offsets[keep], sizes[keep], local[keep], total - len(keep))


def _varints(buffer: Bytes, at: Int64) -> tuple[Int64, Int64]:
    """Return the variable-length integers that begin at some bytes, and where they end."""
    last = len(buffer) - 1
    byte = buffer[np.minimum(at, last)].astype(np.int64)
    values = byte & 0x7F
    ends = at + 1
    more = np.flatnonzero(byte & 0x80)
    for place in range(1, 9):
        if not len(more):
            break
        byte = buffer[np.minimum(at[more] + place, last)].astype(np.int64)
        ends[more] += 1
        if place == 8:
            values[more] = values[more] << 8 | byte
            break
        values[more] = values[more] << 7 | byte & 0x7F
        more = more[byte & 0x80 != 0]
    return values, ends


def _big_endian(buffer: Bytes, at: Int64, size: int) -> Int64:
    """Return unsigned integers of ``size`` bytes (signed for 8) that begin at some bytes."""
    last = len(buffer) - 1
    value = np.zeros(len(at), np.int64)
    for place in range(size):
        value = value << 8 | buffer[np.minimum(at + place, last)]
    return value


def _integers(buffer: Bytes, at: Int64, kinds: Int64) -> Int64:
    """Return the integers of a column, whose width may differ from row to row."""
    values = np.zeros(len(at), np.int64)
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        size = int(_INTEGER_SIZES[kind])
        if size == 0:
            values[rows] = kind - 8
            continue
        raw = _big_endian(buffer, at[rows], size)
        sign = 1 << (8 * size - 1)
        values[rows] = raw if size == 8 else (raw ^ sign) - sign
    return values
