"""Bags as arrays: the same as rosbags reads, message by message, for every writer and storage."""

from __future__ import annotations

import random
import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from pendulum_msgs_py.contract.cdr import encode_joint_state, encode_joints
from pendulum_msgs_py.errors import BagError, DataError
from pendulum_rosbag.reader import read_bag, read_bags, same_messages
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, STORE, assert_equals_rosbags, joint_state, mixed_messages


@pytest.mark.parametrize(("storage", "compression"), [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)])
def test_our_bags_read_as_rosbags_reads_them(tmp_path: Path, storage: str, compression: str | None) -> None:
    rng = random.Random(2)
    path = tmp_path / "bag"
    with BagWriter(path, storage, compression) as writer:
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
    assert_equals_rosbags(bag, path)
    for file in path.glob("*.mcap" if plugin == StoragePlugin.MCAP else "*.db3"):
        # One file alone, as people send them: nothing but its content says that messages are compressed.
        alone = read_bag(shutil.copy(file, tmp_path))
        assert same_messages(alone, bag)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("variant", ["all", "no_index", "no_chunks", "no_summary"])
def test_files_of_the_mcap_library_read_the_same(tmp_path: Path, compression: CompressionType, variant: str) -> None:
    path = library_file(tmp_path / "alone.mcap", compression, variant)
    bag = read_bag(path)
    assert not bag.damage
    assert_equals_rosbags(bag, path)


@pytest.mark.parametrize("variant", ["no_channels", "no_schemas"])
def test_a_summary_that_leaves_out_topics_hides_no_message(tmp_path: Path, variant: str) -> None:
    """The format allows that topics, or their types, are told beside the messages only; rosbags reads no such file."""
    bag = read_bag(library_file(tmp_path / "bare.mcap", CompressionType.ZSTD, variant))
    assert not bag.damage
    assert same_messages(bag, read_bag(library_file(tmp_path / "all.mcap", CompressionType.ZSTD, "all")))


def library_file(path: Path, compression: CompressionType, variant: str) -> Path:
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
            repeat_channels=variant not in ("no_summary", "no_channels"),
            repeat_schemas=variant not in ("no_summary", "no_schemas"),
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
    return path


def _no_index() -> Any:
    from mcap.writer import IndexType

    return IndexType.NONE


def test_a_time_span_is_cut_on_both_sides(tmp_path: Path) -> None:
    for storage, compression in (("mcap", None), ("mcap", "zstd"), ("sqlite3", None)):
        path = tmp_path / f"{storage}{compression}"
        with BagWriter(path, storage, compression) as writer:
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
    with BagWriter(path) as writer:
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


@pytest.mark.parametrize("name", ["notes.txt", "notes.zstd", "notes.txt.zstd"])
def test_a_file_is_known_for_a_bags_by_what_it_is_called(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(zstandard.compress(b"no bag"))
    with pytest.raises(BagError, match=rf"{name} is no storage file of a bag; expected \.mcap or \.db3"):
        read_bag(tmp_path / name)


def test_states_of_several_joints_come_as_objects(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.write("/a", 1, joint_state(1, "", ["pendulum_joint"], [1.0], [2.0], [3.0]))
        writer.write("/a", 2, joint_state(2, "", ["p", "q"], [1.0, 2.0], [], []))
    stored = read_bag(path)["/a"]
    assert [list(item.message.name) for item in stored] == [["pendulum_joint"], ["p", "q"]]
    with pytest.raises(DataError, match="expected sensor_msgs/msg/JointState of one joint"):
        read_bag(path).array("/a")


@pytest.mark.parametrize("names", [["p", "q"], ["p"] * 9000 + ["q"]], ids=["from the first", "in a later block"])
def test_joints_that_take_turns_are_not_taken_for_one(tmp_path: Path, names: list[str]) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for time, name in enumerate(names):
            writer.write("/a", time, joint_state(time, "", [name], [1.0], [2.0], [3.0]))
    with pytest.raises(DataError, match="holds sensor_msgs/msg/JointState of 2 joints that take turns: p, q; "):
        read_bag(path).array("/a")


def test_bytes_behind_the_message_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
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
    texts = ['{"stamp_ns": 30, "name": "hold"}', '{"stamp_ns": 10, "name": "ramp_up", "target": 3.14}', "plain"]
    with BagWriter(path) as writer:
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
        with BagWriter(tmp_path / str(number)) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(100):
                writer.write("/a", index, encode_joint_state(index, position=float(number)))
    bags = read_bags([tmp_path / str(number) for number in range(5)])
    assert [float(bag["/a"]["position"].mean()) for bag in bags] == [0.0, 1.0, 2.0, 3.0, 4.0]


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
    with BagWriter(path, "sqlite3") as writer:
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


def test_a_bag_whose_files_were_renamed_or_lost_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, max_duration=1e-7) as writer:
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


def test_joints_are_read_by_their_names_in_whatever_order_a_message_has_them(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/many", "sensor_msgs/msg/JointState")
        for stamp, names, values in ((2, ("p", "q"), (1.0, 2.0)), (3, ("q", "p"), (4.0, 3.0))):
            writer.write("/many", stamp, encode_joints(stamp, "", names, values))
    with read_bag(path) as bag:
        assert bag.joints("/many").position.tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize(
    ("names", "problem"),
    [(["q", "r"], "message 1 is of q, r; expected p, q"), (["p"], "message 1 is of p; expected p, q")],
)
def test_joints_that_change_from_message_to_message_are_no_arrays(
    tmp_path: Path, names: list[str], problem: str
) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/many", "sensor_msgs/msg/JointState")
        writer.write("/many", 1, encode_joints(2, "", ("p", "q"), (1.0, 2.0)))
        writer.write("/many", 2, encode_joints(3, "", tuple(names), (1.0, 2.0)[: len(names)]))
    with read_bag(path) as bag, pytest.raises(DataError, match=problem):
        bag.joints("/many")
