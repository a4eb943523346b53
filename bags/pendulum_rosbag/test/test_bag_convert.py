"""Bags made of bags: nothing is lost on the way, and what is chosen is what was asked for."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapLibraryWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.programs.executables import run_package
from pendulum_rosbag.convert import rewrite as rewrite_module
from pendulum_rosbag.convert.convert_cli import convert_main, cut_main, filter_main, merge_main
from pendulum_rosbag.convert.rewrite import Choice, rewrite
from pendulum_rosbag.executables import COMMANDS, EXECUTABLES
from pendulum_rosbag.reader import read_bag, same_messages
from pendulum_rosbag.storage import BagWriter, QosProfile
from pendulum_testing.bag_messages import STORE, mixed_messages
from pendulum_testing.bag_readers import JOINT_STATE, STRING, count_everywhere, text_message

SECOND = 1_000_000_000


def a_bag(path: Path, kind: str, prefix: str = "/sim", seed: int = 3) -> Path:
    """Write 600 messages, not in the order of their log times: in each storage, by each kind of recorder."""
    messages = [
        (topic.replace("/sim", prefix), time, data) for topic, time, data in mixed_messages(random.Random(seed), 600)
    ]
    random.Random(seed).shuffle(messages)
    if kind == "packed messages":
        library = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
        library.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        with library:
            topics = sorted({topic for topic, _, _ in messages})
            connections = {topic: library.add_connection(topic, JOINT_STATE, typestore=STORE) for topic in topics}
            for topic, time, data in messages:
                library.write(connections[topic], time, data)
        return path
    storage, _, compression = kind.partition(" ")
    writer = BagWriter(
        path,
        storage,
        compression if compression == "zstd" else None,
        {"seed": seed, "pendulum.run": {"side": prefix}},
        max_size=40_000 if compression == "split" else 0,
    )
    for topic in sorted({topic for topic, _, _ in messages}):
        writer.add_topic(topic, JOINT_STATE, QosProfile(reliability="best_effort"))
    for number, item in enumerate(messages):
        writer.write(*item)
        if number % 50 == 49:
            writer.seal()
    writer.seal()
    if compression == "growing":
        writer.abandon()
    else:
        writer.close()
    return path


KINDS = ["mcap", "mcap zstd", "mcap split", "mcap growing", "sqlite3", "sqlite3 split", "packed messages"]


@pytest.mark.parametrize(
    ("kind", "target"),
    [*((kind, "mcap") for kind in KINDS), ("mcap", "mcap zstd"), *((kind, "sqlite3") for kind in KINDS[1:5])],
)
def test_a_converted_bag_holds_the_same_in_order_of_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, target: str
) -> None:
    monkeypatch.setattr(rewrite_module, "_WINDOW_BYTES", 20_000)  # several windows in a small bag
    source = a_bag(tmp_path / "source", kind)
    storage, _, compression = target.partition(" ")
    report = rewrite([source], tmp_path / "out", storage=storage, compression=compression or None)
    before, after = read_bag(source), read_bag(tmp_path / "out")
    assert same_messages(before, after)
    assert sum(report.messages.values()) == 600
    assert set(count_everywhere(tmp_path / "out")) == {600}
    assert {name: info.qos for name, info in after.topics.items()} == {
        name: info.qos for name, info in before.topics.items()
    }
    assert all(info.hash.startswith("RIHS01_") for info in after.topics.values())
    if kind != "packed messages":
        assert after.metadata["pendulum.run"] == {"side": "/sim"}
    if storage == "mcap":
        with next((tmp_path / "out").glob("*.mcap")).open("rb") as stream:
            times = [m.log_time for *_, m in make_reader(stream).iter_messages(log_time_order=False)]
        assert times == sorted(times)


def test_a_bag_of_ros_1_becomes_one_of_ros_2(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    state, header, time = (
        store.types[name] for name in (JOINT_STATE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    writer = Ros1Writer(tmp_path / "old.bag")
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for index in range(20):
            message = state(
                header(index, time(5, index), "x"), ["joint"], np.array([0.1 * index]), np.ones(1), np.zeros(1)
            )
            writer.write(connection, 5 * SECOND + index, bytes(store.serialize_ros1(message, JOINT_STATE)))
    rewrite([tmp_path / "old.bag"], tmp_path / "new")
    found = read_bag(tmp_path / "new").array("/joint_states")
    np.testing.assert_array_equal(found["position"], 0.1 * np.arange(20))
    assert found["stamp_ns"].tolist() == [5 * SECOND + index for index in range(20)]
    (tmp_path / "none.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(BagError, match=r"none\.bag cannot be converted"):
        rewrite([tmp_path / "none.bag"], tmp_path / "never")


def test_merged_bags_are_interleaved_and_tell_what_each_said_of_its_run(tmp_path: Path) -> None:
    sim = a_bag(tmp_path / "sim", "mcap zstd", "/sim", 3)
    hw = a_bag(tmp_path / "hw", "sqlite3", "/hw", 4)
    rewrite([sim, hw], tmp_path / "both")
    both = read_bag(tmp_path / "both")
    for bag in (read_bag(sim), read_bag(hw)):
        for topic in bag.topics:
            assert both.raw(topic) == bag.raw(topic)
    assert both.metadata["pendulum.merged"]["hw"] == {"seed": 4, "pendulum.run": {"side": "/hw"}}
    assert "seed" not in both.metadata  # they disagree
    assert [entry["bag"] for entry in both.metadata["pendulum.origin"]] == [str(sim), str(hw)]
    # Two of one name, with topics of one name: all messages, and both told apart by their paths.
    twin = a_bag(tmp_path / "tuesday" / "sim", "mcap", "/sim", 5)
    rewrite([sim, twin], tmp_path / "twins")
    twins = read_bag(tmp_path / "twins")
    assert sum(info.count for info in twins.topics.values()) == 1200
    assert set(twins.metadata["pendulum.merged"]) == {str(sim), str(twin)}


def test_metadata_of_merged_bags_are_what_each_bag_reads_as(tmp_path: Path) -> None:
    odd = {"nested": "[" * 100_000, "none": "NaN", "number": "3"}
    for name in ("one", "two"):
        with BagWriter(tmp_path / name, metadata={**odd, "name": name}) as writer:
            writer.add_topic("/text", STRING)
            writer.write("/text", 1, text_message(name))
    rewrite([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    merged = read_bag(tmp_path / "both").metadata["pendulum.merged"]
    assert merged["one"] == read_bag(tmp_path / "one").metadata == {**odd, "number": 3, "name": "one"}


def test_bags_that_disagree_about_a_type_are_not_merged(tmp_path: Path) -> None:
    sim = a_bag(tmp_path / "sim", "mcap")
    with BagWriter(tmp_path / "other") as writer:
        writer.add_topic("/sim/joint_states", STRING)
        writer.write("/sim/joint_states", 1, text_message("x"))
    with pytest.raises(BagError, match=r"other: topic /sim/joint_states has type std_msgs/msg/String; the bag"):
        rewrite([sim, tmp_path / "other"], tmp_path / "both")
    assert not (tmp_path / "both").exists()


def test_a_cut_is_by_time_or_by_events(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "run"
    with BagWriter(bag, metadata={"seed": 1}) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.add_topic("/events", STRING)
        for index in range(100):
            time = 50 * SECOND + index * 10_000_000
            if index in (20, 60, 80):
                name = {20: "noise_start", 60: "noise_end", 80: "noise_end"}[index]
                writer.write("/events", time, text_message(json.dumps({"stamp_ns": 0, "name": name})))
            writer.write("/a", time, encode_joint_state(index, position=0.0))

    def kept(name: str) -> list[int]:
        return [int(stamp) for stamp in read_bag(tmp_path / name)["/a"]["stamp_ns"]]

    assert cut_main([str(bag), "-o", str(tmp_path / "one"), "--start", "0.25", "--stop", "0.5"]) == 0
    assert kept("one") == list(range(25, 50))
    events = ["--from-event", "noise_start", "--to-event", "noise_end"]
    assert cut_main([str(bag), "-o", str(tmp_path / "two"), *events, "--json"]) == 0
    assert kept("two") == list(range(20, 81))
    assert '"/events": 3' in capsys.readouterr().out
    assert cut_main([str(bag), "-o", str(tmp_path / "three"), "--stop", "0.1"]) == 0
    assert kept("three") == list(range(10))
    assert read_bag(tmp_path / "three").metadata["seed"] == 1
    for arguments, message in (
        (["--from-event", "noise"], "has no event 'noise'; it has noise_end, noise_start"),
        (["--start", "5"], "no message is among what was chosen"),
        (["--start", "nan"], "start is nan s; expected >= 0 s"),
        (["--start", "2", "--stop", "1"], "is -1 s long; expected more than 0 s"),
        (["--start", "2", "--from-event", "noise_start"], "for one end of the span"),
        ([], "no span was given"),
    ):
        assert cut_main([str(bag), "-o", str(tmp_path / "never"), *arguments]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "never").exists()


def test_topics_are_filtered_by_name_and_pattern(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = a_bag(tmp_path / "sim", "mcap")
    chosen = ["-t", "/sim/disturbance", "--regex", "command$"]
    assert filter_main([str(bag), "-o", str(tmp_path / "some"), *chosen]) == 0
    assert sorted(read_bag(tmp_path / "some").topics) == ["/sim/disturbance", "/sim/effort_command"]
    assert filter_main([str(bag), "-o", str(tmp_path / "rest"), "--exclude", "command$"]) == 0
    assert sorted(read_bag(tmp_path / "rest").topics) == ["/sim/disturbance", "/sim/joint_states"]
    assert filter_main([str(bag), "-o", str(tmp_path / "never"), "-t", "/typo"]) == 2
    assert "no topic /typo; expected one of /sim/disturbance, /sim/effort_command" in capsys.readouterr().err
    assert filter_main([str(bag), "-o", str(tmp_path / "never")]) == 2
    assert filter_main([str(bag), "-o", str(tmp_path / "some"), "--exclude", "x"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert len(read_bag(tmp_path / "some")["/sim/disturbance"])  # nothing of it was touched


def test_attachments_go_along_or_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lab.mcap"
    with path.open("wb") as stream:
        writer = McapLibraryWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("foxglove.Log", "protobuf", bytes(range(256)))
        channel = writer.register_channel("/log", "protobuf", schema)
        writer.add_message(channel, 5, b"\xff", 5)
        writer.add_attachment(1, 1, "rig.yaml", "text/yaml", b"x: 1\n")
        writer.finish()
    rewrite([path], tmp_path / "out", compression="zstd")
    with (tmp_path / "out" / "out_0.mcap").open("rb") as stream:
        assert [item.name for item in make_reader(stream).iter_attachments()] == ["rig.yaml"]
    assert convert_main([str(path), "-o", str(tmp_path / "database"), "--storage", "sqlite3"]) == 0
    assert "LEFT OUT: storage sqlite3 has no place for 'rig.yaml'" in capsys.readouterr().out
    assert read_bag(tmp_path / "database").raw("/log") == [(5, b"\xff")]


def test_a_damaged_bag_is_converted_as_far_as_it_goes_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = a_bag(tmp_path / "sim", "mcap")
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:40_000])
    assert convert_main([str(bag), "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "found: " in out
    assert "no footer" in out
    assert not read_bag(tmp_path / "out").damage


def test_wrong_use_is_refused_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = a_bag(tmp_path / "sim", "mcap")
    assert merge_main([str(bag), "-o", str(tmp_path / "out")]) == 2
    assert "1 bag was named; expected at least 2" in capsys.readouterr().err
    assert convert_main([str(bag), "-o", str(tmp_path / "out"), "--storage", "tape"]) == 2
    assert "storage is 'tape'" in capsys.readouterr().err
    assert convert_main([str(tmp_path / "none"), "-o", str(tmp_path / "out")]) == 2
    with pytest.raises(ParameterError, match="regular expression"):
        Choice(regex="(")
    with pytest.raises(DataError, match="no topic /b"):
        rewrite([bag], tmp_path / "out", Choice(("/b",)))
    assert not (tmp_path / "out").exists()


def test_commands_hide_no_program_of_the_system(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not COMMANDS.keys() & EXECUTABLES.keys()
    for package in ("pendulum_bags", "pendulum_rosbag"):
        assert run_package(package, ["cut", "--help"]) == 0
        assert "--from-event" in capsys.readouterr().out
