"""Bags of any recorder, of ROS 1 and 2, as columns: one for each number of each topic.

Columns have the names that PlotJuggler gives them, so that a mapping file serves its tables too: ``/joint_states/elbow/
position``, ``/effort_control/data.0``, ``/imu/angular_velocity/x``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.recordings.columns import Column, Columns
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import Bag, read_bag
from pendulum_rosbag.reader.open_source import is_ros1

__all__ = ["read_bag_columns"]

_JOINT_STATE = "sensor_msgs/msg/JointState"
_QUANTITIES = ("position", "velocity", "effort")
_MOST_ENTRIES = 64
_ONE_CLOCK = 60.0
"""Difference of stamps and times of the log up to which they are of one clock [s]."""

Messages = Sequence[tuple[int, Any]]


def read_bag_columns(path: Path) -> Columns:
    """Return the numbers of a rosbag2 folder or file, or of a ``.bag`` of ROS 1, as columns.

    A BagError if it cannot be read, a DataError if no topic has numbers.
    """
    source: _Source = _Ros1(path) if is_ros1(path) else _Rosbag2(path)
    columns: dict[str, Column] = {}
    stamped = ""
    for topic in source.topics:
        try:
            first = source.first(topic)
        except DataError as error:
            source.notes.append(str(error))
            continue
        numbers = list(_numbers(first, topic)) if first is not None else []
        if not numbers:
            continue
        if not stamped and _stamp(first):
            stamped = topic  # stamps of the others are brought to its clock
        clock = f"{topic}/header/stamp" if _stamp(first) else f"{topic}/__time"
        count = source.topics[topic]
        for name, _ in numbers:
            columns[name] = Column(name, count, partial(_column, source, topic, name), clock, by_rows=True)
        columns[clock] = Column(clock, count, partial(_clock, source, topic, stamped), unit="s")
    if not columns:
        raise DataError(f"{path} holds no numbers in {', '.join(source.topics) or 'no topic'}; expected those of a run")
    return Columns(path, "bag", columns, source.notes)


class _Source:
    """The messages of a bag: ``topics`` has their number, ``notes`` what reading has found out."""

    topics: Mapping[str, int]
    notes: list[str]

    def first(self, topic: str) -> Any:
        """Return the first message; None where there is none."""
        return next((message for _, message in self.messages(topic)), None)

    def messages(self, topic: str) -> Messages:
        """Return log times [ns] and contents."""
        raise NotImplementedError


class _Rosbag2(_Source):
    def __init__(self, path: Path) -> None:
        self._bag: Bag = read_bag(path)
        self.topics = {name: info.count for name, info in self._bag.topics.items() if info.count}
        self.notes = [*self._bag.damage]
        self.messages = cache(self._messages)  # type: ignore[method-assign]

    def _messages(self, topic: str) -> Messages:
        return [(stored.log_time_ns, stored.message) for stored in self._bag.messages(topic)]


class _Ros1(_Source):
    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader, AnyReaderError

        try:
            self._reader = AnyReader([path])
            self._reader.open()
        except (AnyReaderError, OSError, ValueError) as error:
            raise DataError(f"{path} cannot be read as a bag of ROS 1: {error}") from error
        self.topics = {name: info.msgcount for name, info in self._reader.topics.items() if info.msgcount}
        self.notes = []
        self.messages = cache(self._messages)  # type: ignore[method-assign]

    def _messages(self, topic: str) -> Messages:
        wanted = [one for one in self._reader.connections if one.topic == topic]
        return [
            (time, self._reader.deserialize(data, connection.msgtype))
            for connection, time, data in self._reader.messages(wanted)
        ]


def _stamp(message: Any) -> float:
    """Return the stamp in the header of a message [s], 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _numbers(value: Any, prefix: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message by their paths; headers and layouts of arrays are left out."""
    if getattr(value, "__msgtype__", "") == _JOINT_STATE:
        for quantity in _QUANTITIES:
            for index, number in enumerate(getattr(value, quantity)):
                joint = value.name[index] if index < len(value.name) else f"joint{index}"
                yield f"{prefix}/{joint}/{quantity}", float(number)
        return
    for field in dataclasses.fields(value):
        if str(field.type).startswith("ClassVar") or field.name in {"header", "layout"}:
            continue
        item, name = getattr(value, field.name), f"{prefix}/{field.name}"
        if dataclasses.is_dataclass(item):
            yield from _numbers(item, name)
        elif isinstance(item, (bool, int, float, np.number)):
            yield name, float(item)
        elif isinstance(item, (list, tuple, np.ndarray)) and len(item) <= _MOST_ENTRIES:
            for index, entry in enumerate(item):
                if dataclasses.is_dataclass(entry):
                    yield from _numbers(entry, f"{name}.{index}")
                elif isinstance(entry, (bool, int, float, np.number)):
                    yield f"{name}.{index}", float(entry)


def _column(source: _Source, topic: str, name: str, rows: slice) -> NDArray[Any]:
    return _table(source, topic)[name][rows]


@cache
def _table(source: _Source, topic: str) -> dict[str, NDArray[Any]]:
    """Return the numbers of all messages of a topic; NaN where a message lacks one that the first has."""
    messages = source.messages(topic)
    names = [name for name, _ in _numbers(messages[0][1], topic)]
    table = np.full((len(messages), len(names)), np.nan)
    places = {name: place for place, name in enumerate(names)}
    for row, (_, message) in zip(table, messages, strict=True):
        for name, number in _numbers(message, topic):
            place = places.get(name)
            if place is not None:
                row[place] = number
    return dict(zip(names, table.T, strict=True))


def _clock(source: _Source, topic: str, stamped: str, rows: slice) -> NDArray[Any]:
    """Return the stamps of a topic [s].

    Of messages without a header they are the times of the log, on the clock of a topic that has stamps: that of a
    simulation may be another than the recorder's.
    """
    messages = source.messages(topic)
    if _stamp(messages[0][1]):
        return np.array([_stamp(message) for _, message in messages[rows]])
    logged = np.array([time for time, _ in messages[rows]]) * 1e-9
    if not stamped:
        return logged
    pairs = np.array([(time * 1e-9, _stamp(message)) for time, message in source.messages(stamped)])
    shift = np.interp(logged, pairs[:, 0], pairs[:, 1] - pairs[:, 0])
    return logged + shift if float(np.abs(shift).max()) > _ONE_CLOCK else logged
