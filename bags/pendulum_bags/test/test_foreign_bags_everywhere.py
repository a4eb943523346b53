"""What ``info`` shows, every command takes: relative topics, names of DDS, unset stamps, a clock that steps."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.commands.analyse_cli import main as analyse_main
from pendulum_bags.commands.compare_cli import main as compare_main
from pendulum_bags.commands.identify_cli import main as identify_main
from pendulum_bags.commands.replay_cli import main as replay_main
from pendulum_bags.commands.report_cli import main as report_main
from pendulum_bags.comparison import compare_runs
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.convert.convert_cli import convert_main, cut_main, filter_main, merge_main
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.export_cli import main as export_main
from pendulum_rosbag.reader.info_cli import main as info_main
from pendulum_rosbag.storage import BagWriter, MessageType, message_type

EXAMPLES = Path(__file__).parents[2] / "examples"
Message = tuple[str, int, bytes]
_LATER = 100 * 10**9


def same(value: Any) -> Any:
    return value


def changed(
    path: Path,
    name: str,
    *,
    change: Callable[[Message], Message] = same,
    named: Callable[[str], str] = same,
    kinds: dict[str, MessageType] | None = None,
) -> Path:
    """Write an example's messages again, changed, under other names of topics and types."""
    with read_bag(EXAMPLES / name) as bag, BagWriter(path, metadata=bag.metadata) as writer:
        rows = [(time, topic, data) for topic in bag for time, data in bag.raw(topic)]
        rows.sort(key=lambda row: row[0])
        for topic, info in bag.topics.items():
            kind = (kinds or {}).get(info.type, message_type(info.type))
            writer.add_topic(named(topic), kind)
        for time, topic, data in rows:
            writer.write(named(topic), *change((topic, time, data))[1:])
    return path


def stamped(data: bytes, stamp_ns: int) -> bytes:
    return data[:4] + struct.pack("<iI", *divmod(stamp_ns, 10**9)) + data[12:]


def stepping_back(seconds: float, since_ns: int) -> Callable[[Message], Message]:
    """Return what moves log times and stamps of everything since a log time back."""

    def change(message: Message) -> Message:
        topic, time, data = message
        back = round(seconds * 1e9) * (time >= since_ns) - _LATER  # (a simulated clock would go below 0)
        if topic.endswith("/events"):
            content = json.loads(data[8:].split(b"\0")[0])
            text = json.dumps({**content, "stamp_ns": content["stamp_ns"] - back}).encode() + b"\0"
            return topic, time - back, data[:4] + struct.pack("<I", len(text)) + text
        if topic != "/clock":
            sec, nanosec = struct.unpack_from("<iI", data, 4)
            data = stamped(data, sec * 10**9 + nanosec - back)
        return topic, time - back, data

    return change


@pytest.mark.parametrize("seconds", [0.053, 1.7, 5.3])
def test_a_clock_that_stepped_back_changes_no_comparison_and_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: float
) -> None:
    sim, sound = EXAMPLES / "regulation_sim", EXAMPLES / "regulation_hw"
    with read_bag(sound) as bag:
        middle = (bag.start_ns + bag.stop_ns) // 2
    stepped = changed(tmp_path / "hw", "regulation_hw", change=stepping_back(seconds, middle))
    expected, found = compare_runs(sim, sound), compare_runs(sim, stepped)
    assert found.is_paired
    assert found.paired["position"]["count"] == expected.paired["position"]["count"]
    assert found.paired["rms_position"] == pytest.approx(expected.paired["rms_position"], rel=1e-3)
    assert found.delay == pytest.approx(expected.delay, abs=1e-4)
    assert compare_main([str(sim), str(stepped)]) == 0
    assert f"log times step back 2.490 s after the first of them, by {seconds:.3f} s" in capsys.readouterr().out


def unstamped(message: Message) -> Message:
    topic, time, data = message
    return (topic, time, data) if topic.endswith(("/events", "/clock")) else (topic, time, stamped(data, 0))


DDS_STATE = MessageType("sensor_msgs::msg::dds_::JointState_", "module sensor_msgs { }", "", "omgidl")


WAYS: dict[str, dict[str, Any]] = {
    "relative": {"named": lambda topic: topic.removeprefix("/")},
    "dds": {"named": lambda topic: f"rt{topic}", "kinds": {"sensor_msgs/msg/JointState": DDS_STATE}},
    "unstamped": {"change": unstamped},
}


