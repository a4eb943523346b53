"""Copy messages of one or several bags to a new one, in order of log time."""

from __future__ import annotations

import itertools
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_rosbag.reader.batches import Source
from pendulum_rosbag.reader.clock import ClockStep, find_steps
from pendulum_rosbag.reader.open_source import BagFolder, damage_of, is_ros1, open_folder, open_sources
from pendulum_rosbag.reader.topic_info import ros_topic
from pendulum_rosbag.repair.repair import message_type_of
from pendulum_rosbag.storage.bag_writer import BagWriter
from pendulum_rosbag.storage.message_types import MessageType
from pendulum_rosbag.storage.qos import profiles_of

__all__ = ["Choice", "RewriteReport", "rewrite"]

_WINDOW_BYTES = 64 << 20
"""Bytes of storage files that are sorted at once (decompressed perhaps five times as much)."""


@dataclass(frozen=True)
class Choice:
    """Which messages to copy.

    Args:
        topics: Full names; if this and ``regex`` are empty, all topics.
        regex: Pattern that a topic may match instead of being listed.
        exclude: Pattern of topics to leave out.
        start_ns: First log time [ns]; ``None`` for the beginning.
        stop_ns: End of the log times, exclusive [ns]; ``None`` for the end.

    Raises:
        ParameterError: A pattern is invalid, or the span is empty.
    """

    topics: tuple[str, ...] = ()
    regex: str = ""
    exclude: str = ""
    start_ns: int | None = None
    stop_ns: int | None = None

    def __post_init__(self) -> None:
        for name, pattern in (("regex", self.regex), ("exclude", self.exclude)):
            try:
                re.compile(pattern)
            except re.error as error:
                raise ParameterError(f"{name} is {pattern!r}; expected a regular expression ({error})") from None
        if self.start_ns is not None and self.stop_ns is not None and self.start_ns >= self.stop_ns:
            length = (self.stop_ns - self.start_ns) * 1e-9
            raise ParameterError(f"the span from start to stop is {length:g} s long; expected more than 0 s")

    def holds(self, time_ns: int) -> bool:
        """Return whether a log time [ns] is in the span."""
        return (self.start_ns is None or time_ns >= self.start_ns) and (self.stop_ns is None or time_ns < self.stop_ns)

    def wants(self, topic: str) -> bool:
        """Return whether a topic is to be copied."""
        full = ros_topic(topic)
        if self.exclude and (re.search(self.exclude, topic) or re.search(self.exclude, full)):
            return False
        if self.topics or self.regex:
            chosen = topic in self.topics or full in self.topics
            return chosen or bool(self.regex and (re.search(self.regex, topic) or re.search(self.regex, full)))
        return True


@dataclass(slots=True)
class RewriteReport:
    """What was copied to ``path``: messages per topic, damage found, and what was left out, in sentences."""

    path: Path
    messages: dict[str, int] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def sentence(self) -> str:
        """Return the report in one sentence."""
        text = f"wrote {sum(self.messages.values())} messages of {len(self.messages)} topics to {self.path}"
        return text + (f"; LEFT OUT: {'; '.join(self.left_out)}" if self.left_out else "")


@dataclass(frozen=True)
class _Input:
    path: Path
    folder: BagFolder
    sources: Sequence[Source]


