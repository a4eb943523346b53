"""A rosbag2 database (SQLite) that is complete at every instant while it is written.

SQLite makes commits safe with a journal, which rosbag2 readers that open the file as immutable ignore: a killed writer
leaves them an empty or torn database. Here full table pages are written once. The unfinished pages (last leaf and its
ancestors) each have two alternating places, so a commit never touches a visible page. Page 1, which names the roots and
the file's size, is the commit; the kernel copies one page as a whole.

File format: https://www.sqlite.org/fileformat2.html (sections 1.3 header, 1.5 freelist, 1.6 b-tree pages, 2.1 records).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata
from pendulum_rosbag.storage.message_types import MessageType
from pendulum_rosbag.storage.sqlite_pages import PAGE, Pages, Table, record, tree_page, varint
from pendulum_rosbag.storage.storage_file import write_at

__all__ = ["SealedSqliteFile"]

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
_EMPTY_PAGES = 20
_INDEX = "CREATE INDEX timestamp_idx ON messages (timestamp ASC)"


class SealedSqliteFile:
    """Append messages to a new rosbag2 database; after ``seal`` every reader sees them.

    A BagError if the file exists; an OSError, in all methods, if the disk fails: the flushed messages remain.
    """

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
        self._pages = Pages()
        self._tables = {name: Table(self._pages) for name in _TABLES}
        self._trunks = (self._pages.new(), self._pages.new())
        self._definitions: set[tuple[str, str]] = set()
        self._heads: dict[tuple[int, int], bytes] = {}
        self._stale = True
        self._tables["schema"].append(_SCHEMA_VERSION, record((None, ros_distro)))
        temporary = path.with_name(f".{path.name}.tmp")
        self._fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            self._commit()
            os.rename(temporary, path)
        except OSError:
            self.abandon()
            temporary.unlink(missing_ok=True)
            raise

    def size_with(self, size: int, *, empty: bool = False) -> int:
        """Return a bound of the closed file's size [bytes] with one more message of ``size``, less metadata."""
        if empty:
            return _EMPTY_PAGES * PAGE
        rows, last = self.count + self._pending + 1, max(self.stop_ns, self._pending_span[1])
        # Index row over time: sizes, time and row id. The message takes at worst a page of its own and two above it.
        entry = 9 + last.bit_length() // 8 + rows.bit_length() // 8
        return (self._pages.count + rows * entry // (PAGE - 64) + size // (PAGE - 4) + 6) * PAGE

    def add_channel(self, channel_id: int, topic: str, type: MessageType, qos: str) -> None:
        """Describe a topic before its first message (ids ascending from 1; QoS profiles as YAML text)."""
        self._tables["topics"].append(channel_id, record((None, topic, type.name, type.serialization, qos, type.hash)))
        key = (type.name, type.hash)
        if key not in self._definitions:
            self._definitions.add(key)
            row = (None, type.name, type.encoding, type.definition, type.hash)
            self._tables["message_definitions"].append(len(self._definitions), record(row))
        self._stale = True

    def write_many(
        self, messages: Iterator[tuple[str, int, bytes]], channels: Mapping[str, int], counts: dict[str, int], most: int
    ) -> bool:
        """Add messages (topic, log time [ns], CDR) until ``most`` bytes wait; return whether they do.

        Counts them in ``counts``; the rest stays in the iterator. Raises BagError at a topic without id.
        """
        heads, append = self._heads, self._tables["messages"].append
        waiting, (start, stop) = self._pending_size, self._pending_span
        try:
            for topic, log_time_ns, data in messages:
                key = channels[topic], len(data)
                stamp = log_time_ns.to_bytes(8, "big", signed=True)
                append(self.count + self._pending + 1, (heads.get(key) or self._head(*key)) + stamp + data)
                self._pending += 1
                waiting += key[1]
                if log_time_ns < start:  # noqa: PLR1730  # to call min takes longer
                    start = log_time_ns
                if log_time_ns > stop:  # noqa: PLR1730
                    stop = log_time_ns
                counts[topic] += 1
                if waiting >= most:
                    return True
            return False
        finally:
            self._pending_size, self._pending_span = waiting, (start, stop)

    def _head(self, channel_id: int, size: int) -> bytes:
        # Columns: id (NULL, it is the row id), topic_id (32 bit), timestamp (64 bit), data (blob).
        types = b"\x00\x04\x06" + varint(2 * size + 12)
        head = bytes((len(types) + 1,)) + types + struct.pack(">i", channel_id)
        if len(self._heads) < 4096:
            self._heads[channel_id, size] = head
        return head

    def seal(self) -> None:
        """Write everything so far to the file."""
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
        """Seal; a database rewrites nothing."""
        self.seal()

    def duplicate(self) -> int:
        """Return a duplicate descriptor for waiting for the disk; the caller closes it."""
        return os.dup(self._fd)

    def keep(self, record: Attachment | Metadata) -> None:
        """Raise BagError: a database has no place for attachments."""
        raise BagError(f"storage sqlite3 has no place for {record.name!r}; expected storage mcap for attachments")

    def close(self, metadata: str = "") -> None:
        """Seal, add rosbag2's index over time and the text of ``metadata.yaml``, and close."""
        if self._fd < 0:
            return
        try:
            if metadata:
                self._tables["metadata"].append(1, record((None, 9, metadata)))
                self._stale = True
            self.seal()
            os.fsync(self._fd)
            self._add_index()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close without writing; the sealed content remains."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

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
            os.ftruncate(self._fd, pages.count * PAGE)  # the file includes places that are not used yet
        write_at(self._fd, self._first_page(self._trunks[hidden], len(free) + 1), 0)
        self._commits += 1
        for table in tables:
            table.confirm()

    def _write_runs(self) -> None:
        waiting = self._pages.waiting
        run: list[bytes] = []
        start = 0
        for number in sorted(waiting):
            if run and number != start + len(run):
                write_at(self._fd, b"".join(run), (start - 1) * PAGE)
                run = []
            if not run:
                start = number
            run.append(waiting[number])
        if run:
            write_at(self._fd, b"".join(run), (start - 1) * PAGE)
        waiting.clear()

    def _first_page(self, trunk: int, free: int) -> bytes:
        commit, tree = self._commits + 1, self._pages.count
        header = b"SQLite format 3\0" + struct.pack(">H6B4I", PAGE, 1, 1, 0, 64, 32, 32, commit, tree, trunk, free)
        schema_cookie, schema_format, utf8 = 1, 4, 1
        header += struct.pack(">8I", schema_cookie, schema_format, 0, 0, utf8, 0, 0, 0)
        header += struct.pack(">20x2I", commit, _SQLITE_VERSION)
        cells = []
        for number, (name, sql) in enumerate(_TABLES.items(), 1):
            payload = record(("table", name, name, self._tables[name].root, sql))
            cells.append(varint(len(payload)) + varint(number) + payload)
        return header + tree_page(struct.pack(">BHHHB", 0x0D, 0, len(cells), 0, 0), cells, PAGE - len(header))

    def _add_index(self) -> None:
        """Replace the file by a copy with an index, in one step; skip it if there is no space."""
        copy = self.path.with_name(f".{self.path.name}.tmp")
        try:
            shutil.copyfile(self.path, copy)
            connection = sqlite3.connect(copy)
            try:
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
            copy.unlink(missing_ok=True)
