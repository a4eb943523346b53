"""Small bags for tests, and all the readers that must agree about them."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader
from rosbags.highlevel import AnyReader

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.reader import read_bag

__all__ = ["ENDLESS_WRITER", "JOINT_STATE", "STRING", "count_everywhere", "count_in_order", "state", "text_message"]

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
ENDLESS_WRITER = """
import os, sys
from pendulum_rosbag.storage import BagWriter
from pendulum_msgs_py.contract.cdr import encode_joint_state
writer = BagWriter(sys.argv[1], sys.argv[2])
for number in range(5):
    writer.add_topic(f"/t{number}", "sensor_msgs/msg/JointState")
data = encode_joint_state(5, position=1.0, velocity=1.0, effort=2.0)
print("go", flush=True)
total = 0
while True:
    for number in range(5):
        writer.write(f"/t{number}", total, data)
        total += 1
    if total % 25 == 0:
        writer.seal()
        os.write(1, b"%d\\n" % total)
"""
"""A program (arguments: bag, storage) that writes to five topics, commits, and tells how many messages were."""


def text_message(text: str) -> bytes:
    """Return a std_msgs/String."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


def state(index: int) -> bytes:
    """Return a JointState whose stamp is ``index`` microseconds."""
    return encode_joint_state(index * 1000, position=0.1 * index, velocity=1.0, effort=-2.0)


def count_everywhere(bag: Path) -> tuple[int, ...]:
    """Count the messages with each reader there is; each fails on a file that is not whole."""
    with AnyReader([bag]) as reader:
        counts = [sum(1 for _ in reader.messages())]
    ours = read_bag(bag)
    assert not ours.damage, ours.damage
    counts.append(sum(len(ours.raw(topic)) for topic in ours.topics))
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            counts.append(sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()))
    for file in sorted(bag.glob("*.db3")):
        connection = sqlite3.connect(f"file:{file}?immutable=1", uri=True)
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        counts.append(connection.execute("SELECT count(*) FROM messages").fetchone()[0])
        connection.close()
    return tuple(counts)


def count_in_order(bag: Path) -> int:
    """Count the messages of an MCAP file as a reader does that goes through it from the start."""
    with next(bag.glob("*.mcap")).open("rb") as stream:
        return sum(1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False))
