"""A bag as arrays: read lazily by topic, the same for every storage and recorder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pendulum_msgs_py.contract.cdr import decode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.batches import Batch, Int64, Source, Stream
from pendulum_rosbag.reader.clock import CLOCK_JUMP, ClockStep, find_steps, go_on, pass_order, set_stamps, steps_back
from pendulum_rosbag.reader.joint_state import JointStateParser, two_motions
from pendulum_rosbag.reader.joint_table import JointTable, joint_table
from pendulum_rosbag.reader.open_source import BagFolder, damage_of, open_folder, open_sources, parsed
from pendulum_rosbag.reader.topic_info import StoredMessage, TopicInfo, ros_topic, ros_type

__all__ = ["Bag", "read_bag", "read_bags"]

_JOINT_STATE = "sensor_msgs/msg/JointState"
_STRING = "std_msgs/msg/String"


@dataclass(slots=True)
class _Topic:
    info: TopicInfo
    streams: list[tuple[Source, Stream]] = field(default_factory=list)


class Bag(Mapping[str, Any]):
    """A bag that is open for reading; made by :func:`read_bag`.

    ``bag[topic]`` is read on first use and cached, ordered by log time. A topic of one-joint ``sensor_msgs/JointState``
    is a structured array with the columns ``log_time_ns``, ``stamp_ns`` [ns], ``position`` [rad], ``velocity`` [rad/s],
    ``effort`` [N m] (NaN if absent) and, when any message has one, ``frame_id``; any other topic is a list of
    :class:`StoredMessage`.

    Attributes:
        topics: Topic name -> :class:`TopicInfo`.
        metadata: Run metadata (``custom_data``), JSON values parsed.
        damage: What is wrong with the bag, one sentence per file; empty for a healthy one.
        clock_notes: Clock faults that reading has found so far: steps back, and stamps that were never set.
        cuts_ns: Stamps at which a clock stepped back, in the times of :meth:`array` [ns].
        notes: Files left out as copies, and what reading cannot find out, one sentence each.
    """

    def __init__(
        self,
        folder: BagFolder,
        sources: Sequence[Source],
        topics: Sequence[str] | None,
        start: int | None,
        stop: int | None,
    ) -> None:
        self.path = folder.path
        self.storage = folder.storage
        self.metadata: dict[str, Any] = folder.metadata
        self.damage = damage_of(folder, sources)
        self.notes = folder.notes + [
            f"{source.path.name}: {source.unchecked}, so bytes that changed in messages cannot be told"
            for source in sources
            if source.unchecked
        ]
        self._sources = list(sources)
        self._span = (start, stop)
        self._topics, several = _group(sources, folder.topic_hashes)
        self._also = {stream.topic: name for name, topic in self._topics.items() for _, stream in topic.streams}
        self.damage += several
        self.notes += [
            f"topic {name} has no type in the file; its messages are those of {topic.info.type}"
            for name, topic in self._topics.items()
            if topic.info.type == _JOINT_STATE and not topic.streams[0][1].type
        ]
        if topics is not None:
            self._topics = {entry.info.name: entry for entry in map(self._entry, topics)}
        self.clock_notes: list[str] = []
        self.cuts_ns: list[int] = []
        self._steps: list[ClockStep] | None = None
        self._stamp_steps: list[tuple[int, int]] = []
        self._arrays: dict[str, npt.NDArray[Any] | list[StoredMessage]] = {}
        self._tables: dict[str, JointTable] = {}

    @property
    def topics(self) -> dict[str, TopicInfo]:
        """Topic name -> type, number of messages and further descriptions."""
        return {name: topic.info for name, topic in self._topics.items()}

    @property
    def start_ns(self) -> int:
        """Log time of the first message of the whole bag [ns]."""
        return min((source.start_ns for source in self._sources if source.stop_ns), default=0)

    @property
    def stop_ns(self) -> int:
        """Log time of the last message of the whole bag [ns]."""
        return max((source.stop_ns for source in self._sources), default=0)

    def __getitem__(self, topic: str) -> Any:
        topic = self._entry(topic).info.name
        if topic not in self._arrays:
            self._load([topic])
        return self._arrays[topic]

    def __contains__(self, topic: object) -> bool:
        # Mapping's own would read the topic, and expects a KeyError.
        return topic in self._topics or self._also.get(str(topic)) in self._topics

    def get(self, topic: str, default: Any = None) -> Any:
        """Return a topic as ``bag[topic]`` does, or a default if the bag has none of that name."""
        return self[topic] if topic in self else default  # noqa: SIM401 (this is that method)

    def __iter__(self) -> Iterator[str]:
        return iter(self._topics)

    def __len__(self) -> int:
        return len(self._topics)

    def array(self, topic: str) -> npt.NDArray[Any]:
        """Return a topic of one-joint JointState as an array with consistent times; a DataError for other topics.

        After a clock's step back, later times are shifted so that they continue; stamps that were never set are
        replaced by log times (see ``clock_notes``).
        """
        values = self[topic]
        if not isinstance(values, np.ndarray):
            held = _held(self._entry(topic).info.type, values)
            way_out = "; export writes a column for each joint" if " joints (" in held else ""
            raise DataError(
                f"topic {topic} of bag {self.path} holds {held}; "
                f"expected sensor_msgs/msg/JointState of one joint{way_out}"
            )
        recorded = values["log_time_ns"], values["stamp_ns"]
        self._check_one_motion(topic, values["position"])
        log_times, stamps = self._timed(topic, *recorded)
        if log_times is recorded[0] and stamps is recorded[1]:
            return values
        values = values.copy()
        values["log_time_ns"], values["stamp_ns"] = log_times, stamps
        return values

    def joints(self, topic: str) -> JointTable:
        """Return JointStates as arrays, a column per joint, times as in :meth:`array`; a DataError if they differ."""
        if topic not in self._tables:
            table = joint_table(self.raw(topic), f"topic {topic} of bag {self.path}")
            self._check_one_motion(topic, *table.position.T)
            log_times, stamps = self._timed(topic, table.log_time_ns, table.stamp_ns)
            self._tables[topic] = replace(table, log_time_ns=log_times, stamp_ns=stamps)
        return self._tables[topic]

    def joint_names(self, topic: str) -> tuple[str, ...]:
        """Return the joints in the first message of a topic; none if it has none or is no JointState."""
        batches = self._batches(topic) if self._is_fixed(topic) else []
        first = next((decode_joint_state(data) for batch in batches for _, data in batch.payloads()), None)
        return () if first is None else first.joints

    def load(self) -> Bag:
        """Read all topics in one pass over the files and return the bag; unreadable topics are skipped."""
        topics = [topic for topic in self._topics if topic not in self._arrays]
        self._load([topic for topic in topics if self._is_fixed(topic)])
        for topic in topics:
            with contextlib.suppress(DataError):
                self._load([topic] if topic not in self._arrays else [])
        return self

    def raw(self, topic: str) -> list[tuple[int, bytes]]:
        """Return all messages of a topic as (log time [ns], CDR bytes), by log time but in file order across steps."""
        rows = [row for batch in self._batches(topic) for row in batch.payloads()]
        order = self._order(topic, np.array([time for time, _ in rows], np.int64))
        return rows if order is None else [rows[place] for place in order.tolist()]

    def log_times(self, topic: str) -> Int64:
        """Return the log times of a topic in the order of :meth:`raw` [ns], shape (n,), without reading messages."""
        batches = self._batches(topic)
        for batch in batches:
            batch.check_heads()
        times = np.concatenate([np.empty(0, np.int64), *(batch.times for batch in batches)])
        order = self._order(topic, times)
        return times if order is None else times[order]

    def clock_steps(self) -> list[ClockStep]:
        """Return the steps back of the recorder's clock."""
        if self._steps is None:
            self._steps = find_steps(self._wanted(set(self._topics)), self._span)
            self.clock_notes += [
                f"log times step back {step.after_ns * 1e-9:.3f} s after the first of them, by "
                f"{step.size_ns * 1e-9:.3f} s: what follows is read in the order of the file"
                for step in self._steps
            ]
        return self._steps

    def messages(self, topic: str) -> list[StoredMessage]:
        """Return a topic's messages as objects of any type; a DataError if the type is unknown or one is damaged."""
        from pendulum_rosbag.reader.decode import decoder_for

        rows = self.raw(topic)
        foreign = {stream.serialization for _, stream in self._entry(topic).streams} - {"cdr"}
        if foreign:
            raise DataError(
                f"topic {topic} of bag {self.path} is encoded as {foreign.pop()!r}; expected CDR, as of ROS 2"
            )
        decode = decoder_for(self._entry(topic).info)
        return [StoredMessage(time, decode(data)) for time, data in rows]

    def events(self) -> list[dict[str, Any]]:
        """Return the messages on ``events`` topics, in order of time.

        Each event has ``stamp_ns``, ``name``, ``topic``, ``log_time_ns`` and its author's fields. Text that is no JSON
        object becomes an event of that name.
        """
        events: list[dict[str, Any]] = []
        for name, topic in self._topics.items():
            if topic.info.type != _STRING or name.rsplit("/", 1)[-1] != "events":
                continue
            rows = self.raw(name)
            times = self._moved(name, np.array([time for time, _ in rows], np.int64)).tolist()
            for (time, data), moved in zip(rows, times, strict=True):
                size = int.from_bytes(data[4:8], "little")
                text = data[8 : 8 + size].split(b"\0")[0].decode("utf-8", "replace")
                content = parsed(text)
                event: dict[str, Any] = content if isinstance(content, dict) else {"name": text}
                event = {"stamp_ns": time, "name": "", **event, "topic": name, "log_time_ns": time}
                if not isinstance(event["stamp_ns"], int):
                    event["stamp_ns"] = time  # the topic is open to any writer
                event["stamp_ns"] += sum(size for known, size in self._stamp_steps if moved >= known)
                events.append(event)
        events.sort(key=lambda event: (event["stamp_ns"], event["log_time_ns"]))
        return events

    def close(self) -> None:
        """Release the files; arrays that were read remain."""
        for source in self._sources:
            source.close()
        self._sources.clear()

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Bag {self.path} with {sum(topic.info.count for topic in self._topics.values())} messages>"

    def _entry(self, topic: str) -> _Topic:
        found = self._topics.get(topic) or self._topics.get(self._also.get(topic, ""))
        if found is None:
            raise DataError(f"bag {self.path} has no topic {topic}; it has {', '.join(sorted(self._topics)) or 'none'}")
        return found

    def _batches(self, topic: str) -> list[Batch]:
        return [batch for source, wanted in self._wanted({topic}) for batch in source.batches(set(wanted), *self._span)]

    def _order(self, topic: str, times: Int64) -> Int64 | None:
        """Return the order of messages given in file order; ``None`` if they are in order already."""
        if len(times) < 2 or bool((times[1:] >= times[:-1]).all()):
            return None
        # A topic with few messages does not show whether its clock stepped or messages were late.
        if int(np.diff(times).min()) > -CLOCK_JUMP * 1e9 and not steps_back(times):
            return np.argsort(times, kind="stable")
        name = self._entry(topic).info.name
        return pass_order(times, [step.rows.get(name, 0) for step in self.clock_steps()])

    def _check_one_motion(self, topic: str, *positions: npt.NDArray[Any]) -> None:
        if jumps := next(filter(None, map(two_motions, positions)), ""):
            raise DataError(
                f"topic {topic} of bag {self.path} holds two motions ({jumps}); expected those of one plant: record "
                "each sender under a topic of its own"
            )

    def _timed(self, topic: str, log_times: Int64, stamps: Int64) -> tuple[Int64, Int64]:
        name = self._entry(topic).info.name
        if len(log_times) and int(np.diff(log_times).min(initial=0)) < 0:
            self.clock_steps()
        log_times = self._moved(name, log_times)
        is_set = set_stamps(log_times, stamps)
        if not is_set.all():
            count = int(np.sum(~is_set))
            self._note(f"{count} of {len(stamps)} messages on {name} have no stamp: their log times are taken")
            age = int(np.median((log_times - stamps)[is_set])) if is_set.any() else 0
            stamps = np.where(is_set, stamps, log_times - age)
        own = {int(log_times[row]): row for row in steps_back(stamps)}
        for time, row in own.items():
            if not any(abs(time - known) < 10**9 for known, _ in self._stamp_steps):
                size = go_on(stamps, row)
                self._stamp_steps.append((time, size))
                self.cuts_ns.append(int(stamps[row]) + size + sum(size for _, size in self._stamp_steps[:-1]))
                self._note(
                    f"stamps on {name} step back by {size * 1e-9:.3f} s, {(time - int(log_times[0])) * 1e-9:.3f} s "
                    "after the first: what follows is taken as going on there"
                )
        for known, size in self._stamp_steps:
            row = next((row for time, row in own.items() if abs(time - known) < 10**9), -1)
            row = int(np.searchsorted(log_times, known)) if row < 0 else row
            stamps = stamps.copy()
            stamps[row:] += size
        return log_times, stamps

    def _moved(self, name: str, log_times: Int64) -> Int64:
        for step in self._steps or []:
            if step.rows.get(name, len(log_times)) < len(log_times):
                log_times = log_times.copy()
                log_times[step.rows[name] :] += step.size_ns
        return log_times

    def _note(self, sentence: str) -> None:
        if sentence not in self.clock_notes:
            self.clock_notes.append(sentence)

    def _wanted(self, topics: set[str]) -> Iterator[tuple[Source, dict[int, str]]]:
        streams = {name: self._entry(name).streams for name in topics}
        for source in self._sources:
            wanted = {
                stream.channel: name for name, found in streams.items() for owner, stream in found if owner is source
            }
            if wanted:
                yield source, wanted

    def _load(self, topics: Sequence[str]) -> None:
        fixed = [topic for topic in topics if self._is_fixed(topic)]
        if len(fixed) == 1 and any(source.compressed for source in self._sources):
            # A chunk that is decompressed for one topic serves the others too.
            fixed += [t for t in self._topics if t not in fixed and t not in self._arrays and self._is_fixed(t)]
        arrays = self._read_fixed(fixed) if fixed else {}
        for topic in dict.fromkeys([*topics, *arrays]):
            array = arrays.get(topic)
            self._arrays[topic] = self.messages(topic) if array is None else array

    def _is_fixed(self, topic: str) -> bool:
        entry = self._entry(topic)
        plain = all(stream.serialization == "cdr" for _, stream in entry.streams)
        return entry.info.type == _JOINT_STATE and plain

    def _read_fixed(self, topics: Sequence[str]) -> dict[str, npt.NDArray[Any] | None]:
        parsers = {topic: JointStateParser(self._topics[topic].info.count) for topic in topics}
        for source, wanted in self._wanted(set(topics)):
            for batch in source.batches(set(wanted), *self._span):
                parsers[wanted[batch.channel]].add(batch)
        return {topic: self._sorted(topic, parser.result()) for topic, parser in parsers.items()}

    def _sorted(self, topic: str, array: npt.NDArray[Any] | None) -> npt.NDArray[Any] | None:
        order = None if array is None else self._order(topic, array["log_time_ns"])
        return array if array is None or order is None else array[order]


