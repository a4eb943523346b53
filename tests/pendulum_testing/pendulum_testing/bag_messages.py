"""Messages for tests of bags, serialised by rosbags, an implementation that is not ours."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from pendulum_rosbag.reader import Bag, canonical
from pendulum_rosbag.reader.joint_state import layout_of
from pendulum_rosbag.storage import BagWriter, typestore

__all__ = [
    "JOINT_STATE",
    "STORE",
    "as_rclpy_leaves_it",
    "assert_equals_rosbags",
    "joint_state",
    "mixed_messages",
    "write_bag",
]

JOINT_STATE = "sensor_msgs/msg/JointState"
STORE = typestore()


def joint_state(stamp_ns: int, frame: str, names: list[str], *values: list[float], trailing: bytes = b"") -> bytes:
    """Serialise with rosbags, an implementation that is not ours."""
    kind = STORE.types
    header = kind["std_msgs/msg/Header"](
        stamp=kind["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9),
        frame_id=frame,
    )
    arrays = [np.array(value, np.float64) for value in values]
    message = kind[JOINT_STATE](header, names, *arrays)
    return bytes(STORE.serialize_cdr(message, JOINT_STATE)) + trailing


def as_rclpy_leaves_it(data: bytes, rng: random.Random) -> bytes:
    """Fill the padding with whatever was in memory, and add bytes behind, as rclpy's serialiser does.

    (rclpy adds up to twelve; rosbags refuses a message with more than three.)
    """
    layout = layout_of(data)
    assert layout is not None
    noisy = bytearray(rng.randbytes(layout.size))
    kept = canonical(data)
    spans = [(2, 16), (layout.frame[0], layout.frame[0] + layout.frame[1])]
    spans += [(start, start + len(content)) for start, content in layout.constants]
    spans += [(start, start + 8) for start in layout.values if start >= 0]
    for start, stop in spans:
        noisy[start:stop] = kept[start:stop]
    return bytes(noisy) + rng.randbytes(rng.choice([0, 0, 1, 3]))


def mixed_messages(rng: random.Random, count: int) -> list[tuple[str, int, bytes]]:
    """States, commands of two senders, and three topics interleaved at random."""
    messages = []
    for index in range(count):
        stamp = 1_700_000_000_000_000_000 + index * 1_000_000
        kind = rng.randrange(3)
        if kind == 0:
            data = joint_state(stamp, "", ["pendulum_joint"], [rng.gauss(0, 1)], [rng.gauss(0, 1)], [rng.gauss(0, 1)])
        elif kind == 1:
            data = joint_state(stamp, rng.choice(["lqr", "energy_shaping"]), ["pendulum_joint"], [], [], [0.5 * index])
        else:
            data = joint_state(stamp, "", ["pendulum_joint"], [], [], [rng.uniform(-2.5, 2.5)])
        topic = ("/sim/joint_states", "/sim/effort_command", "/sim/disturbance")[kind]
        messages.append((topic, stamp + rng.randrange(900_000), as_rclpy_leaves_it(data, rng)))
    return messages


def assert_equals_rosbags(bag: Bag, path: Path) -> None:
    """Compare every field of every message with what rosbags reads."""
    expected: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            expected.setdefault(connection.topic, []).append((time, reader.deserialize(data, connection.msgtype)))
    assert {topic for topic in bag.topics if bag.topics[topic].count} == set(expected)
    for topic, messages in expected.items():
        array = bag.array(topic)
        assert array["log_time_ns"].tolist() == [time for time, _ in messages]
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in messages]
        assert array["stamp_ns"].tolist() == stamps
        for column in ("position", "velocity", "effort"):
            values = [float(v[0]) if len(v := getattr(m, column)) else math.nan for _, m in messages]
            np.testing.assert_array_equal(array[column], values)
        frames = [m.header.frame_id for _, m in messages]
        if any(frames):
            assert array["frame_id"].tolist() == frames
        else:
            assert "frame_id" not in (array.dtype.names or ())


def write_bag(
    path: Path,
    messages: Iterable[tuple[str, int, bytes]],
    storage: str = "mcap",
    compression: str | None = None,
    metadata: Mapping[str, Any] | None = None,
    *,
    seal_every: int,
    close: bool = True,
) -> Path:
    """Write joint states with our writer, sealed after every so many; closed, or left as a killed recorder leaves it.

    Args:
        path: Folder of the bag.
        messages: Topic, log time [ns] and CDR of each.
        storage: ``mcap`` or ``sqlite3``.
        compression: Of the storage.
        metadata: By name.
        seal_every: Messages between two seals.
        close: Whether the bag is closed.

    Returns:
        The folder.
    """
    written = list(messages)
    writer = BagWriter(path, storage, compression, metadata)
    for topic in sorted({topic for topic, _, _ in written}):
        writer.add_topic(topic, JOINT_STATE)
    for number, message in enumerate(written, start=1):
        writer.write(*message)
        if number % seal_every == 0:
            writer.seal()
    if close:
        writer.close()
    else:
        writer.abandon()
    return path
