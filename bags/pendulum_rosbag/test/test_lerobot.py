"""Bags as a dataset of LeRobot: each frame is a state and the torque that answered it, as the format wants them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.export_cli import main as export_main
from pendulum_rosbag.reader.lerobot import episodes_of, export_lerobot
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, joint_state
from pendulum_testing.fixtures import PROJECT, in_repository

EXAMPLES = PROJECT / "bags" / "examples"
PERIOD = 2_000_000
JOINT = ["pendulum_joint"]


def write(path: Path, states: list[int], commands: list[int], joints: list[str] = JOINT) -> Path:
    """Write a bag whose state at k periods is k, k / 10 and k / 100 in each joint, and whose answer to it is -k."""
    writer = BagWriter(path)
    for topic in ("/lab/joint_states", "/lab/effort_command"):
        writer.add_topic(topic, JOINT_STATE, [])
    for k in states:
        values = [[value + index for index in range(len(joints))] for value in (k, k / 10, k / 100)]
        data = joint_state(k * PERIOD, "", joints, *values)
        writer.write("/lab/joint_states", k * PERIOD + 5, data)
    for k in commands:
        data = joint_state(k * PERIOD, "lqr", joints, [], [], [-float(k)] * len(joints))
        writer.write("/lab/effort_command", k * PERIOD + 9, data)
    writer.close()
    return path


def test_a_frame_has_the_command_that_bears_the_stamp_of_its_state_or_else_the_one_that_was_held(
    tmp_path: Path,
) -> None:
    # Nobody answers before 10 and after 40; the answer to 20 is missing.
    with read_bag(write(tmp_path / "bag", [*range(60)], [k for k in range(10, 41) if k != 20])) as bag:
        (episode,) = episodes_of(bag, 500)
        (slow,) = episodes_of(bag, 250)
    assert episode.state[:, 0].tolist() == [*range(10, 41)]
    assert episode.state[:, 1] == pytest.approx(np.arange(10, 41) / 10)
    assert episode.effort[:, 0] == pytest.approx(np.arange(10, 41) / 100)
    assert (-episode.action[:, 0]).tolist() == [19.0 if k == 20 else float(k) for k in range(10, 41)]
    assert slow.state[:, 0].tolist() == [*range(10, 41, 2)]


def test_a_short_hole_is_bridged_by_the_nearest_state_and_a_long_one_ends_the_episode(tmp_path: Path) -> None:
    states = [k for k in range(200) if k not in {50, 51} and not 100 <= k < 150]
    with read_bag(write(tmp_path / "bag", states, states)) as bag:
        first, second = episodes_of(bag, 500)
    assert first.state[48:54, 0].tolist() == [48, 49, 49, 52, 52, 53]
    # Up to five periods from the nearest state.
    assert first.state[-1, 0] == 99
    assert len(first.state) == 105
    assert second.state[0, 0] == 150
    assert len(second.state) == 55


@in_repository
def test_recordings_become_one_dataset_that_says_what_its_columns_are(tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    bags = [str(EXAMPLES / name) for name in ("regulation_sim", "regulation_hw")]
    assert export_main([*bags, "-o", str(out), "--format", "lerobot", "--task", "stand"]) == 0
    info = json.loads((out / "meta/info.json").read_text(encoding="utf-8"))
    frames = pyarrow.parquet.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    episodes = pyarrow.parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    # The hardware's 100 Hz, since the simulation's 500 Hz are not in its states.
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 100, 2)
    assert info["total_frames"] == len(frames) == sum(row["length"] for row in episodes)
    assert set(frames.column_names) == set(info["features"])
    assert info["features"]["observation.state"]["names"] == ["pendulum_joint.position", "pendulum_joint.velocity"]
    assert frames.schema.field("observation.state").type == pyarrow.list_(pyarrow.float32(), 2)
    assert frames.schema.field("action").type == pyarrow.float32()
    assert frames["index"].to_pylist() == [*range(len(frames))]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [(0, 501), (501, 1002)]
    assert [row["tasks"] for row in episodes] == [["stand"], ["stand"]]
    times = frames["timestamp"].to_numpy()[501:]
    assert times == pytest.approx(np.arange(501) / 100.0, abs=1e-6)
    tasks = pyarrow.parquet.read_table(out / "meta/tasks.parquet").to_pandas()
    assert tasks.loc["stand", "task_index"] == 0
    # The numbers are those of the bag, to the precision of the format.
    with read_bag(bags[1]) as bag:
        states, commands = bag.joints("/hw/joint_states"), bag.joints("/hw/effort_command")
    angles = np.array(frames["observation.state"].to_pylist())[501:, 0]
    assert angles == pytest.approx(states.position[:, 0], abs=1e-6)
    assert frames["action"].to_numpy()[501:] == pytest.approx(commands.effort[:, 0], abs=1e-6)
    stats = json.loads((out / "meta/stats.json").read_text(encoding="utf-8"))
    assert stats["action"]["count"] == [1002]
    assert stats["action"]["max"][0] == pytest.approx(frames["action"].to_numpy().max())
    assert episodes[1]["stats/action/max"][0] == pytest.approx(frames["action"].to_numpy()[501:].max())


def test_several_joints_are_columns_and_other_joints_no_part_of_the_dataset(tmp_path: Path) -> None:
    acrobot = write(tmp_path / "two", [*range(9)], [*range(9)], ["shoulder", "elbow"])
    one = write(tmp_path / "one", [*range(9)], [*range(9)])
    export_lerobot([read_bag(acrobot)], tmp_path / "dataset")
    frames = pyarrow.parquet.read_table(tmp_path / "dataset/data/chunk-000/file-000.parquet")
    assert frames["observation.state"].to_pylist()[3] == pytest.approx([3.0, 4.0, 0.3, 1.3])
    assert frames["action"].to_pylist()[3] == [-3.0, -3.0]
    with pytest.raises(DataError, match=r"has the joints pendulum_joint, .* shoulder, elbow.*; expected the same"):
        export_lerobot([read_bag(acrobot), read_bag(one)], tmp_path / "both")
    assert not (tmp_path / "both").exists()


@in_repository
@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--format", "csv"], "2 bags for format csv; expected one"),
        (["--format", "lerobot", "--fps", "0"], "fps is 0 Hz; expected >= 1"),
        (["--format", "lerobot", "--task", " "], "task is empty"),
    ],
)
def test_what_makes_no_dataset_is_refused(
    options: list[str], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bags = [str(EXAMPLES / name) for name in ("regulation_sim", "regulation_hw")]
    assert export_main([*bags, "-o", str(tmp_path / "out"), *options]) == 2
    assert why in capsys.readouterr().err


def test_a_bag_without_commands_or_a_folder_that_is_there_is_refused(tmp_path: Path) -> None:
    silent = write(tmp_path / "bag", [*range(9)], [])
    with pytest.raises(DataError, match="has no episode; expected joint_states and an effort_command beside it"):
        export_lerobot([read_bag(silent)], tmp_path / "out")
    with pytest.raises(BagError, match="exists already"):
        export_lerobot([read_bag(silent)], tmp_path)
    with pytest.raises(ParameterError):
        export_lerobot([read_bag(silent)], tmp_path / "out", fps=-1)
