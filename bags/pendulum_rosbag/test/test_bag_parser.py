"""The vectorised parser: any bytes, padding and damage included."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.reader import Bag, canonical, read_bag, same_messages
from pendulum_rosbag.reader.batches import Batch
from pendulum_rosbag.reader.joint_state import JointStateParser, layout_of
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, STORE, as_rclpy_leaves_it, joint_state

text = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
value = st.lists(st.floats(width=64), max_size=1)


def messages_of(joint: str) -> st.SearchStrategy[bytes]:
    stamp, tail = st.integers(0, 2**31 * 10**9 - 1), st.binary(max_size=3)
    return st.builds(joint_state, stamp, text, st.just([joint]), value, value, value, trailing=tail)


message = text.flatmap(messages_of)


def parse(datas: list[bytes], *, record_heads: bool) -> Any:
    offsets, sizes, buffer = [], [], b""
    for number, data in enumerate(datas):
        offsets.append(len(buffer))
        sizes.append(len(data))
        head = struct.pack("<BQHIQQ", 5, len(data) + 22, 3, 0, number, number) if record_heads else b""
        buffer += head + data
    parser = JointStateParser(len(datas))
    parser.add(
        Batch(
            3,
            np.frombuffer(buffer, np.uint8),
            np.array(offsets, np.int64),
            np.arange(len(datas)),
            None if record_heads else np.array(sizes, np.int64),
        )
    )
    return parser.result()


@settings(max_examples=80, deadline=None)
@given(text.flatmap(lambda joint: st.lists(messages_of(joint), min_size=1, max_size=8)), st.booleans())
def test_any_one_joint_states_parse_as_rosbags_parses_them(datas: list[bytes], record_heads: bool) -> None:
    array = parse(datas, record_heads=record_heads)
    assert array is not None
    frames = array["frame_id"] if "frame_id" in array.dtype.names else np.full(len(array), "")
    for row, frame, data in zip(array, frames, datas, strict=True):
        expected = STORE.deserialize_cdr(data, JOINT_STATE)
        assert row["stamp_ns"] == expected.header.stamp.sec * 10**9 + expected.header.stamp.nanosec
        assert frame == expected.header.frame_id
        for column in ("position", "velocity", "effort"):
            values = getattr(expected, column)
            np.testing.assert_array_equal(row[column], values[0] if len(values) else np.nan)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=120), message), min_size=1, max_size=5), st.data())
def test_damaged_bytes_are_never_taken_for_states(datas: list[bytes], data: st.DataObject) -> None:
    """Whatever the bytes: no crash, and what is parsed is what a careful parser reads."""
    torn = [item[: data.draw(st.integers(0, len(item)))] for item in datas]
    for record_heads in (True, False):
        array = parse(torn, record_heads=record_heads)
        assert (array is not None) == all(layout_of(item) is not None for item in torn)


@given(message, st.randoms(use_true_random=False))
@settings(max_examples=80, deadline=None)
def test_canonical_bytes_do_not_depend_on_padding(data: bytes, rng: random.Random) -> None:
    noisy = as_rclpy_leaves_it(data, rng)
    assert canonical(noisy) == canonical(data)
    assert canonical(canonical(data)) == canonical(data)


def test_canonical_bytes_are_those_of_the_encoder() -> None:
    for fields in ({"position": 1.0, "velocity": 2.0, "effort": 3.0}, {"effort": 3.0}, {"position": 0.5}):
        data = encode_joint_state(123_456, frame_id="lqr", **fields)
        assert canonical(as_rclpy_leaves_it(data, random.Random(1))) == data


def test_one_flipped_byte_makes_bags_different(tmp_path: Path) -> None:
    rng = random.Random(8)

    def write(path: Path, effort: float, time: int) -> Bag:
        with BagWriter(path) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(20):
                data = encode_joint_state(index, effort=effort if index == 13 else 1.0)
                writer.write("/a", index + time, as_rclpy_leaves_it(data, rng))
        return read_bag(path)

    a, b = write(tmp_path / "a", 1.0, 0), write(tmp_path / "b", 1.0, 0)
    assert same_messages(a, b)
    assert str(same_messages(a, b)) == "20 messages on 1 topics are equal"
    other = same_messages(a, write(tmp_path / "c", math.nextafter(1.0, 2.0), 0))
    assert not other
    assert str(other) == "/a message 13 at 13 ns differs"
    late = write(tmp_path / "d", 1.0, 1)
    assert "log time 0 ns in one bag and 1 ns in the other" in str(same_messages(a, late))
    assert same_messages(a, late, log_times=False)


def test_messages_of_one_log_time_have_no_order_but_must_all_be_there(tmp_path: Path) -> None:
    def write(name: str, positions: list[float]) -> Bag:
        with BagWriter(tmp_path / name) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for position in positions:
                writer.write("/a", 1, encode_joint_state(1, position=position))
        return read_bag(tmp_path / name)

    one = write("one", [1.0, 2.0])
    assert same_messages(one, write("other", [2.0, 1.0]))
    assert not same_messages(one, write("third", [2.0, 2.0]))