def rewrite(
    paths: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    choice: Choice | None = None,
    *,
    storage: str = "",
    compression: str | None = "",
    max_size: int = 0,
    max_duration: float = 0.0,
    on_progress: Callable[[float], None] = lambda share: None,
) -> RewriteReport:
    """Copy messages with topics, QoS, types, metadata and attachments to a new bag, ordered by log time.

    Args:
        paths: Bags: rosbag2 folders, ``.mcap`` and ``.db3`` files, ROS 1 ``.bag`` files.
        output: Folder of the new bag; it must not exist.
        choice: Which messages; by default all.
        storage: ``mcap`` or ``sqlite3``; empty for that of the first bag.
        compression: ``None``, ``zstd``, or empty for that of the bags.
        max_size: Largest storage file [bytes]; 0 for no limit.
        max_duration: Longest time span of a storage file [s]; 0 for no limit.
        on_progress: Called with the finished share, 0 to 1.

    Raises:
        BagError: A bag cannot be read or written, or a topic has different types in two bags.
        DataError: A named topic is in none of them, or no message is left.
        ParameterError: Unknown storage or compression, or a bag is named twice.
    """
    choice = choice or Choice()
    places = [Path(path).resolve() for path in paths]
    if twice := next((path for number, path in enumerate(places) if path in places[:number]), None):
        raise ParameterError(f"bag {twice} is named twice; expected each bag once")
    with ExitStack() as stack:
        inputs = [_open(Path(path), stack) for path in paths]
        storage = storage or inputs[0].folder.storage or "mcap"
        if compression == "":
            packed = any(source.compressed for one in inputs for source in one.sources)
            compression = "zstd" if packed and storage == "mcap" else None
        _require_topics(inputs, choice)
        report = RewriteReport(Path(output))
        for one in inputs:
            report.damage += [f"{one.path}: {sentence}" for sentence in damage_of(one.folder, one.sources)]
        metadata = _metadata(inputs, choice)
        writer = BagWriter(output, storage, compression, metadata, max_size=max_size, max_duration=max_duration)
        try:
            with writer:
                _copy(inputs, choice, writer, report, on_progress)
            if not sum(writer.written.values()):
                raise DataError(f"{', '.join(map(str, paths))}: no message is among what was chosen; expected some")
        except BaseException:
            shutil.rmtree(output, ignore_errors=True)
            raise
        report.messages = writer.written
    return report


