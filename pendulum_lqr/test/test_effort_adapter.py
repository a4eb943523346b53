"""The adapter to ros2_control: one command, one torque, for the newest state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from pendulum_lqr.nodes.effort_adapter import EffortAdapter, effort_of_array, effort_of_joint
from pendulum_msgs_py.errors import DataError

MS = 1_000_000


def test_a_command_answers_the_newest_state_once() -> None:
    adapter = EffortAdapter(0.05)
    assert adapter.command(1.0, 0) is None
    assert adapter.state(100, 1 * MS) == (100, 1.0)
    assert adapter.state(200, 2 * MS) is None
    assert adapter.command(2.0, 3 * MS) == (200, 2.0)


def test_of_commands_that_wait_the_last_one_counts() -> None:
    adapter = EffortAdapter(0.05)
    adapter.state(100, 0)
    assert adapter.command(1.0, 0) == (100, 1.0)
    assert adapter.command(2.0, 0) is None
    assert adapter.command(3.0, 1 * MS) is None
    assert adapter.state(200, 2 * MS) == (200, 3.0)
    assert adapter.state(300, 3 * MS) is None
    assert adapter.counts["replaced"] == 1


def test_a_command_does_not_outlive_its_time() -> None:
    adapter = EffortAdapter(0.05)
    adapter.command(1.0, 0)
    assert adapter.state(100, 51 * MS) is None
    assert adapter.counts["too_old"] == 1
    assert adapter.state(200, 52 * MS) is None


def test_a_plant_that_begins_anew_is_answered() -> None:
    adapter = EffortAdapter(0.05)
    adapter.state(1000, 0)
    adapter.command(1.0, 0)
    assert adapter.state(10, 0) is None
    assert adapter.command(2.0, 0) == (10, 2.0)


def test_the_state_that_got_a_command_last_is_not_the_newest() -> None:
    adapter = EffortAdapter(0.05)
    adapter.state(100, 0)
    assert adapter.answered_ns is None
    adapter.command(1.0, 0)
    adapter.state(200, 0)
    assert adapter.answered_ns == 100
    # A plant that begins anew.
    adapter.state(10, 0)
    assert adapter.answered_ns is None


@pytest.mark.parametrize(
    ("data", "message"),
    [([], "0 values"), ([1.0, 2.0], "2 values"), ([math.nan], "finite"), ([-math.inf], "finite")],
)
def test_an_array_that_is_no_torque_is_refused(data: list[float], message: str) -> None:
    with pytest.raises(DataError, match=message):
        effort_of_array(data)


@pytest.mark.parametrize(
    ("joints", "efforts", "message"),
    [
        (["other"], [1.0], "command is for other; expected pendulum_joint"),
        ([], [], "for no joint"),
        (["pendulum_joint"], [], "0 efforts for 1 joints"),
        (["a", "pendulum_joint"], [1.0, math.nan], "finite"),
    ],
)
def test_a_joint_command_that_is_none_of_ours_is_refused(
    joints: Sequence[str], efforts: Sequence[float], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        effort_of_joint(joints, efforts)


def test_our_joint_is_found_among_others() -> None:
    assert effort_of_joint(["a", "pendulum_joint"], [1.0, 2.0]) == 2.0
