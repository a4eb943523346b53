"""Growing tables in an SQLite file (https://www.sqlite.org/fileformat2.html, 1.6 b-tree pages, 2.1 records)."""

from __future__ import annotations

import struct
from typing import Any

__all__ = ["PAGE", "Pages", "Table", "record", "tree_page", "varint"]

PAGE = 4096
"""Size of a page [bytes]."""
_LEAF_ROOM = PAGE - 8
_INTERIOR_ROOM = PAGE - 12
_LARGEST_LOCAL = PAGE - 35
_SMALLEST_LOCAL = (PAGE - 12) * 32 // 255 - 23


def varint(value: int) -> bytes:
    """Return SQLite's big-endian variable-length integer (0 <= value < 2**56)."""
    if value < 0x80:
        return bytes((value,))
    if value < 0x4000:
        return bytes((value >> 7 | 0x80, value & 0x7F))
    if value < 0x20_0000:
        return bytes((value >> 14 | 0x80, value >> 7 & 0x7F | 0x80, value & 0x7F))
    groups = [value & 0x7F]
    value >>= 7
    while value:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(reversed(groups))


def record(values: tuple[Any, ...]) -> bytes:
    """Return a table row of ``None``, integers and texts."""
    types, body = b"", b""
    for value in values:
        if value is None:
            types += varint(0)
        elif isinstance(value, int):
            types += varint(6)
            body += struct.pack(">q", value)
        else:
            data = str(value).encode()
            types += varint(2 * len(data) + 13)
            body += data
    return varint(len(types) + 1) + types + body  # few columns: headers stay below 127 bytes


class Pages:
    """Numbers and contents of pages that wait for the next commit."""

    def __init__(self) -> None:
        self.count = 1
        self.waiting: dict[int, bytes] = {}

    def new(self) -> int:
        """Allocate a page and return its number."""
        self.count += 1
        return self.count


class Table:
    """A table that only grows, with ascending row ids."""

    def __init__(self, pages: Pages) -> None:
        self._pages = pages
        self._cells: list[bytes] = []
        self._room = _LEAF_ROOM
        self._last_id = 0
        # Per level above the leaves: (page of a finished child, its largest row id).
        self._levels: list[list[tuple[int, int]]] = []
        self._rooms: list[int] = []
        self._places: list[tuple[int, int]] = []
        self._shown = 0
        self._changed = True
        self.root = 0

    def append(self, row_id: int, payload: bytes) -> None:
        """Append a row."""
        size = len(payload)
        cell = varint(size) + varint(row_id) + payload if size <= _LARGEST_LOCAL else self._overflowing(row_id, payload)
        if len(cell) + 2 > self._room:
            page = self._pages.new()
            self._pages.waiting[page] = _leaf(self._cells)
            self._add_child(0, page, self._last_id)
            self._cells = []
            self._room = _LEAF_ROOM
        self._cells.append(cell)
        self._room -= len(cell) + 2
        self._last_id = row_id
        self._changed = True

    def _overflowing(self, row_id: int, payload: bytes) -> bytes:
        size = len(payload)
        local = _SMALLEST_LOCAL + (size - _SMALLEST_LOCAL) % (PAGE - 4)
        if local > _LARGEST_LOCAL:
            local = _SMALLEST_LOCAL
        starts = range(local, size, PAGE - 4)
        numbers = [self._pages.new() for _ in starts]
        for start, number, following in zip(starts, numbers, [*numbers[1:], 0], strict=True):
            part = struct.pack(">I", following) + payload[start : start + PAGE - 4]
            self._pages.waiting[number] = part.ljust(PAGE, b"\0")
        return varint(size) + varint(row_id) + payload[:local] + struct.pack(">I", numbers[0])

    def _add_child(self, level: int, page: int, key: int) -> None:
        if level == len(self._levels):
            self._levels.append([])
            self._rooms.append(_INTERIOR_ROOM)
        needed = 4 + len(varint(key)) + 2
        if needed > self._rooms[level]:
            # A node is finished only when the next child comes, so the last node is never empty.
            *children, (last, last_key) = self._levels[level]
            finished = self._pages.new()
            self._pages.waiting[finished] = _interior(children, last)
            self._levels[level] = []
            self._rooms[level] = _INTERIOR_ROOM
            self._add_child(level + 1, finished, last_key)
        self._levels[level].append((page, key))
        self._rooms[level] -= needed

    def place(self) -> None:
        """Write unfinished pages to the places that the file does not show."""
        if not self._changed:
            return
        while len(self._places) <= len(self._levels):
            self._places.append((self._pages.new(), self._pages.new()))
        hidden = 1 - self._shown
        page = self._places[0][hidden]
        self._pages.waiting[page] = _leaf(self._cells)
        for level, children in enumerate(self._levels, 1):
            below, page = page, self._places[level][hidden]
            self._pages.waiting[page] = _interior(children, below)
        self.root = page

    def confirm(self) -> None:
        """Confirm that the file shows the placed pages; a failed commit reuses the same places."""
        if self._changed:
            self._shown = 1 - self._shown
            self._changed = False

    def unused(self) -> list[int]:
        """Return the places that are free once the placed pages are committed."""
        free = self._shown if self._changed else 1 - self._shown
        return [pair[free] for pair in self._places]


def _leaf(cells: list[bytes]) -> bytes:
    return tree_page(struct.pack(">BHHHB", 0x0D, 0, len(cells), 0, 0), cells, PAGE)


def _interior(children: list[tuple[int, int]], last: int) -> bytes:
    cells = [struct.pack(">I", page) + varint(key) for page, key in children]
    return tree_page(struct.pack(">BHHHBI", 0x05, 0, len(cells), 0, 0, last), cells, PAGE)


def tree_page(head: bytes, cells: list[bytes], size: int) -> bytes:
    """Lay out a b-tree page: head, pointers in order, free space, contents from the end backwards."""
    at = PAGE
    pointers = []
    for cell in cells:
        at -= len(cell)
        pointers.append(at)
    body = head[:5] + struct.pack(">H", at) + head[7:] + struct.pack(f">{len(cells)}H", *pointers)
    contents = b"".join(reversed(cells))
    return body + bytes(size - len(body) - len(contents)) + contents