def _open(path: Path, stack: ExitStack) -> _Input:
    place = path
    if is_ros1(path):
        place = _from_ros1(path, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pendulum_rosbag_"))))
    folder = open_folder(place)
    sources = open_sources(folder, verify=True)
    for source in sources:
        stack.callback(source.close)
    # `.` and `..` are no names for a bag.
    return _Input(path.resolve() if path.name in {"", ".."} else path, folder, sources)


def _from_ros1(path: Path, scratch: Path) -> Path:
    from rosbags.convert import ConverterError, convert

    target = scratch / path.stem
    try:
        convert([path], target, "mcap", 9, None, "none", None, None, (), (), (), ())
    except ConverterError as error:
        hint = (
            f"; was its recorder killed? `rosbag reindex {path}` (of ROS 1) makes its index" if _no_index(path) else ""
        )
        raise BagError(f"ROS 1 bag {path} cannot be converted: {error}{hint}") from error
    return target


def _no_index(path: Path) -> bool:
    """Return whether a ROS 1 bag has no index: its first record gives the place, 0 until the bag is closed."""
    head = path.read_bytes()[:4096]
    at = head.find(b"index_pos=")
    return (
        at < 0
        or not any(head[at + 10 : at + 18])
        or int.from_bytes(head[at + 10 : at + 18], "little") >= path.stat().st_size
    )


def _require_topics(inputs: Sequence[_Input], choice: Choice) -> None:
    found = {stream.topic for one in inputs for source in one.sources for stream in source.streams}
    offered = found | {ros_topic(topic) for topic in found}
    missing = [topic for topic in choice.topics if topic not in offered]
    if missing:
        bags = ", ".join(str(one.path) for one in inputs)
        raise DataError(f"{bags}: no topic {missing[0]}; expected one of {', '.join(sorted(found)) or 'none'}")


def _metadata(inputs: Sequence[_Input], choice: Choice) -> dict[str, Any]:
    """Return the run metadata: entries on which all bags agree, and for several bags each one's whole by its name."""
    span = {name: value for name, value in (("start_ns", choice.start_ns), ("stop_ns", choice.stop_ns)) if value}
    origin = {"pendulum.origin": [{"bag": str(one.path), **span} for one in inputs]}
    first, *others = (one.folder.custom_data for one in inputs)
    if not others:
        return {**first, **origin}
    agreed = {key: value for key, value in first.items() if all(other.get(key) == value for other in others)}
    names = [one.path.name for one in inputs]
    if len(set(names)) < len(names):
        names = [str(one.path) for one in inputs]
    merged = {name: one.folder.metadata for name, one in zip(names, inputs, strict=True)}
    return {**agreed, "pendulum.merged": merged, **origin}


def _copy(
    inputs: Sequence[_Input],
    choice: Choice,
    writer: BagWriter,
    report: RewriteReport,
    on_progress: Callable[[float], None],
) -> None:
    chosen: list[tuple[Source, dict[int, str]]] = []
    for one in inputs:
        for source in one.sources:
            streams = [stream for stream in source.streams if choice.wants(stream.topic)]
            for stream in streams:
                kind = _storable(message_type_of(stream, one.folder.topic_hashes.get(stream.topic, "")), writer)
                try:
                    writer.add_topic(stream.topic, kind, profiles_of(stream.qos))
                except BagError as error:
                    raise BagError(f"{one.path}: {error}; leave one of them out, or rename it") from error
            chosen.append((source, {stream.channel: stream.topic for stream in streams}))
            _keep_extras(source, writer, report)
    wanted = [(source, topics) for source, topics in chosen if topics]
    steps = {id(one): _clock_steps(one, wanted) for one in inputs}
    if any(steps.values()):
        _copy_passes(inputs, wanted, choice, steps, writer)
        return
    windows = list(_windows([source for source, _ in chosen], choice))
    for number, (start, stop) in enumerate(windows, start=1):
        rows: list[tuple[int, str, bytes]] = []
        for source, topics in wanted:
            for batch in source.batches(set(topics), start, stop):
                topic = topics[batch.channel]
                rows += [(time, topic, data) for time, data in batch.payloads()]
        rows.sort(key=lambda row: row[0])  # stable: equal times stay in the order of writing
        writer.write_many((topic, time, data) for time, topic, data in rows)
        on_progress(number / len(windows))


def _clock_steps(one: _Input, wanted: Sequence[tuple[Source, dict[int, str]]]) -> list[ClockStep]:
    return find_steps([pair for pair in wanted if pair[0] in one.sources], (None, None))


def _copy_passes(
    inputs: Sequence[_Input],
    wanted: Sequence[tuple[Source, dict[int, str]]],
    choice: Choice,
    steps: Mapping[int, Sequence[ClockStep]],
    writer: BagWriter,
) -> None:
    """Copy bags whose clock stepped back, in order of log time as if it had continued."""
    rows: list[tuple[int, int, str, bytes]] = []
    for one in inputs:
        seen: dict[str, int] = {}
        for source, topics in wanted:
            for batch in source.batches(set(topics), None, None) if source in one.sources else ():
                topic = topics[batch.channel]
                for time, data in batch.payloads():
                    place = seen[topic] = seen.get(topic, 0) + 1
                    moved = time + sum(step.size_ns for step in steps[id(one)] if place > step.rows.get(topic, place))
                    if choice.holds(time):
                        rows.append((moved, time, topic, data))
    rows.sort(key=lambda row: row[0])
    writer.write_many((topic, time, data) for _, time, topic, data in rows)


def _storable(kind: MessageType, writer: BagWriter) -> MessageType:
    """Return a type without a definition that is not UTF-8, unless the storage is MCAP: a database cannot hold it."""
    is_text = kind.definition.encode(errors="ignore").decode() == kind.definition
    return kind if is_text or writer.storage == "mcap" else replace(kind, definition="")


def _keep_extras(source: Source, writer: BagWriter, report: RewriteReport) -> None:
    for extra in source.extras():
        try:
            writer.keep(extra)
        except BagError as error:
            report.left_out.append(str(error))


def _windows(sources: Sequence[Source], choice: Choice) -> Iterator[tuple[int, int]]:
    """Yield half-open spans of log time [ns] that each hold about what is sorted at once."""
    filled = [source for source in sources if any(stream.count for stream in source.streams)]
    if not filled:
        return
    start = min(source.start_ns for source in filled)
    stop = max(source.stop_ns for source in filled) + 1
    start = start if choice.start_ns is None else max(start, choice.start_ns)
    stop = stop if choice.stop_ns is None else min(stop, choice.stop_ns)
    if start >= stop:
        return
    size = sum(_size(source) for source in filled)
    count = min(max(1, math.ceil(size / _WINDOW_BYTES)), stop - start)
    edges = [start + (stop - start) * number // count for number in range(count + 1)]
    yield from itertools.pairwise(edges)


def _size(source: Source) -> int:
    try:
        return source.path.stat().st_size
    except OSError:  # a decompressed copy of a file
        return _WINDOW_BYTES
