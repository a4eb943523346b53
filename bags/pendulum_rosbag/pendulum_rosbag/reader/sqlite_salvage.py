"""Rows of a rosbag2 ``messages`` table from the pages of an SQLite file that SQLite refuses, for ``repair``.

File format: https://www.sqlite.org/fileformat2.html (sections 1.6 b-tree pages, 2.1 records).
"""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["Row", "page_size", "salvaged_rows"]

Row = tuple[int, int, int, bytes]
"""``id``, ``topic_id``, ``timestamp`` [ns] and ``data``."""

_LEAF = 0x0D
_SIZES = (0, 1, 2, 3, 4, 6, 8, -1, 0, 0)
"""Bytes of an integer by its serial type (8 and 9 are the constants 0 and 1; 7 is a float)."""


def page_size(content: bytes) -> int:
    """Return the page size in the head of an SQLite file, 0 if it is none."""
    if len(content) < 100 or content[:16] != b"SQLite format 3\0":
        return 0
    size = int.from_bytes(content[16:18], "big")
    size = 65536 if size == 1 else size
    return size if size >= 512 and size & (size - 1) == 0 else 0


def salvaged_rows(content: bytes) -> Iterator[Row]:
    """Yield the whole message rows on leaf pages in page order, each ``id`` once (moved rows leave copies)."""
    size = page_size(content)
    seen = set()
    for start in range(0, len(content) - size + 1, size):
        head = start + (100 if start == 0 else 0)
        if content[head] != _LEAF:
            continue
        for number in range(int.from_bytes(content[head + 3 : head + 5], "big")):
            at = head + 8 + 2 * number
            cell = start + int.from_bytes(content[at : at + 2], "big")
            row = _row(content, size, cell) if at + 2 <= start + size and cell > at else None
            if row is not None and row[0] not in seen:
                seen.add(row[0])
                yield row


def _row(content: bytes, size: int, cell: int) -> Row | None:
    length, at = _varint(content, cell)
    row_id, at = _varint(content, at)
    payload = _payload(content, size, at, length)
    values, place = _varint(payload, 0)
    types = []
    while place < values:
        kind, place = _varint(payload, place)
        types.append(kind)
    if place != values or len(types) != 4:
        return None
    identity, topic, time, data = types
    if identity != 0 or not (topic < 10 and time < 10) or min(_SIZES[topic], _SIZES[time]) < 0:
        return None
    begin = values + _SIZES[topic] + _SIZES[time]
    if data < 12 or data % 2 or begin + (data - 12) // 2 != length or length != len(payload):
        return None
    return row_id, _integer(payload, values, topic), _integer(payload, values + _SIZES[topic], time), payload[begin:]


def _payload(content: bytes, size: int, at: int, length: int) -> bytes:
    """Return the bytes of a row with its overflow pages; fewer if those are lost."""
    usable = size - content[20]
    least = (usable - 12) * 32 // 255 - 23
    local = length
    if length > usable - 35:
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    parts = [content[at : at + local]]
    left, following = length - local, int.from_bytes(content[at + local : at + local + 4], "big")
    while left > 0 and 0 < following <= len(content) // size:
        begin = (following - 1) * size
        parts.append(content[begin + 4 : begin + 4 + min(left, usable - 4)])
        left -= usable - 4
        following = int.from_bytes(content[begin : begin + 4], "big")
    return b"".join(parts)


def _varint(content: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place, byte in enumerate(content[at : at + 9]):
        if place == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + place + 1
    return 0, at + 9


def _integer(payload: bytes, at: int, kind: int) -> int:
    if kind in (8, 9):
        return kind - 8
    return int.from_bytes(payload[at : at + _SIZES[kind]], "big", signed=True)