def read_bag(
    path: str | os.PathLike[str],
    topics: Sequence[str] | None = None,
    start: int | None = None,
    stop: int | None = None,
    *,
    verify: bool | None = None,
) -> Bag:
    """Open a bag for reading.

    Args:
        path: A rosbag2 folder, or a single ``.mcap`` or ``.db3`` file, of any recorder; a bag whose recorder died is
            read as far as it is whole (see ``bag.damage``).
        topics: Topics to offer; by default all.
        start: First log time [ns]; by default from the beginning.
        stop: End of the log times, exclusive [ns]; by default to the end.
        verify: Checksums of an MCAP file. By default those of chunks that are read; a damaged chunk is then an error.
            ``True`` compares all now and leaves damaged chunks out (see ``bag.damage``), as always after a recorder
            died; ``False`` compares none.

    Raises:
        BagError: There is no bag, or nothing of it can be read.
        DataError: The bag lacks a requested topic.

    Example:
        >>> bag = read_bag("runs/today/sim")
        >>> states = bag["/sim/joint_states"]
        >>> states["position"].mean()
    """
    folder = open_folder(Path(path))
    return Bag(folder, open_sources(folder, verify=verify), topics, start, stop)


def read_bags(
    paths: Sequence[str | os.PathLike[str]],
    topics: Sequence[str] | None = None,
    start: int | None = None,
    stop: int | None = None,
    *,
    workers: int | None = None,
) -> list[Bag]:
    """Read many bags in parallel, in the order of ``paths``; arguments as for :func:`read_bag`.

    ``workers`` threads, by default one per processor: copying and decompressing release the interpreter's lock.
    """
    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        return list(pool.map(lambda path: read_bag(path, topics, start, stop).load(), paths))


