"""A rosbag2 database (SQLite) that is complete at every instant, also while it is being written.

SQLite itself makes a commit safe with a journal beside the file, and rosbag2 readers that open the file as immutable
pass over journals: a killed writer leaves them a database that is empty or torn. A recording only ever appends, and
for that the file format allows something better. Full pages of a table are written once and never again. What is not
full yet (the last leaf and its ancestors up to the root, one page each) has two places that take turns, so that a
commit never touches a page that the file shows. The commit itself is the write of page 1, which names the roots of all
tables and the size of the file: one page, which the kernel copies as a whole. A process that is killed between any two
instructions leaves the state before or after.

File format: https://www.sqlite.org/fileformat2.html (sections 1.3 header, 1.5 freelist, 1.6 b-tree pages, 2.1 records).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.storage.mcap_extras import Attachment, Metadata
from pendulum_rosbag.storage.message_types import MessageType

__all__ = ["SealedSqliteFile"]

PAGE = 4096
_LEAF_ROOM = PAGE - 8
_INTERIOR_ROOM = PAGE - 12
_LARGEST_LOCAL = PAGE - 35
_SMALLEST_LOCAL = (PAGE - 12) * 32 // 255 - 23
_SQLITE_VERSION = 3_045_001

_TABLES = {
    "schema": "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
    "metadata": "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, "
    "metadata TEXT NOT NULL)",
    "topics": "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
    "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL)",
    "message_definitions": "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, "
    "encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL)",
    "messages": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
    "data BLOB NOT NULL)",
}
_SCHEMA_VERSION = 4
_INDEX = "CREATE INDEX timestamp_idx ON messages (timestamp ASC)"


def _varint(value: int) -> bytes:
    """Return a big-endian variable-length integer as SQLite writes it (0 <= value < 2**56)."""
    if value < 0x80:
        return bytes((value,))
    groups = [value & 0x7F]
    value >>= 7
    while value:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(reversed(groups))


def _record(values: tuple[Any, ...]) -> bytes:
    """Return a table row: ``None``, integers and texts."""
    types, body = b"", b""
    for value in values:
        if value is None:
            types += _varint(0)
        elif isinstance(value, int):
            types += _varint(6)
            body += struct.pack(">q", value)
        else:
            data = str(value).encode()
            types += _varint(2 * len(data) + 13)
            body += data
    return _varint(len(types) + 1) + types + body  # (headers stay below 127 bytes: few columns)


class _Pages:
    """Numbers and contents of pages that wait for the next commit."""

    def __init__(self) -> None:
        self.count = 1
        self.waiting: dict[int, bytes] = {}

    def new(self) -> int:
        self.count += 1
        return self.count


class _Table:
    """A table that only grows, with ascending row ids."""

    def __init__(self, pages: _Pages) -> None:
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
        """Add a row behind all others."""
        size = len(payload)
        if size <= _LARGEST_LOCAL:
            cell = _varint(size) + _varint(row_id) + payload
        else:
            cell = self._overflowing(row_id, payload)
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
        return _varint(size) + _varint(row_id) + payload[:local] + struct.pack(">I", numbers[0])

    def _add_child(self, level: int, page: int, key: int) -> None:
        if level == len(self._levels):
            self._levels.append([])
            self._rooms.append(_INTERIOR_ROOM)
        needed = 4 + len(_varint(key)) + 2
        if needed > self._rooms[level]:
            # A node is finished only when the next child comes, so that the last one is never empty.
            *children, (last, last_key) = self._levels[level]
            finished = self._pages.new()
            self._pages.waiting[finished] = _interior(children, last)
            self._levels[level] = []
            self._rooms[level] = _INTERIOR_ROOM
            self._add_child(level + 1, finished, last_key)
        self._levels[level].append((page, key))
        self._rooms[level] -= needed

    def place(self) -> None:
        """Lay out the pages that are not full yet in the places that the file does not show."""
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
        """Take note that the file shows what was placed; a commit that failed is tried in the same places."""
        if self._changed:
            self._shown = 1 - self._shown
            self._changed = False

    def unused(self) -> list[int]:
        """Return the places that the file will not show once what was placed is committed."""
        free = self._shown if self._changed else 1 - self._shown
        return [pair[free] for pair in self._places]


def _leaf(cells: list[bytes]) -> bytes:
    return _page(struct.pack(">BHHHB", 0x0D, 0, len(cells), 0, 0), cells, PAGE)


def _interior(children: list[tuple[int, int]], last: int) -> bytes:
    cells = [struct.pack(">I", page) + _varint(key) for page, key in children]
    return _page(struct.pack(">BHHHBI", 0x05, 0, len(cells), 0, 0, last), cells, PAGE)


def _page(head: bytes, cells: list[bytes], size: int) -> bytes:
    """Lay out a b-tree page: head, pointers in order, free space, contents from the end backwards."""
    at = PAGE
    pointers = []
    for cell in cells:
        at -= len(cell)
        pointers.append(at)
    body = head[:5] + struct.pack(">H", at) + head[7:] + struct.pack(f">{len(cells)}H", *pointers)
    contents = b"".join(reversed(cells))
    return body + bytes(size - len(body) - len(contents)) + contents


class SealedSqliteFile:
    """Append messages to a new rosbag2 database; after each ``seal`` they are in the file for every reader.

    Args:
        path: File to create.

    Raises:
        BagError: The file exists, or cannot be written.
    """

    suffix = ".db3"

    def __init__(self, path: Path, *, ros_distro: str = "jazzy") -> None:
        if path.exists():
            raise BagError(f"{path} exists already; expected a new file")
        self.path = path
        self.count = 0
        self.start_ns = 0
        self.stop_ns = 0
        self._pending = 0
        self._pending_size = 0
        self._pending_span = (2**63 - 1, 0)
        self._commits = 0
        self._pages = _Pages()
        self._tables = {name: _Table(self._pages) for name in _TABLES}
        self._trunks = (self._pages.new(), self._pages.new())
        self._definitions: set[tuple[str, str]] = set()
        self._heads: dict[tuple[int, int], bytes] = {}
        self._stale = True
        self._tables["schema"].append(_SCHEMA_VERSION, _record((None, ros_distro)))
        temporary = path.with_name(f".{path.name}.tmp")
        self._fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            self._commit()
            os.rename(temporary, path)
        except OSError:
            self.abandon()
            temporary.unlink(missing_ok=True)
            raise

    @property
    def data_size(self) -> int:
        """Bytes of data so far, sealed or not."""
        return self._pages.count * PAGE

    @property
    def pending_size(self) -> int:
        """Bytes of messages that are not sealed yet."""
        return self._pending_size

    def add_channel(self, channel_id: int, topic: str, type: MessageType, qos: str) -> None:
        """Describe a topic before its first message (ids ascending from 1; QoS profiles as YAML text)."""
        self._tables["topics"].append(channel_id, _record((None, topic, type.name, type.serialization, qos, type.hash)))
        key = (type.name, type.hash)
        if key not in self._definitions:
            self._definitions.add(key)
            row = (None, type.name, type.encoding, type.definition, type.hash)
            self._tables["message_definitions"].append(len(self._definitions), _record(row))
        self._stale = True

    def write(self, channel_id: int, log_time_ns: int, data: bytes) -> None:
        """Add one message."""
        size = len(data)
        head = self._heads.get((channel_id, size))
        if head is None:
            # Columns: id (NULL, it is the row id), topic_id (32 bit), timestamp (64 bit), data (blob).
            types = b"\x00\x04\x06" + _varint(2 * size + 12)
            head = bytes((len(types) + 1,)) + types + struct.pack(">i", channel_id)
            if len(self._heads) < 4096:
                self._heads[channel_id, size] = head
        self._pending += 1
        row_id = self.count + self._pending
        self._tables["messages"].append(row_id, head + log_time_ns.to_bytes(8, "big", signed=True) + data)
        self._pending_size += size
        start, stop = self._pending_span
        if log_time_ns < start or log_time_ns > stop:
            self._pending_span = (min(start, log_time_ns), max(stop, log_time_ns))

    def seal(self) -> None:
        """Make everything that was written visible to readers of the file.

        Raises:
            OSError: The disk is full or fails. The file still shows what was sealed before.
        """
        if not (self._pending or self._stale):
            return
        self._commit()
        self._stale = False
        if self._pending:
            first, last = self._pending_span
            self.start_ns = first if not self.count else min(self.start_ns, first)
            self.stop_ns = max(self.stop_ns, last)
            self.count += self._pending
            self._pending = self._pending_size = 0
            self._pending_span = (2**63 - 1, 0)

    def settle(self) -> None:
        """Seal; there is nothing that would be written a second time."""
        self.seal()

    def duplicate(self) -> int:
        """Return a file descriptor of its own, to wait for the disk with, which the caller closes."""
        return os.dup(self._fd)

    def keep(self, record: Attachment | Metadata) -> None:
        """Refuse what has no place in a database.

        Raises:
            BagError: Always.
        """
        raise BagError(f"storage sqlite3 has no place for {record.name!r}; expected storage mcap for attachments")

    def close(self, metadata: str = "") -> None:
        """Seal, add the index over time that rosbag2 seeks by, and close.

        Args:
            metadata: Text of ``metadata.yaml``, stored as rosbag2 does for files without their folder.
        """
        if self._fd < 0:
            return
        try:
            if metadata:
                self._tables["metadata"].append(1, _record((None, 9, metadata)))
                self._stale = True
            self.seal()
            os.fsync(self._fd)
            self._add_index()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close without writing anything more: the file shows what was sealed."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    # -- parts -------------------------------------------------------------------------------------------------

    def _commit(self) -> None:
        pages = self._pages
        tables = self._tables.values()
        for table in tables:
            table.place()
        hidden = 1 - self._commits % 2
        free = [self._trunks[1 - hidden], *(page for table in tables for page in table.unused())]
        trunk = struct.pack(f">{len(free) + 2}I", 0, len(free), *free)
        pages.waiting[self._trunks[hidden]] = trunk.ljust(PAGE, b"\0")
        self._write_runs()
        if os.fstat(self._fd).st_size < pages.count * PAGE:
            os.ftruncate(self._fd, pages.count * PAGE)  # places that were not used yet belong to the file, too
        self._write(self._first_page(self._trunks[hidden], len(free) + 1), 0)
        self._commits += 1
        for table in tables:
            table.confirm()

    def _write_runs(self) -> None:
        """Write the waiting pages, neighbours together; they stay waiting if that fails."""
        waiting = self._pages.waiting
        run: list[bytes] = []
        start = 0
        for number in sorted(waiting):
            if run and number != start + len(run):
                self._write(b"".join(run), (start - 1) * PAGE)
                run = []
            if not run:
                start = number
            run.append(waiting[number])
        if run:
            self._write(b"".join(run), (start - 1) * PAGE)
        waiting.clear()

    def _first_page(self, trunk: int, free: int) -> bytes:
        header = b"SQLite format 3\0" + struct.pack(
            ">HBBBBBBIIIIIIIIIIII20xII",
            PAGE,
            1,
            1,
            0,
            64,
            32,
            32,
            self._commits + 1,
            self._pages.count,
            trunk,
            free,
            1,  # schema cookie
            4,  # schema format
            0,
            0,
            1,  # UTF-8
            0,
            0,
            0,
            self._commits + 1,
            _SQLITE_VERSION,
        )
        cells = []
        for number, (name, sql) in enumerate(_TABLES.items(), 1):
            payload = _record(("table", name, name, self._tables[name].root, sql))
            cells.append(_varint(len(payload)) + _varint(number) + payload)
        return header + _page(struct.pack(">BHHHB", 0x0D, 0, len(cells), 0, 0), cells, PAGE - len(header))

    def _write(self, data: bytes, offset: int) -> None:
        view = memoryview(data)
        while view:
            done = os.pwrite(self._fd, view, offset)
            view = view[done:]
            offset += done

    def _add_index(self) -> None:
        """Build the index in a copy and put that in place of the file, in one step; without room for it, do not."""
        copy = self.path.with_name(f".{self.path.name}.tmp")
        try:
            shutil.copyfile(self.path, copy)
            connection = sqlite3.connect(copy)
            try:
                # The copy is worth nothing until it is whole: no journal, no waiting for the disk.
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("PRAGMA synchronous = OFF")
                connection.execute(_INDEX)
                connection.commit()
            finally:
                connection.close()
            with copy.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(copy, self.path)
        except (OSError, sqlite3.OperationalError):
            # No room for the copy. The bag is whole without it; only seeking in a long one is slower.
            copy.unlink(missing_ok=True)
