"""Rerun's own check of MCAP files opens our bags and finds nothing to say about them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapLibraryWriter

from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_readers import ENDLESS_WRITER, JOINT_STATE, STRING, state, text_message
from pendulum_testing.fixtures import PROJECT, in_repository
from pendulum_testing.rerun_reader import RerunMcap

PERIOD = 2_000_000
"""Time between two states [ns]."""


def killed_bag(bag: Path) -> None:
    """Leave what a recorder leaves that is killed between two commits, or in one."""
    child = subprocess.Popen([sys.executable, "-c", ENDLESS_WRITER, str(bag), "mcap"], stdout=subprocess.PIPE)
    assert child.stdout is not None
    for line in child.stdout:
        if line != b"go\n" and int(line) > 5000:
            break
    child.kill()
    child.communicate()


@pytest.mark.parametrize("kind", ["closed", "growing", "compressed", "compressed growing", "split"])
def test_rerun_finds_all_messages_of_a_bag_in_order(tmp_path: Path, rerun_mcap: RerunMcap, kind: str) -> None:
    bag = tmp_path / "bag"
    writer = BagWriter(
        bag, compression="zstd" if "compressed" in kind else None, max_size=300_000 if kind == "split" else 0
    )
    for topic, type_name in (("/sim/joint_states", JOINT_STATE), ("/sim/events", STRING)):
        writer.add_topic(topic, type_name)
    for index in range(5000):
        writer.write("/sim/joint_states", index * PERIOD, state(index))
        if index % 100 == 0:
            writer.write("/sim/events", index * PERIOD, text_message("running"))
        if index % 50 == 0:
            writer.seal()
    if "growing" in kind:
        writer.seal()
    else:
        writer.close()
    files = sorted(bag.glob("*.mcap"))
    assert (len(files) > 2) == (kind == "split")
    totals = {"/sim/joint_states": 0, "/sim/events": 0}
    for file in files:
        issues = rerun_mcap.check(file)
        assert {*totals, "/sim/joint_states/position"} <= issues.keys()
        assert set(issues.values()) == {"—"}, issues
        for topic, count in rerun_mcap.counts(file).items():
            totals[topic] += count
    assert totals == {"/sim/joint_states": 5000, "/sim/events": 50}
    writer.abandon()


def test_rerun_opens_the_bag_of_a_killed_recorder(tmp_path: Path, rerun_mcap: RerunMcap) -> None:
    killed_bag(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    issues = rerun_mcap.check(file)
    assert set(issues.values()) == {"—"}, issues
    ours = read_bag(tmp_path / "bag")
    assert rerun_mcap.counts(file) == {topic: len(ours.raw(topic)) for topic in ours.topics}
    assert sum(len(ours.raw(topic)) for topic in ours.topics) > 5000


@in_repository
def test_rerun_takes_the_bags_of_the_examples_and_makes_recordings_of_them(
    tmp_path: Path, rerun_mcap: RerunMcap
) -> None:
    # Their log times are the plants' stamps, and the chunks of the simulator's overlap by one period.
    for file in sorted((PROJECT / "bags" / "examples").glob("*/*.mcap")):
        issues = rerun_mcap.check(file)
        assert set(issues.values()) == {"—"}, issues
        assert "/joint_states/position" in rerun_mcap.convert(file, tmp_path / f"{file.stem}.rrd")


def test_reruns_check_sees_what_would_be_wrong(tmp_path: Path, rerun_mcap: RerunMcap) -> None:
    path = tmp_path / "unordered.mcap"
    with path.open("wb") as stream:
        writer = McapLibraryWriter(stream, compression=CompressionType.NONE, chunk_size=2000)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "cdr", writer.register_schema(JOINT_STATE, "ros2msg", b""))
        for index in [*range(100, 200), *range(100)]:
            writer.add_message(channel, index * PERIOD, state(index), index * PERIOD)
        writer.finish()
    assert "unordered chunks" in rerun_mcap.check(path)["/a"]
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(AssertionError, match="summary is missing or corrupt"):
        rerun_mcap.check(path)
