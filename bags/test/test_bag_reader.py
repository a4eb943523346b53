"""Bags as arrays: the same as rosbags reads, message by message, for every writer and storage."""

from __future__ import annotations

import json
import math
import random
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from pendulum_bags.export_cli import main as export_main
from pendulum_bags.info_cli import main as info_main
from pendulum_bags.reader import Bag, canonical, read_bag, read_bags, same_messages
from pendulum_bags.reader.batches import Batch
from pendulum_bags.reader.joint_state import JointStateParser, layout_of
from pendulum_bags.reader.statistics import bag_statistics, time_statistics
from pendulum_bags.reader.tables import export_bag, to_pandas
from pendulum_bags.storage import open_writer, typestore
from pendulum_msgs_py.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError, DataError, ParameterError

JOINT_STATE = "sensor_msgs/msg/JointState"
STORE = typestore()


def joint_state(
    stamp_ns: int, frame: str, names: list[str], *values: list[float], trailing: bytes = b""
) -> bytes:
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
            data = joint_state(
                stamp, "", ["pendulum_joint"], [rng.gauss(0, 1)], [rng.gauss(0, 1)], [rng.gauss(0, 1)]
            )
        elif kind == 1:
            data = joint_state(
                stamp, rng.choice(["lqr", "energy_shaping"]), ["pendulum_joint"], [], [], [0.5 * index]
            )
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
            expected.setdefault(connection.topic, []).append(
                (time, reader.deserialize(data, connection.msgtype))
            )
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
            assert "frame_id" not in array.dtype.names


@pytest.mark.parametrize(("storage", "compression"), [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)])
def test_our_bags_read_as_rosbags_reads_them(tmp_path: Path, storage: str, compression: str | None) -> None:
    rng = random.Random(2)
    path = tmp_path / "bag"
    with open_writer(path, storage, compression) as writer:
        for topic in ("/sim/joint_states", "/sim/effort_command", "/sim/disturbance"):
            writer.add_topic(topic, JOINT_STATE)
        for number, item in enumerate(mixed_messages(rng, 3000)):
            writer.write(*item)
            if number % 700 == 0:
                writer.seal()
    assert_equals_rosbags(read_bag(path), path)


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("version", [8, 9])
def test_bags_of_rosbags_read_the_same(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode, version: int
) -> None:
    path = tmp_path / "bag"
    writer = RosbagsWriter(path, version=version, storage_plugin=plugin)  # type: ignore[arg-type]
    writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.set_custom_data("seed", "7")
    with writer:
        connections: dict[str, Any] = {}
        for topic, time, data in mixed_messages(random.Random(4), 400):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, JOINT_STATE, typestore=STORE)
            writer.write(connections[topic], time, data)
    bag = read_bag(path)
    assert bag.metadata == {"seed": 7}
    assert not bag.damage
    if mode == CompressionMode.MESSAGE:  # such messages have no fixed layout: they come as objects
        for topic in bag.topics:
            assert [m.message.header.stamp.sec for m in bag[topic]][:1] == [1_700_000_000]
        return
    assert_equals_rosbags(bag, path)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("variant", ["all", "no_index", "no_chunks", "no_summary"])
def test_files_of_the_mcap_library_read_the_same(
    tmp_path: Path, compression: CompressionType, variant: str
) -> None:
    path = tmp_path / "alone.mcap"
    messages = mixed_messages(random.Random(5), 300)
    messages.sort(key=lambda item: item[1])
    with path.open("wb") as stream:
        writer = McapLibraryWriter(
            stream,
            chunk_size=4000,
            compression=compression,
            use_chunking=variant != "no_chunks",
            use_statistics=variant != "no_summary",
            use_summary_offsets=variant != "no_summary",
            repeat_channels=variant != "no_summary",
            repeat_schemas=variant != "no_summary",
        )
        if variant in ("no_index", "no_summary"):
            writer = McapLibraryWriter(
                stream, chunk_size=4000, compression=compression, index_types=_no_index(), use_chunking=True
            )
        writer.start("ros2", "test")
        definition, _ = STORE.generate_msgdef(JOINT_STATE, ros_version=2)
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition.encode())
        channels: dict[str, int] = {}
        for topic, time, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    bag = read_bag(path)
    assert not bag.damage
    assert_equals_rosbags(bag, path)


