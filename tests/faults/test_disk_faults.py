"""Disks that are full, and paths that cannot be: both are told, and what was written stays readable."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter

_TOPIC = "/sim/joint_states"
_START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    if os.geteuid() != 0:
        pytest.skip("mounting a small disk needs root")
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(tmp_path)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("this machine does not permit mounting")
    try:
        yield tmp_path
    finally:
        subprocess.run(["umount", "-l", str(tmp_path)], check=True)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_is_reported_and_what_was_sealed_is_kept(small_disk: Path, storage: str) -> None:
    bag = small_disk / "bag"
    writer = BagWriter(bag, storage)
    writer.add_topic(_TOPIC, "sensor_msgs/msg/JointState")
    sealed = 0

    def record() -> None:
        nonlocal sealed
        for i in range(1_000_000):
            now = _START_NS + 2_000_000 * i
            writer.write(_TOPIC, now, encode_joint_state(now, position=3.1, velocity=0.0, effort=0.1))
            if i % 100 == 99:
                writer.seal()
                sealed = i + 1

    with pytest.raises(OSError, match=r"(?i)space"):
        record()
    writer.abandon()
    with read_bag(bag) as opened:
        assert len(opened[_TOPIC]) >= sealed > 1000


def test_experiment_into_a_place_that_is_no_folder_ends_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_bags", "experiment", "thesis", "--out", str(tmp_path / "file" / "run")],
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 2, done.stderr[-500:]
    assert "Traceback" not in done.stderr
    assert str(tmp_path / "file") in done.stderr.replace("\n", "")