def _group(sources: Sequence[Source], hashes: Mapping[str, str]) -> tuple[dict[str, _Topic], list[str]]:
    """Return the topics by name; if one has several types, the rarer ones are ``NAME (TYPE)``, with a sentence."""
    grouped: dict[str, dict[str, list[tuple[Source, Stream]]]] = {}
    stored = {stream.topic for source in sources for stream in source.streams}
    for source in sources:
        for stream in source.streams:
            name = ros_topic(stream.topic)
            if name != stream.topic and name in stored:
                name = stream.topic  # another topic has that name
            kind = ros_type(stream.type) or _type_of_messages(source, stream)
            grouped.setdefault(name, {}).setdefault(kind, []).append((source, stream))
    topics: dict[str, _Topic] = {}
    sentences = []
    for name, by_type in sorted(grouped.items()):
        kinds = sorted(by_type, key=lambda kind: -sum(stream.count for _, stream in by_type[kind]))
        for kind in kinds:
            offered = name if kind == kinds[0] else f"{name} ({kind})"
            topics[offered] = _topic(offered, kind, by_type[kind], hashes.get(name, "") if kind == kinds[0] else "")
        if len(kinds) > 1:
            others = ", ".join(repr(f"{name} ({kind})") for kind in kinds[1:])
            sentences.append(
                f"topic {name} has the types {', '.join(kinds)}; expected one (messages of the others are offered as "
                f"{others})"
            )
    return topics, sentences


