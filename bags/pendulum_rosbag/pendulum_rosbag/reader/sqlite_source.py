"""Reading rosbag2 databases (SQLite), of all schema versions, also those that a killed writer left behind."""

from __future__ import annotations

import mmap
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader.batches import Batch, Bytes, Stream, joined, within
from pendulum_rosbag.reader.sqlite_pages import MessageRows, leaf_pages, message_rows, page_size
from pendulum_rosbag.storage.mcap_records import Attachment, Metadata

__all__ = ["SqliteSource"]

_ROWS = 8192
_LARGEST_SALVAGE = 64 << 30  # a damaged head may claim any size
# What SQLite and numpy say to a file that is not what it claims to be: SQLite's columns hold values of any type.
_UNREADABLE = (sqlite3.Error, BagError, ValueError, TypeError, KeyError, IndexError, OverflowError, OSError)


class SqliteSource:
    """One ``.db3`` file.

    A database whose writer died in a transaction has a journal or a write-ahead log beside it. It is copied with
    them to a temporary folder, where SQLite brings it back to its last consistent state; the bag stays untouched
    and ``damage`` says so.

    Args:
        path: The file.

    Raises:
        BagError: The file cannot be opened or is no rosbag2 database.
    """

    compressed = False
    unclosed = False
    unchecked = "a database has no checksums"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        self._copy: tempfile.TemporaryDirectory[str] | None = None
        self._connection: sqlite3.Connection | None = None
        self._rows: list[MessageRows] | None = None
        self._buffer: Bytes = np.empty(0, np.uint8)
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
                self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
                self._rows = self._read_pages()
            self.streams = self._read_streams()
        except _UNREADABLE as error:
            self.close()
            if not self._salvage(str(error)):
                self.close()
                raise BagError(f"{path} is not a readable rosbag2 database: {error}") from error

    def close(self) -> None:
        """Close the database and remove the temporary copy, if there is one."""
        self._rows = None
        self._buffer = np.empty(0, np.uint8)
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._copy is not None:
            self._copy.cleanup()
            self._copy = None

    def extras(self) -> list[Attachment | Metadata]:
        """Return nothing: a database of rosbag2 has no place for more than messages."""
        return []

    def keep(self, copy: tempfile.TemporaryDirectory[str]) -> None:
        """Take charge of the temporary folder that the file is in."""
        self._copy = copy

    @property
    def connection(self) -> sqlite3.Connection:
        """The open database."""
        if self._connection is None:
            raise BagError(f"{self.path} is closed")
        return self._connection

    def _open_copy(self, left_over: list[Path]) -> None:
        self.damage = f"its writer left {', '.join(file.name for file in left_over)} behind"
        self._copy = tempfile.TemporaryDirectory(prefix="pendulum_rosbag_")
        target = Path(self._copy.name, self.path.name)
        for file in [self.path, *left_over]:
            shutil.copyfile(file, target.with_name(file.name))
        self._connection = sqlite3.connect(target)

    def _salvage(self, reason: str) -> bool:
        """Read what is left of a torn or truncated file: the topics by SQL, the messages page by page."""
        content = self.path.read_bytes()
        size = page_size(np.frombuffer(content, np.uint8))
        if not size:
            return False
        pages = int.from_bytes(content[28:32], "big")
        # SQLite refuses a file that is shorter than its head says, so the copy gets empty pages in place of lost ones.
        missing = max(min(pages, _LARGEST_SALVAGE // size) * size - len(content), -len(content) % size)
        self._copy = tempfile.TemporaryDirectory(prefix="pendulum_rosbag_")
        copy = Path(self._copy.name, self.path.name)
        with copy.open("wb") as file:
            file.write(content)
            file.truncate(len(content) + missing)  # a hole: it takes neither memory nor disk
        self._buffer = np.frombuffer(content, np.uint8)
        starts = np.arange(0, len(content) - size + 1, size)
        kinds = self._buffer[np.where(starts == 0, 100, starts)]
        blocks = list(message_rows(self._buffer, size, starts[kinds == 0x0D]))
        try:
            self._connection = sqlite3.connect(copy)
            self._rows = _first_of_each(blocks)
            self.streams = self._read_streams()
        except _UNREADABLE:
            return False
        self.damage = f"SQLite refuses it ({reason}); {len(kinds)} pages of {pages or len(kinds)} are there"
        return True

    def _read_pages(self) -> list[MessageRows] | None:
        """Read the table of messages from its pages; ``None`` when only SQL can read this file."""
        run = self.connection.execute
        if any(hidden for *_, hidden in run("PRAGMA table_xinfo(messages)")):
            raise BagError(f"{self.path}: the table of messages computes its columns; expected stored ones")
        columns = [(name, key) for _, name, _, _, _, key in run("PRAGMA table_info(messages)")]
        if columns != [("id", 1), ("topic_id", 0), ("timestamp", 0), ("data", 0)]:
            return None
        with self.path.open("rb") as file:
            self._buffer = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8)
        size = page_size(self._buffer)
        ((root,),) = run("SELECT rootpage FROM sqlite_master WHERE type = 'table' AND name = 'messages'")
        leaves = leaf_pages(self._buffer, size, root) if size else None
        if leaves is None:
            return None
        blocks = list(message_rows(self._buffer, size, leaves))
        if left_out := sum(block.left_out for block in blocks):
            self.damage = f"{left_out} rows of the table of messages are damaged and left out"
        return blocks

    def _counts(self) -> dict[int, int]:
        """Return the number of messages by topic id, and note the time span of the file."""
        counts: dict[int, int] = {}
        if self._rows is not None:
            filled = [block for block in self._rows if len(block.times)]
            self.start_ns = min((int(block.times.min()) for block in filled), default=0)
            self.stop_ns = max((int(block.times.max()) for block in filled), default=0)
            for block in filled:
                for topic, count in zip(*np.unique(block.topics, return_counts=True), strict=True):
                    counts[int(topic)] = counts.get(int(topic), 0) + int(count)
            return counts
        for topic, count, first, last in self.connection.execute(
            "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        ):
            self.start_ns = first if not counts else min(self.start_ns, first)
            self.stop_ns = max(self.stop_ns, last)
            counts[topic] = count
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
        wanted = (
            "id",
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        )
        present = [column for column in wanted if column in columns]
        streams = []
        for row in run(f"SELECT {', '.join(present)} FROM topics ORDER BY id"):  # noqa: S608 (names from a list of ours)
            item = dict(zip(present, row, strict=True))
            if not isinstance(item["id"], int) or not all(
                isinstance(item[name], str) for name in present if name != "id"
            ):
                raise BagError(f"{self.path}: topic {item.get('name')!r} is described by values that are no text")
            encoding, text = definitions.get(item["type"], ("", ""))
            streams.append(
                Stream(
                    item["id"],
                    item["name"],
                    item["type"],
                    counts.get(item["id"], 0),
                    text,
                    encoding,
                    item.get("type_description_hash", ""),
                    item.get("offered_qos_profiles", ""),
                    item["serialization_format"],
                )
            )
        return streams

    def custom_metadata(self) -> str:
        """Return the text of ``metadata.yaml`` that the database holds (schema 3 and later), or nothing."""
        try:
            row = self.connection.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
        except sqlite3.Error:
            return ""
        return row[0] if row and isinstance(row[0], str) else ""

    def batches(self, channels: set[int], start: int | None, stop: int | None) -> Iterator[Batch]:
        """Yield all messages of some topics with start <= log time < stop, in the order of the file."""
        if self._rows is not None:
            for block in self._rows:
                inside = within(block.times, start, stop)
                for channel in channels:
                    wanted = (block.topics == channel) & inside
                    mine = np.flatnonzero(wanted & block.local)
                    if len(mine):
                        yield Batch(channel, self._buffer, block.offsets[mine], block.times[mine], block.sizes[mine])
                    # Large messages go on elsewhere in the file: SQLite puts them together.
                    for row_id in block.row_ids[wanted & ~block.local].tolist():
                        query = "SELECT topic_id, timestamp, data FROM messages WHERE id = ?"
                        try:
                            yield from _batches(self.connection.execute(query, (row_id,)).fetchall())
                        except (sqlite3.Error, ValueError, TypeError) as error:
                            raise BagError(f"{self.path}: message {row_id} is damaged: {error}") from error
            return
        conditions, values = [], []
        if channels != {stream.channel for stream in self.streams}:
            conditions.append(f"topic_id IN ({', '.join('?' * len(channels))})")
            values += sorted(channels)
        if start is not None:
            conditions.append("timestamp >= ?")
            values.append(start)
        if stop is not None:
            conditions.append("timestamp < ?")
            values.append(stop)
        where = f" WHERE {' AND '.join(conditions)}" if conditions else ""
        try:
            cursor = self.connection.execute(f"SELECT topic_id, timestamp, data FROM messages{where}", values)  # noqa: S608 (placeholders)
            while rows := cursor.fetchmany(_ROWS):
                yield from _batches(rows)
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            raise BagError(f"{self.path} is damaged: {error}; try to repair the bag") from error


def _first_of_each(blocks: list[MessageRows]) -> list[MessageRows]:
    """Drop rows that stand on several pages (a writer that moves rows leaves copies behind)."""
    seen: set[int] = set()
    kept = []
    for block in blocks:
        fresh = np.array([row not in seen for row in block.row_ids.tolist()], bool)
        _, first = np.unique(block.row_ids, return_index=True)
        once = np.zeros(len(fresh), bool)
        once[first] = True
        # Messages that continue on other pages need SQL, which cannot be asked here.
        keep = fresh & once & block.local
        seen.update(block.row_ids[keep].tolist())
        columns = (block.row_ids, block.topics, block.times, block.offsets, block.sizes, block.local)
        kept.append(MessageRows(*(column[keep] for column in columns)))
    return kept


def _batches(rows: list[tuple[int, int, bytes]]) -> Iterator[Batch]:
    topics, times, datas = zip(*rows, strict=True)
    buffer, offsets, sizes = joined(datas)
    topic = np.array(topics)
    time = np.array(times, np.int64)
    for channel in np.unique(topic):
        mine = topic == channel
        yield Batch(int(channel), buffer, offsets[mine], time[mine], sizes[mine])
