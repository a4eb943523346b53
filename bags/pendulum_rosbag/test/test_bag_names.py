"""Topics under relative names or those of DDS, types by other names or none, and a topic that cannot be read."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from mcap.writer import Writer

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.convert.rewrite import Choice, rewrite
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.export_cli import main as export_main
from pendulum_rosbag.reader.info_cli import main as info_main
from pendulum_rosbag.reader.topic_info import ros_topic, ros_type
from pendulum_rosbag.storage import BagWriter, message_type
from pendulum_testing.bag_readers import JOINT_STATE, state

COUNT = 50
SERVICE = """service_msgs/ServiceEventInfo info
std_srvs/SetBool_Request[<=1] request
================================================================================
SRV: std_srvs/SetBool
bool data
---
bool success
"""


def write(path: Path, *topics: tuple[str, str, str, str], data: bytes | None = None) -> Path:
    """Write a file with some topics: name, type, encoding and text of its schema (none without a type)."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, kind, encoding, text in topics:
            schema = writer.register_schema(kind, encoding, text.encode()) if kind else 0
            channel = writer.register_channel(topic, "cdr", schema)
            for index in range(COUNT):
                writer.add_message(channel, index, data or state(index), index)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("stored", "kind", "name"),
    [
        ("joint_states", JOINT_STATE, "/joint_states"),
        ("sim/joint_states", JOINT_STATE, "/sim/joint_states"),
        ("rt/joint_states", "sensor_msgs::msg::dds_::JointState_", "/joint_states"),
        ("rt/sim/joint_states", "sensor_msgs::msg::JointState", "/sim/joint_states"),
        ("/joint_states", "sensor_msgs/JointState", "/joint_states"),
        ("/joint_states", "", "/joint_states"),
        ("rt/joint_states", "", "/joint_states"),
        ("rt/joint_states", JOINT_STATE, "/joint_states"),
    ],
)
def test_a_topic_is_found_by_its_full_name_and_by_the_one_that_was_stored(
    tmp_path: Path, stored: str, kind: str, name: str
) -> None:
    text = "module sensor_msgs { }" if "::" in kind else message_type(JOINT_STATE).definition
    file = write(tmp_path / "bag.mcap", (stored, kind, "omgidl" if "::" in kind else "ros2msg", text))
    with read_bag(file) as bag:
        assert list(bag) == [name]
        assert bag.topics[name].type == JOINT_STATE
        assert bag.array(name)["stamp_ns"].tolist() == bag.array(stored)["stamp_ns"].tolist()
        assert (stored in bag, name in bag, "/other" in bag) == (True, True, False)
    assert list(read_bag(file, [stored])) == [name]
    assert rewrite([file], tmp_path / "kept", Choice((name,))).messages == {stored: COUNT}


def test_two_topics_that_differ_in_a_slash_stay_two(tmp_path: Path) -> None:
    text = message_type(JOINT_STATE).definition
    topics = [(name, JOINT_STATE, "ros2msg", text) for name in ("/joint_states", "joint_states")]
    file = write(tmp_path / "bag.mcap", *topics)
    with read_bag(file) as bag:
        assert {name: info.count for name, info in bag.topics.items()} == {
            "/joint_states": COUNT,
            "joint_states": COUNT,
        }
    assert export_main([str(file), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    assert len(list((tmp_path / "out").glob("joint_states*.csv"))) == 2


def test_names_of_types_and_topics() -> None:
    assert ros_type("control_msgs::msg::dds_::DynamicJointState_") == "control_msgs/msg/DynamicJointState"
    assert ros_type("my_msgs/msg/Odd_") == "my_msgs/msg/Odd_"
    assert ros_topic("rt/a/b") == "/a/b"
    assert ros_topic("/rt/a") == "/rt/a"


@pytest.mark.parametrize("format", ["csv", "parquet"])
@pytest.mark.parametrize(
    ("kind", "encoding", "text", "reason"),
    [
        ("my_lab/msg/Secret", "", "", "expected a type that the bag or ROS 2 defines"),
        ("std_srvs/srv/SetBool_Event", "ros2msg", SERVICE, "is not one of ROS 2 messages"),
        ("sensor_msgs/msg/Imu", "ros2msg", "", "is no sensor_msgs/msg/Imu"),
        ("", "", "", "has no type in the bag"),
    ],
)
def test_a_topic_that_cannot_be_read_costs_that_topic_alone_and_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], format: str, kind: str, encoding: str, text: str, reason: str
) -> None:
    file = write(tmp_path / "bag.mcap", ("/odd", kind, encoding, text), data=b"\0\1\0\0abcd")
    good = write(
        tmp_path / "good.mcap", ("/joint_states", JOINT_STATE, "ros2msg", message_type(JOINT_STATE).definition)
    )
    bag = rewrite([file, good], tmp_path / "bag").path
    assert export_main([str(bag), "-o", str(tmp_path / "out"), "--format", format]) == 0
    told = capsys.readouterr().err
    assert told.count("left out: topic /odd") == 1
    assert reason in told
    assert "Could not parse" not in told
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"joint_states.{format}", "metadata.json"]
    if format == "csv":
        assert len(pd.read_csv(tmp_path / "out" / "joint_states.csv")) == COUNT
    assert info_main([str(bag)]) == 0
    assert len(read_bag(bag).load()["/joint_states"]) == COUNT
    for _ in range(2):
        # Nothing is left of an export of which nothing can be read.
        assert export_main([str(bag), "-t", "/odd", "-o", str(tmp_path / "none"), "--format", format]) == 2
        assert not (tmp_path / "none").exists()
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize("given", [".", "inside/.."])
def test_a_bag_given_by_where_one_is_keeps_its_name_as_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    bag = tmp_path / "monday"
    with BagWriter(bag) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        writer.write("/joint_states", 1, encode_joint_state(1, position=0.0))
    (bag / "inside").mkdir()
    monkeypatch.chdir(bag)
    with read_bag(rewrite([Path(given)], tmp_path / "out").path) as written:
        assert Path(written.metadata["pendulum.origin"][0]["bag"]).name == "monday"
