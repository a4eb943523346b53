"""What a bag says about message types holds for that bag, and for no other."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import read_bag, same_messages
from pendulum_rosbag.storage import mcap_records as rec
from pendulum_rosbag.storage import typestore

_CDR = b"\0\1\0\0"


def write_mcap(path: Path, kind: str, definition: str, data: bytes) -> Path:
    """Write one message with a definition of our choice."""
    message = rec.MESSAGE_HEADER.pack(rec.MESSAGE, 22 + len(data), 1, 0, 5, 5) + data
    content = rec.schema_record(1, kind, "ros2msg", definition) + rec.channel_record(1, 1, "/t", "cdr", {}) + message
    end = rec.record(rec.DATA_END, bytes(4)) + rec.footer_record(0, 0)
    path.write_bytes(rec.MAGIC + rec.header_record("test") + content + end + rec.MAGIC)
    return path


def only_message(path: Path) -> object:
    with read_bag(path) as bag:
        (stored,) = bag["/t"]
    return stored.message


def test_two_bags_may_define_one_type_differently(tmp_path: Path) -> None:
    number = write_mcap(tmp_path / "a.mcap", "own/msg/Thing", "int32 number\n", _CDR + struct.pack("<i", 7))
    text = write_mcap(tmp_path / "b.mcap", "own/msg/Thing", "string text\n", _CDR + struct.pack("<I", 3) + b"ab\0")
    assert only_message(number).number == 7  # type: ignore[attr-defined]
    assert only_message(text).text == "ab"  # type: ignore[attr-defined]
    assert only_message(number).number == 7  # type: ignore[attr-defined]


def test_a_bag_redefines_a_standard_type_for_itself_alone(tmp_path: Path) -> None:
    before = {name: list(fields) for name, (_, fields) in typestore().fielddefs.items()}
    data = _CDR + struct.pack("<ii", 3, 4)
    hostile = write_mcap(tmp_path / "a.mcap", "std_msgs/msg/Int32", "int32 evil\nint32 data\n", data)
    assert only_message(hostile).evil == 3  # type: ignore[attr-defined]
    honest = write_mcap(tmp_path / "b.mcap", "std_msgs/msg/Int32", "int32 data\n", _CDR + struct.pack("<i", 9))
    assert only_message(honest).data == 9  # type: ignore[attr-defined]
    assert {name: list(fields) for name, (_, fields) in typestore().fielddefs.items()} == before


def test_a_type_that_uses_what_its_bag_does_not_define_takes_it_from_ros(tmp_path: Path) -> None:
    data = _CDR + struct.pack("<iIi", 1, 2, 5)
    path = write_mcap(tmp_path / "a.mcap", "own/msg/Stamped", "builtin_interfaces/Time at\nint32 x\n", data)
    message = only_message(path)
    assert (message.at.sec, message.at.nanosec, message.x) == (1, 2, 5)  # type: ignore[attr-defined]
    again = write_mcap(tmp_path / "b.mcap", "own/msg/Stamped", "builtin_interfaces/Time at\nint32 x\n", data)
    with read_bag(path) as one, read_bag(again) as other:
        assert same_messages(one, other)


def test_a_type_that_nobody_defines_is_named(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", "own/msg/Holder", "own/Missing x\n", _CDR + bytes(8))
    with read_bag(path) as bag, pytest.raises(DataError, match="own/msg/Missing is not defined"):
        bag["/t"]