def _no_index() -> Any:
    from mcap.writer import IndexType

    return IndexType.NONE


def test_a_time_span_is_cut_on_both_sides(tmp_path: Path) -> None:
    for storage, compression in (("mcap", None), ("mcap", "zstd"), ("sqlite3", None)):
        path = tmp_path / f"{storage}{compression}"
        with open_writer(path, storage, compression) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(1000):
                writer.write("/a", index, encode_joint_state(index, position=float(index)))
                if index % 90 == 0:
                    writer.seal()
        assert read_bag(path, start=100, stop=250)["/a"]["stamp_ns"].tolist() == list(range(100, 250))
        assert read_bag(path, start=990)["/a"]["stamp_ns"].tolist() == list(range(990, 1000))
        assert read_bag(path, stop=3)["/a"]["stamp_ns"].tolist() == [0, 1, 2]
        assert len(read_bag(path, start=5000)["/a"]) == 0
        assert read_bag(path).log_times("/a").tolist() == list(range(1000))


def test_topics_can_be_chosen_and_missing_ones_are_named(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path) as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, JOINT_STATE)
            writer.write(topic, 1, encode_joint_state(1, effort=1.0))
    assert list(read_bag(path, ["/b"])) == ["/b"]
    with pytest.raises(DataError, match="has no topic /c; it has /a, /b"):
        read_bag(path, ["/c"])
    with pytest.raises(DataError, match="has no topic /c; it has /a, /b"):
        read_bag(path)["/c"]
    assert "/a" in read_bag(path)
    assert "/c" not in read_bag(path)
    assert read_bag(path).get("/c") is None
    with pytest.raises(BagError, match="does not exist"):
        read_bag(tmp_path / "nothing")