def _type_of_messages(source: Source, stream: Stream) -> str:
    """Return JointState for an untyped topic whose first message is one, else nothing."""
    if stream.serialization != "cdr" or not stream.count:
        return ""
    batches = source.batches({stream.channel}, None, None)
    first = next((decode_joint_state(data) for batch in batches for _, data in batch.payloads()), None)
    return _JOINT_STATE if first is not None and first.joints else ""


def _topic(name: str, kind: str, streams: list[tuple[Source, Stream]], type_hash: str) -> _Topic:
    first = next((stream for _, stream in streams if stream.definition), streams[0][1])
    count = sum(stream.count for _, stream in streams)
    hash_told = first.hash or type_hash
    info = TopicInfo(name, kind, count, hash_told, first.qos, first.definition, first.serialization)
    return _Topic(info, streams)


def _held(kind: str, stored: Sequence[StoredMessage]) -> str:
    """Return what a topic holds, in words, and for joint states why they do not fit."""
    if kind != _JOINT_STATE:
        return kind
    turns = dict.fromkeys(str(name) for item in stored for name in item.message.name)
    for item in stored:
        joints = [str(name) for name in item.message.name]
        sizes = [len(getattr(item.message, column)) for column in ("position", "velocity", "effort")]
        if not joints:
            return f"{kind} whose joints have no names (field name is empty, with {max(sizes)} values)"
        if len(joints) > 1:
            return f"{kind} of {len(joints)} joints ({', '.join(joints)})"
        if max(sizes) > 1:
            return f"{kind} of the joint {joints[0]} with {max(sizes)} values"
    if len(turns) > 1:
        return f"{kind} of {len(turns)} joints that take turns: {', '.join(turns)}"
    return f"{kind} in more layouts than can be read (big-endian CDR, or damaged)"