@pytest.mark.parametrize("way", WAYS)
def test_every_command_takes_what_info_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str], way: str) -> None:
    bags = tmp_path / "bags"
    bags.mkdir()
    sim, hw = (changed(bags / name, f"regulation_{name}", **WAYS[way]) for name in ("sim", "hw"))
    assert info_main([str(hw)]) == 0
    shown = capsys.readouterr().out
    assert "/hw/joint_states" in shown
    assert compare_main([str(sim), str(hw)]) == 0
    out = tmp_path / "out"
    assert analyse_main([str(bags), "-o", str(out / "analyse")]) == 0
    assert identify_main([str(hw), "--no-page", "--friction", "viscous"]) in (0, 3)
    for effort in ("applied", "measured"):
        assert replay_main([str(hw), "--params", "thesis", "--effort", effort, "--out", str(out / effort)]) in (0, 1, 3)
    assert export_main([str(hw), "-o", str(out / "export"), "--format", "csv"]) == 0
    assert convert_main([str(hw), "-o", str(out / "convert"), "--storage", "sqlite3"]) == 0
    assert cut_main([str(hw), "-o", str(out / "cut"), "--from-event", "noise_start"]) == 0
    assert filter_main([str(hw), "-o", str(out / "filter"), "-t", "/hw/joint_states"]) == 0
    assert merge_main([str(sim), str(hw), "-o", str(out / "merge")]) == 0
    assert "error" not in capsys.readouterr().err
    with read_bag(out / "convert") as converted, read_bag(hw) as original:
        assert list(converted) == list(original)
        for topic in ("/hw/joint_states", "/hw/effort_command"):
            assert converted.raw(topic) == original.raw(topic)


def bare(path: Path, later: float, *, velocity: bool = True) -> Path:
    """Write a swing as a foreign recorder does: joint states alone, no events, no disturbance."""
    random = np.random.default_rng(round(1e3 * later))
    with BagWriter(path) as writer:
        writer.add_topic("joint_states", message_type("sensor_msgs/msg/JointState"))
        for index in range(2000):
            t = 0.005 * index
            angle = 0.4 * np.sin(4.0 * (t - later)) + 0.3 * np.sin(2.3 * (t - later)) + random.normal(0.0, 1e-3)
            speed = 1.6 * np.cos(4.0 * (t - later)) + 0.69 * np.cos(2.3 * (t - later)) if velocity else None
            stamp = _LATER + index * 5_000_000
            writer.write("joint_states", stamp, encode_joint_state(stamp, position=angle, velocity=speed))
    return path


@pytest.mark.parametrize("velocity", [True, False])
def test_two_bags_without_noise_are_compared_as_a_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], velocity: bool
) -> None:
    one, other = (bare(tmp_path / name, later, velocity=velocity) for name, later in (("a", 0.0), ("b", 0.02)))
    result = compare_runs(one, other)
    # Nothing but the motions brings them to one clock, which the distance of 20 ms shows.
    assert result.pairs[0].simulation.window.t.size == pytest.approx(2000, abs=5)
    assert re.search(r"is moved by -0\.0(19|20|21) s, where neither has an input", " ".join(result.notes))
    assert not result.is_paired
    assert compare_main([str(one), str(other)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Undecided: neither has an input" in shown
    # What needs a disturbance is not asked of bags without one.
    assert f"frequency_response {one}" not in shown
    assert "Not computed: it needs what was added to the torque" in shown


def test_a_report_of_one_bag_says_what_it_is_and_what_shows_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report_main([str(EXAMPLES / "regulation_hw")]) == 2
    assert "regulation_hw is one bag; expected run folders, or two bags" in " ".join(capsys.readouterr().err.split())


def test_a_bag_of_two_plants_says_how_to_keep_one_and_that_works(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both, one = tmp_path / "both", tmp_path / "one"
    parts = [str(EXAMPLES / name) for name in ("regulation_sim", "regulation_hw")]
    assert merge_main([*parts, "-o", str(both)]) == 0
    assert identify_main([str(both), "--no-page"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"`pendulum filter {both} --regex '^/hw/' -o FOLDER`" in said
    assert filter_main([str(both), "--regex", "^/hw/", "-o", str(one)]) == 0
    assert read_recording(one).time.size == 501
