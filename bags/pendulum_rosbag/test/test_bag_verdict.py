"""The line of ``info`` that says whether a recording is good, and why not; and hints for bags of ROS 1."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.convert.convert_cli import convert_main
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.info_cli import main as info_main
from pendulum_rosbag.reader.joint_state import two_motions
from pendulum_rosbag.reader.statistics import time_statistics
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_readers import JOINT_STATE, STRING, text_message

BEGIN = 1_700_000_000 * 10**9
PERIOD = 10_000_000


def write(bag: Path, times: list[int], *, stamped: bool = True, back: int = 0) -> Path:
    """Write states, their answers 1 ms later, and rare events at no regular times; ``back`` [ns] from the middle on."""
    with BagWriter(bag) as writer:
        writer.add_topic("/sim/joint_states", JOINT_STATE)
        writer.add_topic("/sim/effort_command", JOINT_STATE)
        writer.add_topic("/sim/events", STRING)
        for index, time in enumerate(times):
            now = BEGIN + time - back * (index >= len(times) // 2)
            stamp = now if stamped else 0
            writer.write("/sim/joint_states", now, encode_joint_state(stamp, position=0.1, velocity=0.0, effort=0.0))
            writer.write("/sim/effort_command", now + 1_000_000, encode_joint_state(stamp, effort=0.0))
            if index in (3, 40, 41, 90, 200, 390):
                writer.write("/sim/events", now, text_message('{"name": "x"}'))
    return bag


REGULAR = [index * PERIOD for index in range(400)]


@pytest.mark.parametrize(
    ("times", "more", "words"),
    [
        (REGULAR, {}, []),
        ([time + (time >= REGULAR[200]) * 2 * 10**9 for time in REGULAR], {}, ["nothing for 2.010 s"]),
        ([time for time in REGULAR if time % (7 * PERIOD)], {}, ["56 messages are missing between 342"]),
        (REGULAR, {"stamped": False}, ["400 of 400 messages on /sim/joint_states have no stamp"]),
        (
            REGULAR,
            {"back": 5_300_000_000},
            ["log times step back 1.990 s after the first of them, by 5.300 s", "stamps on /sim/"],
        ),
    ],
    ids=["good", "pause", "missing", "unset", "clock"],
)
def test_one_line_says_whether_a_recording_is_good_and_why_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], times: list[int], more: dict[str, int], words: list[str]
) -> None:
    bag = write(tmp_path / "bag", times, **more)  # type: ignore[arg-type]
    assert info_main([str(bag)]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("recording: "))
    assert line.startswith("recording: NOT GOOD: " if words else "recording: good")
    assert [word for word in words if word not in line] == [], line
    assert info_main([str(bag), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert bool(content["problems"]) == bool(words)
    # Events have no period that could leave gaps, and stamps that were never set no latency.
    assert content["topics"]["/sim/events"]["gaps"] == 0
    assert bool(content["latencies"]) == more.get("stamped", True)
    assert all(latency["median"] == pytest.approx(1.0) for latency in content["latencies"])


def test_gaps_are_those_of_a_period_however_many_messages_are_lost() -> None:
    rng = np.random.default_rng(3)
    events = np.sort(rng.uniform(0.0, 1e11, 60)).astype(np.int64)
    assert time_statistics(STRING, events).gaps == 0
    kept = np.sort(rng.choice(2000, 1500, replace=False)).astype(np.int64) * PERIOD
    assert time_statistics(JOINT_STATE, kept, kept + 1).missing == pytest.approx(500, abs=5)


def test_a_ros_1_bag_gets_the_command_that_reads_it_killed_or_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    path = tmp_path / "run.bag"
    with Writer(path) as writer:
        connection = writer.add_connection("/chatter", STRING, typestore=store)
        message = store.types[STRING](data="x" * 100)
        for index in range(100):
            writer.write(connection, BEGIN + index, store.serialize_ros1(message, STRING))
    assert info_main([str(path)]) == 2
    assert f"pendulum convert {path}" in " ".join(capsys.readouterr().err.split())
    assert convert_main([str(path), "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    for name in ("killed.bag", "killed.bag.active"):
        killed = tmp_path / name
        killed.write_bytes(path.read_bytes()[:4096] + path.read_bytes()[4117:9000])
        for main, more in ((convert_main, ["-o", str(tmp_path / "no")]), (info_main, [])):
            assert main([str(killed), *more]) == 2
        told = " ".join(capsys.readouterr().err.split())
        assert f"rosbag reindex {killed}" in told
        assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("share", [2, 5])
def test_two_machines_on_one_topic_are_refused_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], share: int
) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        for index, time in enumerate(REGULAR):
            now = BEGIN + time
            angle = 0.3 * np.sin(2e-9 * time) + 0.4 * (index % share == 0)
            writer.write("/joint_states", now, encode_joint_state(now, position=angle, velocity=0.0))
    assert info_main([str(bag)]) == 0
    assert "/joint_states: holds two motions" in " ".join(capsys.readouterr().out.split())
    with read_bag(bag) as opened, pytest.raises(DataError, match=r"two motions \(\d+ of 400 messages jump by 0.4 rad"):
        opened.array("/joint_states")
    with read_bag(bag) as opened, pytest.raises(DataError, match="two motions"):
        opened.joints("/joint_states")


def test_noise_ticks_wraps_and_spikes_are_one_motion() -> None:
    random = np.random.default_rng(2)
    time = np.arange(0.0, 10.0, 0.01)
    swing = 2.5 * np.sin(3.0 * time)
    spikes = swing + 0.5 * (np.arange(time.size) % 50 == 7)
    wrapped = np.angle(np.exp(1j * (np.pi + 0.02 * random.standard_normal(time.size))))
    ticks = 0.006 * random.integers(0, 2, time.size)
    degrees = 0.36 / 0.006 * ticks - 102.6  # of 1000 counts a turn
    for angle in (
        swing,
        spikes,
        wrapped,
        ticks,
        degrees,
        random.normal(0.0, 0.3, time.size),
        np.full(time.size, np.nan),
    ):
        assert two_motions(angle) == ""