def test_states_of_several_joints_come_as_objects(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.write("/a", 1, joint_state(1, "", ["pendulum_joint"], [1.0], [2.0], [3.0]))
        writer.write("/a", 2, joint_state(2, "", ["p", "q"], [1.0, 2.0], [], []))
    stored = read_bag(path)["/a"]
    assert [list(item.message.name) for item in stored] == [["pendulum_joint"], ["p", "q"]]
    with pytest.raises(DataError, match="expected sensor_msgs/msg/JointState of one joint"):
        read_bag(path).array("/a")


def test_bytes_behind_the_message_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.add_topic("/clock", "rosgraph_msgs/msg/Clock")
        writer.write("/a", 1, joint_state(1, "", ["pendulum_joint"], [], [], [3.0], trailing=b"\xab" * 12))
        writer.write("/clock", 1, b"\0\1\0\0" + struct.pack("<iI", 5, 6) + b"\xab" * 12)
    bag = read_bag(path)
    assert bag["/a"]["effort"].tolist() == [3.0]
    assert bag.messages("/a")[0].message.effort.tolist() == [3.0]
    assert bag["/clock"][0].message.clock.sec == 5


def test_events_come_as_dictionaries_in_order_of_time(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    texts = [
        '{"stamp_ns": 30, "name": "hold"}',
        '{"stamp_ns": 10, "name": "ramp_up", "target": 3.14}',
        "plain",
    ]
    with open_writer(path) as writer:
        writer.add_topic("/sim/events", "std_msgs/msg/String")
        writer.add_topic("/chatter", "std_msgs/msg/String")
        for number, text in enumerate(texts):
            data = text.encode() + b"\0"
            writer.write("/sim/events", number, b"\0\1\0\0" + len(data).to_bytes(4, "little") + data)
    events = read_bag(path).events()
    assert [event["name"] for event in events] == ["plain", "ramp_up", "hold"]
    assert events[1]["target"] == 3.14
    assert events[1]["topic"] == "/sim/events"


def test_many_bags_are_read_in_parallel(tmp_path: Path) -> None:
    for number in range(5):
        with open_writer(tmp_path / str(number)) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(100):
                writer.write("/a", index, encode_joint_state(index, position=float(number)))
    bags = read_bags([tmp_path / str(number) for number in range(5)])
    assert [float(bag["/a"]["position"].mean()) for bag in bags] == [0.0, 1.0, 2.0, 3.0, 4.0]


# -- the parser --------------------------------------------------------------------------------------------------

text = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
value = st.lists(st.floats(width=64), max_size=1)
message = st.builds(
    joint_state,
    st.integers(0, 2**31 * 10**9 - 1),
    text,
    st.lists(text, min_size=1, max_size=1),
    value,
    value,
    value,
    trailing=st.binary(max_size=3),
)


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
@given(st.lists(message, min_size=1, max_size=8), st.booleans())
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
        with open_writer(path) as writer:
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
        with open_writer(tmp_path / name) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for position in positions:
                writer.write("/a", 1, encode_joint_state(1, position=position))
        return read_bag(tmp_path / name)

    one = write("one", [1.0, 2.0])
    assert same_messages(one, write("other", [2.0, 1.0]))
    assert not same_messages(one, write("third", [2.0, 2.0]))


# -- timing and tables ---------------------------------------------------------------------------------------------


def test_timing_finds_gaps_duplicates_and_clock_jumps() -> None:
    stamps = np.arange(1000, dtype=np.int64) * 2_000_000
    stamps = np.delete(stamps, [500, 501, 502])
    stamps[100] = stamps[99]
    log = stamps + 300_000
    log[700:] += 200_000_000
    result = time_statistics(JOINT_STATE, log, stamps)
    assert result.count == 997
    assert result.rate == pytest.approx(500, rel=0.01)
    assert result.period == pytest.approx(2.0)
    assert result.longest == pytest.approx(8.0)
    assert result.duplicates == 1
    assert result.clock_jumps == 1
    assert result.age == pytest.approx(0.3)
    assert result.gaps == 2  # three lost messages, and the one whose stamp was doubled
    assert result.missing == 4


def test_a_late_message_is_a_gap_but_none_is_missing() -> None:
    stamps = np.arange(100, dtype=np.int64) * 2_000_000
    stamps[50] += 1_500_000
    result = time_statistics(JOINT_STATE, stamps, stamps)
    assert (result.gaps, result.missing) == (1, 0)


def test_bursts_of_events_leave_no_gaps_but_a_periodic_topic_without_stamps_does() -> None:
    event = "std_msgs/msg/String"
    bursts = np.array([0, 1_000, 3_000, 4_000, 2_000_000_000, 2_000_001_000, 2_000_004_000], np.int64)
    result = time_statistics(event, bursts)
    assert (result.gaps, result.missing) == (0, 0)
    assert result.longest == pytest.approx(2000, rel=1e-3)
    periodic = np.delete(np.arange(100, dtype=np.int64) * 10_000_000, [50, 51])
    result = time_statistics(event, periodic)
    assert (result.gaps, result.missing) == (1, 2)


def test_latencies_are_matched_by_echoed_stamps(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        writer.add_topic("/effort_command", JOINT_STATE)
        for index in range(1, 200):
            stamp = index * 2_000_000
            writer.write("/joint_states", stamp + 100_000, encode_joint_state(stamp, position=1.0))
            writer.write(
                "/effort_command", stamp + 350_000, encode_joint_state(stamp, frame_id="lqr", effort=1.0)
            )
    statistics = bag_statistics(read_bag(path))
    (latency,) = statistics.latencies
    assert (latency.source, latency.answer, latency.matched) == ("/joint_states", "/effort_command", 199)
    assert latency.median == pytest.approx(0.25)


def test_tables_have_the_columns_of_the_arrays(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path, metadata={"seed": 1}) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.add_topic("/many", JOINT_STATE)
        writer.write("/a", 1, encode_joint_state(1, position=1.5, frame_id="x"))
        writer.write("/many", 1, joint_state(2, "", ["p", "q"], [1.0, 2.0], [], []))
    bag = read_bag(path)
    assert list(to_pandas(bag, "/a").columns) == [
        "log_time_ns", "stamp_ns", "position", "velocity", "effort", "frame_id",
    ]  # fmt: skip
    assert to_pandas(bag, "/many")["position"].tolist() == [[1.0, 2.0]]
    files = export_bag(bag, tmp_path / "csv", "csv")
    assert [file.name for file in files] == ["a.csv", "many.csv", "metadata.json"]
    assert files[0].read_text().splitlines()[1].startswith("1,1,1.5,,")
    with pytest.raises(ParameterError, match="format is 'xls'; expected one of parquet, csv"):
        export_bag(bag, tmp_path / "xls", "xls")
    with pytest.raises(BagError, match="exists already"):
        export_bag(bag, tmp_path / "csv", "csv")


def test_tables_leave_out_the_constants_of_a_type_and_keep_times_whole_without_messages(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bag"
    status = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
    message = status(level=1, name="n", message="m", hardware_id="h", values=[])
    with open_writer(path) as writer:
        writer.add_topic("/status", message.__msgtype__)
        writer.add_topic("/silent", "std_msgs/msg/String")
        writer.write("/status", 1, bytes(STORE.serialize_cdr(message, message.__msgtype__)))
    bag = read_bag(path)
    assert list(to_pandas(bag, "/status").columns) == [
        "log_time_ns", "level", "name", "message", "hardware_id", "values",
    ]  # fmt: skip
    assert to_pandas(bag, "/silent").dtypes.to_dict() == {"log_time_ns": np.dtype(np.int64)}


def test_parquet_reads_back(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", exc_type=ImportError)
    import pandas as pd

    path = tmp_path / "bag"
    with open_writer(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(10):
            writer.write("/a", index, encode_joint_state(index, position=0.1 * index))
    (file, _) = export_bag(read_bag(path), tmp_path / "out")
    assert pd.read_parquet(file)["position"].tolist() == [0.1 * index for index in range(10)]


def test_databases_of_the_first_rosbag2_versions_are_read(tmp_path: Path) -> None:
    """Schema 1 had neither QoS nor definitions nor hashes; its metadata was version 2."""
    path = tmp_path / "old"
    path.mkdir()
    connection = sqlite3.connect(path / "old_0.db3")
    connection.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        "serialization_format TEXT NOT NULL)"
    )
    connection.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
        "data BLOB NOT NULL)"
    )
    connection.execute("INSERT INTO topics VALUES(7, '/a', ?, 'cdr')", (JOINT_STATE,))
    for index in range(2000):
        data = encode_joint_state(index, position=float(index))
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(7, ?, ?)", (index, data))
    connection.commit()
    connection.close()
    bag = read_bag(path)
    assert bag.damage == ["metadata.yaml is missing"]
    assert bag["/a"]["position"].tolist() == [float(index) for index in range(2000)]


def test_rows_that_were_deleted_and_moved_are_read_as_sqlite_has_them(tmp_path: Path) -> None:
    """A database that others have worked on: holes, rewritten pages, small integers, an index."""
    path = tmp_path / "bag"
    with open_writer(path, "sqlite3") as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(5000):
            writer.write("/a", index, encode_joint_state(index, position=float(index)))
    connection = sqlite3.connect(path / "bag_0.db3")
    connection.execute("DELETE FROM messages WHERE id % 3 = 0")
    connection.execute("UPDATE messages SET timestamp = timestamp - 100 WHERE id < 1000")
    connection.commit()
    expected = [row[0] for row in connection.execute("SELECT timestamp FROM messages ORDER BY timestamp, id")]
    connection.close()
    assert read_bag(path)["/a"]["log_time_ns"].tolist() == expected


def test_the_commands_print_tables_json_and_sentences(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bag"
    with open_writer(path, metadata={"run": {"seed": 1}}) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(100):
            writer.write(
                "/a", 1000 + index * 2_000_000, encode_joint_state(1 + index * 2_000_000, position=0.0)
            )
    assert info_main([str(path)]) == 0
    assert "/a" in (table := capsys.readouterr().out)
    assert "500.000" in table
    assert info_main([str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["topics"]["/a"]["count"] == 100
    assert document["metadata"] == {"run": {"seed": 1}}
    assert export_main([str(path), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("a.csv")
    assert info_main([str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_a_bag_whose_files_were_renamed_or_lost_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with open_writer(path, max_duration=1e-7) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(300):
            writer.write("/a", index, encode_joint_state(index, position=1.0))
            writer.seal()
    first, *_ = sorted(path.glob("*.mcap"))
    lost = read_bag(first)["/a"]
    first.unlink()
    bag = read_bag(path)
    assert "listed but missing: bag_0.mcap" in bag.damage
    assert len(bag["/a"]) == 300 - len(lost)
    (path / "metadata.yaml").unlink()
    assert "metadata.yaml is missing" in read_bag(path).damage
    shutil.rmtree(path)
    path.mkdir()
    with pytest.raises(BagError, match="is no bag"):
        read_bag(path)
