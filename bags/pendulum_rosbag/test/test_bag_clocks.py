"""Recordings whose clock steps back, whose stamps step back or were never set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.convert.rewrite import rewrite
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.clock import steps_back
from pendulum_rosbag.reader.export_cli import main as export_main
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_readers import JOINT_STATE, STRING, text_message

COUNT = 2000
STEP_AT = 900
KINDS = [("mcap", None), ("mcap", "zstd"), ("sqlite3", None)]
BEGIN = 1_700_000_000 * 10**9


def write(
    bag: Path,
    period_ms: int,
    log_back_ms: float,
    stamp_back_ms: float,
    storage: str = "mcap",
    packing: str | None = None,
) -> Path:
    """Write states whose position counts them, commands in answer, and rare events; both clocks step back once."""
    with BagWriter(bag, storage, packing) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        writer.add_topic("/effort_command", JOINT_STATE)
        writer.add_topic("/events", STRING)
        for index in range(COUNT):
            late = index >= STEP_AT
            true = BEGIN + index * period_ms * 1_000_000
            log = true - round(late * log_back_ms * 1e6)
            stamp = true - round(late * stamp_back_ms * 1e6)
            writer.write("/joint_states", log + 200_000, encode_joint_state(stamp, position=float(index), velocity=0.0))
            writer.write("/effort_command", log + 900_000, encode_joint_state(stamp, effort=float(index)))
            if index in (STEP_AT - 50, STEP_AT + 50):
                text = f'{{"name": "e{index}", "stamp_ns": {stamp}}}'
                writer.write("/events", log + 950_000, text_message(text))
    return bag


@pytest.mark.parametrize(("storage", "packing"), KINDS)
@pytest.mark.parametrize(
    ("period_ms", "log_back_ms", "stamp_back_ms"),
    [
        (10, 5300, 5300),
        (2, 53, 53),
        (20, 53, 53),
        (2, 53, 0),
        (2, 20, 20),
        (2, 12, 0),
        (10, 20, 20),
        (10, 0, 5300),
        (10, 60_000, 60_000),
        (2, 5300.4, 5299.9),
    ],
)
def test_two_passes_of_a_clock_that_stepped_back_are_never_mixed(
    tmp_path: Path, period_ms: int, log_back_ms: float, stamp_back_ms: float, storage: str, packing: str | None
) -> None:
    bag = write(tmp_path / "bag", period_ms, log_back_ms, stamp_back_ms, storage, packing)
    converted = rewrite([bag], tmp_path / "converted", storage="mcap").path
    for path in (bag, converted):
        with read_bag(path) as opened:
            assert opened["/joint_states"]["position"].tolist() == list(range(COUNT))
            assert len(opened.raw("/effort_command")) == COUNT
            states, commands = opened.array("/joint_states"), opened.array("/effort_command")
            assert states["position"].tolist() == commands["effort"].tolist() == list(range(COUNT))
            np.testing.assert_array_equal(states["stamp_ns"], commands["stamp_ns"])
            true = BEGIN + np.arange(COUNT) * period_ms * 1_000_000
            np.testing.assert_allclose(states["stamp_ns"], true, atol=1e5)
            np.testing.assert_allclose(states["log_time_ns"], true + 200_000, atol=1e5)
            found = {event["name"]: event["stamp_ns"] for event in opened.events()}
            for name, stamp in found.items():
                assert abs(stamp - true[int(name[1:])]) <= 1e5
            assert len(opened.joints("/joint_states").stamp_ns) == COUNT
            notes = " ".join(opened.clock_notes)
            assert ("log times step back" in notes) == (log_back_ms > 0)
            assert ("stamps on /joint_states step back" in notes) == (stamp_back_ms > 0)
    assert export_main([str(bag), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    table = pd.read_csv(tmp_path / "out" / "joint_states.csv")
    assert table["position"].tolist() == list(range(COUNT))
    assert (table["log_time_ns"].diff() < 0).sum() == (log_back_ms > 0)  # the times as they were recorded


def test_a_late_message_and_a_file_in_no_order_are_no_steps() -> None:
    times = np.arange(100) * 10_000_000
    late = times.copy()
    late[50] -= 200_000_000
    assert steps_back(late) == []
    assert steps_back(np.random.default_rng(1).permutation(times)) == []
    assert steps_back(np.concatenate([times, times - 200_000_000 + 10**9])) == [100]


def test_a_small_step_back_is_distinguished_from_late_and_early_messages() -> None:
    times = np.arange(1000) * 2_000_000
    stepped = np.concatenate([times[:500], times[500:] - 20_000_000])
    assert steps_back(stepped) == [500]
    late, early, jittered = times.copy(), times.copy(), stepped.copy()
    late[500:505] -= 20_000_000  # five messages that were held up
    early[500] += 20_000_000
    jittered += np.random.default_rng(1).integers(-15_000_000, 15_000_000, 1000)  # no steady messages: nothing shows
    assert steps_back(late) == steps_back(early) == steps_back(jittered) == []


@pytest.mark.parametrize("stamp", [0, 1, BEGIN])
def test_stamps_that_were_never_set_are_those_of_the_log(tmp_path: Path, stamp: int) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        for index in range(100):
            writer.write("/joint_states", BEGIN + index, encode_joint_state(stamp, position=float(index)))
    with read_bag(bag) as opened:
        assert opened.array("/joint_states")["stamp_ns"].tolist() == [BEGIN + index for index in range(100)]
        assert opened["/joint_states"]["stamp_ns"].tolist() == [stamp] * 100
        assert opened.clock_notes == ["100 of 100 messages on /joint_states have no stamp: their log times are taken"]


def test_stamps_that_were_not_set_at_first_are_taken_from_the_log(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        for index in range(100):
            true = BEGIN + index * 1_000_000
            writer.write("/joint_states", true + 500, encode_joint_state(true if index > 20 else 0, position=0.0))
    with read_bag(bag) as opened:
        assert opened.array("/joint_states")["stamp_ns"].tolist() == [BEGIN + i * 1_000_000 for i in range(100)]
