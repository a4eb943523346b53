"""Reading rosbag2 databases (SQLite) of all schema versions, also after their writer was killed."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Batch, Bytes, Int64, Stream, joined
from pendulum_rosbag.reader.sqlite_salvage import Row, page_size, salvaged_rows
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata

__all__ = ["SqliteSource"]

_ROWS, _FETCHES = 256, 32
"""Rows fetched at once, few enough for the processor's cache, and fetches per batch."""
_TRIES = 5
_LARGEST_SALVAGE = 64 << 30  # a damaged head may claim any size
# Errors of SQLite and numpy for a wrong file: SQLite's columns hold values of any type.
_UNREADABLE = (sqlite3.Error, BagError, ValueError, TypeError, KeyError, IndexError, OverflowError, OSError)
_IS_MESSAGE = "typeof(data) = 'blob' AND typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer'"
"""The last column first: SQLite then reads the whole head of each row and refuses damaged ones."""


class SqliteSource:
    """One ``.db3`` file.

    A database whose writer died in a transaction has a journal or write-ahead log alongside. It is copied with them to
    a temporary folder, where SQLite restores its last consistent state; the bag stays untouched. ``verify`` reads all
    messages now and salvages the whole ones if one is unreadable.

    Raises:
        BagError: The file cannot be opened or is no rosbag2 database.
    """

    compressed = False
    unchecked = "a database has no checksums"

    def __init__(self, path: Path, *, verify: bool = False) -> None:
        self.path = path
        self.damage = ""
        self.unclosed = False
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._connection: sqlite3.Connection | None = None
        self._salvaged: list[Row] | None = None
        self._last_row = 0
        self._stored: set[int] = set()
        self.start_ns = 0
        self.stop_ns = 0
        if not path.is_file():
            raise BagError(f"{path} cannot be read: there is no such file")
        beside = [path.with_name(path.name + end) for end in ("-journal", "-wal", "-shm")]
        left_over = [file for file in beside if file.is_file() and file.stat().st_size]
        try:
            if left_over:
                self._open_copy(left_over)
            else:
                self._open()
            self.streams = self._read_streams()
            if verify:
                self.connection.execute("SELECT count(substr(data, -1)) FROM messages").fetchone()
        except _UNREADABLE as error:
            self.close()
            if not self._salvage(str(error)):
                self.close()
                raise BagError(f"{path} is not a readable rosbag2 database: {error}") from error

    def close(self) -> None:
        """Close the database and remove the temporary copy, if there is one."""
        self._salvaged = None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._copy is not None:
            self._copy.cleanup()
            self._copy = None

    def extras(self) -> list[Attachment | Metadata]:
        """Return nothing: a rosbag2 database holds only messages."""
        return []

    def keep(self, copy: tempfile.TemporaryDirectory[str]) -> None:
        """Take ownership of the temporary folder that contains the file."""
        self._copy = copy

    @property
    def connection(self) -> sqlite3.Connection:
        """The open database."""
        if self._connection is None:
            raise BagError(f"{self.path} is closed")
        return self._connection

    def _open(self) -> None:
        self._connection = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)

    def _open_copy(self, left_over: list[Path]) -> None:
        if any(file.name.endswith("-journal") for file in left_over):
            self.damage = f"its writer left {', '.join(file.name for file in left_over)} behind"
        else:
            self.unclosed = True  # a write-ahead log loses nothing
        self._copy = tempfile.TemporaryDirectory(prefix="pendulum_rosbag_")
        target = Path(self._copy.name, self.path.name)
        for file in [self.path, *left_over]:
            shutil.copyfile(file, target.with_name(file.name))
        self._connection = sqlite3.connect(target)

    def _salvage(self, reason: str) -> bool:
        """Read what is left of a torn or truncated file: topics by SQL, messages page by page."""
        content = self.path.read_bytes()
        size = page_size(content)
        if not size:
            return False
        there, pages = len(content) // size, int.from_bytes(content[28:32], "big")
        # SQLite refuses a file that is shorter than its head says, so the copy gets empty pages for lost ones.
        missing = max(min(pages, _LARGEST_SALVAGE // size) * size - len(content), -len(content) % size)
        self._copy = tempfile.TemporaryDirectory(prefix="pendulum_rosbag_")
        copy = Path(self._copy.name, self.path.name)
        with copy.open("wb") as file:
            file.write(content)
            file.truncate(len(content) + missing)  # a hole: it takes neither memory nor disk
        try:
            self._connection = sqlite3.connect(copy)
            self._salvaged = list(salvaged_rows(content))
            self.streams = self._read_streams()
        except _UNREADABLE:
            return False
        self.unclosed = False
        self.damage = f"SQLite refuses it ({reason}); {there} pages of {pages or there} are there"
        if there >= pages:
            with contextlib.suppress(sqlite3.Error):
                ((total,),) = self._connection.execute("SELECT count(*) FROM messages")
                self.damage = _left_out(total - len(self._salvaged)) or self.damage
        return True

    def _counts(self) -> dict[int, int]:
        """Return the number of messages by topic id; set the file's time span."""
        counts: dict[int, int] = {}
        if self._salvaged is not None:
            times = [time for _, _, time, _ in self._salvaged]
            self.start_ns, self.stop_ns = min(times, default=0), max(times, default=0)
            for _, topic, _, _ in self._salvaged:
                counts[topic] = counts.get(topic, 0) + 1
            return counts
        run = self.connection.execute
        if any(hidden for *_, hidden in run("PRAGMA table_xinfo(messages)")):
            raise BagError(f"{self.path}: the table of messages computes its columns; expected stored ones")
        self._last_row, total = run("SELECT ifnull(max(rowid), 0), count(*) FROM messages").fetchone()
        for topic, count, first, last in run(
            f"SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages WHERE {_IS_MESSAGE} "  # noqa: S608
            "GROUP BY topic_id"
        ):
            self.start_ns = first if not counts else min(self.start_ns, first)
            self.stop_ns = max(self.stop_ns, last)
            counts[topic] = count
        self.damage = _left_out(total - sum(counts.values())) or self.damage
        self._stored = set(counts)
        return counts

    def _read_streams(self) -> list[Stream]:
        run = self.connection.execute
        tables = {name for (name,) in run("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise BagError(
                f"{self.path} has tables {sorted(tables)}; expected a rosbag2 database with topics, messages"
            )
        columns = [row[1] for row in run("PRAGMA table_info(topics)")]
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            definitions = {
                name: (encoding, text)
                for name, encoding, text in run(
                    "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
                )
            }
        counts = self._counts()
        wanted = ("id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
        present = [column for column in wanted if column in columns]
        streams = []
        for row in run(f"SELECT {', '.join(present)} FROM topics ORDER BY id"):  # noqa: S608 (names from a list of ours)
            item = dict(zip(present, row, strict=True))
            if not isinstance(item["id"], int) or not all(
                isinstance(item[name], str) for name in present if name != "id"
            ):
                raise BagError(f"{self.path}: topic {item.get('name')!r} is described by values that are no text")
            encoding, text = definitions.get(item["type"], ("", ""))
            channel, count = item["id"], counts.get(item["id"], 0)
            type_hash, qos = item.get("type_description_hash", ""), item.get("offered_qos_profiles", "")
            known = (item["name"], item["type"], count, text, encoding, type_hash, qos, item["serialization_format"])
            streams.append(Stream(channel, *known))
        return streams

    def custom_metadata(self) -> str:
        """Return the text of ``metadata.yaml`` in the database (schema 3 and later), or nothing."""
        try:
            row = self.connection.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
        except sqlite3.Error:
            return ""
        return row[0] if row and isinstance(row[0], str) else ""

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield batches as :class:`Source`; a BagError if the file is damaged or written faster than read."""
        if self._salvaged is not None:
            rows = [
                row[1:]
                for row in self._salvaged
                if row[1] in channels and (start is None or row[2] >= start) and (stop is None or row[2] < stop)
            ]
            if rows:
                yield from _batches([_columns(rows)])
            return
        expected = sum(stream.count for stream in self.streams if stream.channel in channels)
        for _ in range(_TRIES):
            try:
                found = self._select(channels, start, stop)
            except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
                raise BagError(f"{self.path} is damaged: {error}; try to repair the bag") from error
            # A running recorder may have moved rows meanwhile.
            if start is not None or stop is not None or sum(len(batch.times) for batch in found) == expected:
                yield from found
                return
            self.connection.close()
            self._open()
        raise BagError(f"{self.path} was written to while it was read; expected {expected} messages")

    def _select(self, channels: set[int], start: int | None, stop: int | None) -> list[Batch]:
        # Counting has tested every row; the test costs half as much as reading, so it is repeated only after damage.
        conditions, values = ["rowid <= ?", *([_IS_MESSAGE] if self.damage else [])], [self._last_row]
        if not self._stored <= channels:
            conditions.append(f"topic_id IN ({', '.join('?' * len(channels))})")
            values += sorted(channels)
        if start is not None or stop is not None:
            # The index over time finds the rows, which are then sorted into file order.
            conditions.append("rowid IN (SELECT rowid FROM messages WHERE timestamp >= ? AND timestamp < ?)")
            values += [-(2**63) if start is None else start, 2**63 - 1 if stop is None else stop]
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE {' AND '.join(conditions)} ORDER BY rowid"  # noqa: S608 (placeholders)
        cursor = self.connection.execute(query, values)
        fetched = iter(lambda: cursor.fetchmany(_ROWS), [])
        found: list[Batch] = []
        while parts := [_columns(rows) for rows in itertools.islice(fetched, _FETCHES)]:
            found += _batches(parts)
        return found


def _left_out(count: int) -> str:
    return f"{count} rows of the table of messages are damaged and left out" if count > 0 else ""


def _columns(rows: Sequence[tuple[int, int, bytes]]) -> tuple[Int64, Int64, Bytes, Int64]:
    """Return topic ids, log times [ns], messages in one buffer and their sizes."""
    topics, times, datas = zip(*rows, strict=True)
    buffer, _, sizes = joined(datas)
    return np.array(topics), np.array(times, np.int64), buffer, sizes


def _batches(parts: Sequence[tuple[Int64, Int64, Bytes, Int64]]) -> Iterator[Batch]:
    topic, time, buffer, sizes = (np.concatenate(column) for column in zip(*parts, strict=True))
    offsets = np.cumsum(sizes) - sizes
    for channel in np.unique(topic):
        mine = topic == channel
        yield Batch(int(channel), buffer, offsets[mine], time[mine], sizes[mine])
