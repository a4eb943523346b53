"""What may stand behind a torque in a bag: the plant's own controller, and nobody else."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from tests.bag_messages import write_bag
from tests.faults.bag_property import check_bag

_BEGIN = 1_700_000_000_000_000_000
_PERIOD = 10_000_000
_SECOND = 1_000_000_000


def _record(
    path: Path, *, topic: str, frame: str, effort: float = 1.0, stamp_offset: int = 0, torque: float = 1.0
) -> None:
    """Write a second of a plant at 100 Hz of which the controller falls silent half way, and somebody else speaks."""
    rows = []
    for number in range(100):
        now = _BEGIN + number * _PERIOD
        rows.append((f"/hw/{names.APPLIED_EFFORT}", now, encode_joint_state(now, effort=torque)))
        if number < 50:
            data = encode_joint_state(now, frame_id="/hw/controller", effort=1.0)
            rows.append((f"/hw/{names.EFFORT_COMMAND}", now + 1, data))
        else:
            data = encode_joint_state(now + stamp_offset, frame_id=frame, effort=effort)
            rows.append((f"/hw/{topic}", now + 1, data))
    write_bag(path, rows, seal_every=100)


@pytest.mark.parametrize(
    ("topic", "frame", "effort", "offset_ns"),
    [
        (names.EFFORT_COMMAND, "/stranger", 1.0, 0),
        (names.EFFORT_COMMAND, "/hw/controller", math.nan, 0),
        (names.EFFORT_COMMAND, "/hw/controller", 1.0, -60 * _SECOND),
        (names.EFFORT_COMMAND, "/hw/controller", 1.0, _SECOND),
        (names.DISTURBANCE, "/hw/disturbance", 1.0, 0),
        (names.PUSH, "/hw/pusher", 1.0, 0),
    ],
    ids=["stranger", "not a number", "a minute old", "of the future", "disturbance", "push"],
)
def test_what_a_plant_must_refuse_excuses_no_torque(
    tmp_path: Path, topic: str, frame: str, effort: float, offset_ns: int
) -> None:
    _record(tmp_path / "bag", topic=topic, frame=frame, effort=effort, stamp_offset=offset_ns)
    (record,) = check_bag(tmp_path / "bag", limit=1.0)
    assert len(record.violations) == 1
    assert "after the last command; expected at most 70 ms" in record.violations[0]


@pytest.mark.parametrize("late_ns", [0, 40_000_000])
def test_the_controllers_own_commands_excuse_it_even_if_they_come_late(tmp_path: Path, late_ns: int) -> None:
    _record(tmp_path / "bag", topic=names.EFFORT_COMMAND, frame="/hw/controller", stamp_offset=-late_ns)
    (record,) = check_bag(tmp_path / "bag", limit=1.0)
    assert record.violations == ()
    assert record.judged == 99


def test_a_plant_that_ends_its_torque_in_time_breaks_no_rule(tmp_path: Path) -> None:
    _record(tmp_path / "bag", topic=names.EFFORT_COMMAND, frame="/stranger", torque=0.0)
    (record,) = check_bag(tmp_path / "bag", limit=1.0)
    assert record.violations == ()
