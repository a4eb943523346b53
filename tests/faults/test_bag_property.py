"""What may stand behind a torque in a bag: the plant's own controller, and nobody else."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from operator import le
from pathlib import Path
from typing import Any

import pytest

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, STORE, write_bag
from tests.tools.faults.bag_property import POSITION_MARK, TorqueRecord, check_bag

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
    assert record.judged == 100


def test_a_plant_that_ends_its_torque_in_time_breaks_no_rule(tmp_path: Path) -> None:
    _record(tmp_path / "bag", topic=names.EFFORT_COMMAND, frame="/stranger", torque=0.0)
    (record,) = check_bag(tmp_path / "bag", limit=1.0)
    assert record.violations == ()


# --- from the first record on ------------------------------------------------------------------------------


def _judge(
    path: Path,
    torque: Callable[[float], float],
    commanded: Callable[[float], bool] = lambda _: False,
    *,
    modes: Iterable[tuple[float, str]] = (),
    told: Iterable[tuple[float, str]] = (),
    teller: str = "/hw/bridge: plant",
    trajectories: Iterable[float] = (),
    joint: str = names.JOINT,
    limit: float = 5.0,
    counts: Mapping[str, int] | None = None,
    witnessed: Iterable[float] = (),
    marked: Mapping[str, Any] | None = None,
    duration: int = 3,
) -> TorqueRecord:
    """Judge some seconds of a plant at 100 Hz that tells its mode by events and by diagnostics."""

    def instant(seconds: float) -> int:
        return _BEGIN + round(seconds * _SECOND)

    rows: list[tuple[int, str, str, bytes]] = []
    for number in range(100 * duration):
        now, seconds = _BEGIN + number * _PERIOD, number / 100
        applied = encode_joint_state(now, effort=torque(seconds))
        rows.append((now, f"/hw/{names.APPLIED_EFFORT}", JOINT_STATE, applied))
        if commanded(seconds):
            data = encode_joint_state(now, frame_id="/hw/controller", joint=joint, effort=1.0)
            rows.append((now, f"/hw/{names.EFFORT_COMMAND}", JOINT_STATE, data))
    kinds = STORE.types
    for seconds, mode in modes:
        text = kinds["std_msgs/msg/String"](data=json.dumps({"name": names.Event.PLANT_MODE, "mode": mode}))
        data = bytes(STORE.serialize_cdr(text, "std_msgs/msg/String"))
        rows.append((instant(seconds), f"/hw/{names.EVENTS}", "std_msgs/msg/String", data))
    for seconds, mode in told:
        rows.append((instant(seconds), names.DIAGNOSTICS, _DIAGNOSTICS, _diagnostics(instant(seconds), mode, teller)))
    for seconds in trajectories:
        data = encode_joint_state(instant(seconds))
        rows.append((instant(seconds), f"/hw/{names.JOINT_TRAJECTORY}", JOINT_STATE, data))
    metadata = dict(marked or {})
    if counts:
        metadata["pendulum.recorder.counts"] = {f"/hw/{names.EFFORT_COMMAND}": dict(counts)}
    writer = BagWriter(path / "bag", "mcap", None, metadata)
    for topic, kind in sorted({(topic, kind) for _, topic, kind, _ in rows}):
        writer.add_topic(topic, kind)
    for when, topic, _, data in sorted(rows, key=lambda row: row[0]):
        writer.write(topic, when, data)
    writer.close()
    (record,) = check_bag(path / "bag", limit=limit, witnessed=[instant(seconds) for seconds in witnessed])
    return record


_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def _diagnostics(stamp_ns: int, mode: str, teller: str) -> bytes:
    kinds = STORE.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=stamp_ns // _SECOND, nanosec=stamp_ns % _SECOND)
    value = kinds["diagnostic_msgs/msg/KeyValue"](key="mode", value=mode)
    status = kinds["diagnostic_msgs/msg/DiagnosticStatus"](
        level=0, name=teller, message="", hardware_id="", values=[value]
    )
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return bytes(STORE.serialize_cdr(kinds[_DIAGNOSTICS](header=header, status=[status]), _DIAGNOSTICS))


def _always(_: float) -> bool:
    return True


def _steady(_: float) -> float:
    return 3.0


def _late(record: TorqueRecord) -> bool:
    return len(record.violations) == 1 and "after the last command; expected at most 70 ms" in record.violations[0]


def test_torque_without_any_command_breaks_the_rule(tmp_path: Path) -> None:
    record = _judge(tmp_path, _steady)
    assert record.judged == 300
    assert record.longest == pytest.approx(2.99)
    assert _late(record)


def test_torque_before_the_first_command_breaks_the_rule(tmp_path: Path) -> None:
    assert _late(_judge(tmp_path, _steady, lambda seconds: seconds >= 2.0))


def test_a_command_from_before_the_recording_explains_the_torque_of_its_life_and_no_more(tmp_path: Path) -> None:
    (tmp_path / "longer").mkdir()
    assert _judge(tmp_path, lambda seconds: 3.0 * (seconds < 0.065)).violations == ()
    assert _late(_judge(tmp_path / "longer", lambda seconds: 3.0 * (seconds < 0.085)))


def test_a_lost_command_explains_the_torque_of_one_life_and_no_more(tmp_path: Path) -> None:
    def gap(length: float) -> Callable[[float], bool]:
        return lambda seconds: not 0.995 < seconds < 0.995 + length

    for name, length, lost, late in (
        ("covered", 0.13, 1, False),
        ("none lost", 0.13, 0, True),
        ("longer", 0.3, 1, True),
        ("more lost", 0.3, 4, False),
    ):
        (tmp_path / name).mkdir()
        record = _judge(tmp_path / name, _steady, gap(length), counts={"lost": lost})
        assert _late(record) is late, name
        assert record.missing == lost


def test_commands_heard_of_too_late_explain_as_many_lives_and_only_shortly_before_a_recorded_one(
    tmp_path: Path,
) -> None:
    # Torque from the first record on; commands later.
    for name, first, early, late in (
        ("as many", 0.4, 5, False),
        ("too few", 0.4, 4, True),
        ("none", 0.4, 0, True),
        ("half a second, however few", 0.5, 20, False),
        ("lives of all", 0.8, 14, False),
        ("longer than their lives", 0.8, 11, True),
        ("three seconds, however many", 3.2, 1000, True),
        ("no command follows", 9.0, 1000, True),
    ):
        for kind in ("early", "before"):
            record = _judge(tmp_path / name / kind, _steady, partial(le, first), counts={kind: early}, duration=4)
            assert _late(record) is late, (name, kind)


def test_commands_that_another_witness_heard_explain_their_lives_and_no_more(tmp_path: Path) -> None:
    heard = [0.01 * number for number in range(100, 140)]
    for name, until, witnessed, late in (
        ("heard", 1.44, heard, False),
        ("longer", 1.55, heard, True),
        ("not heard", 1.44, [], True),
    ):
        (tmp_path / name).mkdir()
        torque = partial(_pulse, 1.0, until)
        assert _late(_judge(tmp_path / name, torque, witnessed=witnessed)) is late, name


def _pulse(since: float, until: float, seconds: float) -> float:
    return 3.0 * (since <= seconds < until)


def test_early_commands_explain_no_more_than_their_time_however_many_gaps_there_are(tmp_path: Path) -> None:
    record = _judge(
        tmp_path,
        _steady,
        lambda seconds: round(100 * seconds) % 40 == 0 or seconds > 5.7,
        counts={"early": 1000},
        duration=6,
    )
    assert _late(record)


def test_an_early_command_long_before_a_recorded_one_explains_nothing(tmp_path: Path) -> None:
    torque = partial(_pulse, 0.3, 0.4)
    record = _judge(tmp_path, torque, partial(le, 3.5), counts={"early": 1000}, duration=4)
    assert _late(record)


@pytest.mark.parametrize("source", ["events", "diagnostics"])
def test_a_plant_that_says_it_holds_makes_its_own_torque_until_it_says_otherwise(tmp_path: Path, source: str) -> None:
    for name, until, late in (("to the end", 3.0, False), ("half way", 1.5, True)):
        (tmp_path / name).mkdir()
        said = [(0.0, "armed_position"), (until, "armed_effort")]
        modes = {"modes": said} if source == "events" else {"told": said}
        record = _judge(tmp_path / name, _steady, **modes)  # type: ignore[arg-type]
        assert _late(record) is late, name
        assert record.judged == (0 if until == 3.0 else 142)


def test_a_first_diagnostics_tells_the_mode_of_its_period_before_and_an_event_only_from_then_on(tmp_path: Path) -> None:
    for name, modes, told, late in (
        ("diagnostics", [], [(1.0, "armed_position")], False),
        ("late diagnostics", [], [(2.0, "armed_position")], True),
        ("event", [(1.0, "armed_position")], [], True),
        ("disarmed before", [(0.0, "disarmed")], [(1.0, "armed_position")], True),
    ):
        (tmp_path / name).mkdir()
        assert _late(_judge(tmp_path / name, _steady, modes=modes, told=told)) is late, name


@pytest.mark.parametrize("teller", ["/sim/simulator: plant", "/hw/controller: controller"])
def test_what_another_says_of_its_mode_excuses_nothing(tmp_path: Path, teller: str) -> None:
    assert _late(_judge(tmp_path, _steady, told=[(0.0, "armed_position")], teller=teller))


def test_a_trajectory_that_the_plant_did_not_follow_excuses_nothing(tmp_path: Path) -> None:
    record = _judge(
        tmp_path,
        _steady,
        lambda seconds: seconds < 1.0,
        modes=[(0.0, "armed_effort")],
        trajectories=[0.5],
    )
    assert record.judged == 300
    assert _late(record)


def test_a_mark_tells_of_position_control_only_where_the_plant_says_nothing(tmp_path: Path) -> None:
    mark = {POSITION_MARK: {"/hw": [[_BEGIN, _BEGIN + 3 * _SECOND]]}}
    for name in ("silent", "other plant", "says otherwise"):
        (tmp_path / name).mkdir()
    assert _judge(tmp_path / "silent", _steady, marked=mark).violations == ()
    other = {POSITION_MARK: {"/sim": [[_BEGIN, _BEGIN + 3 * _SECOND]]}}
    assert _late(_judge(tmp_path / "other plant", _steady, marked=other))
    assert _late(_judge(tmp_path / "says otherwise", _steady, marked=mark, modes=[(0.0, "armed_effort")]))


def test_a_command_for_another_joint_excuses_nothing(tmp_path: Path) -> None:
    assert _late(_judge(tmp_path, _steady, _always, joint="other_joint"))


def test_torque_beyond_the_limit_or_not_finite_is_noted_whatever_was_commanded(tmp_path: Path) -> None:
    for name in ("limit", "beyond", "not finite"):
        (tmp_path / name).mkdir()
    assert _judge(tmp_path / "limit", _steady, _always, limit=3.0).violations == ()
    record = _judge(tmp_path / "beyond", lambda seconds: -3.001 if seconds == 1.0 else 0.0, _always, limit=3.0)
    assert record.violations == ("torque reached 3.001 N m; expected at most 3 N m",)
    record = _judge(tmp_path / "not finite", lambda seconds: math.nan if seconds == 1.0 else 0.0, _always)
    assert record.violations == ("1 torques are not finite",)


def test_a_single_torque_too_late_breaks_the_rule(tmp_path: Path) -> None:
    record = _judge(tmp_path, lambda seconds: 3.0 * (seconds <= 1.085), lambda seconds: seconds <= 1.0)
    assert record.longest == pytest.approx(0.08)
    assert _late(record)


def test_a_bag_without_torque_is_no_proof(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "empty", "mcap", None, {})
    writer.add_topic(f"/hw/{names.APPLIED_EFFORT}", JOINT_STATE)
    writer.close()
    (record,) = check_bag(tmp_path / "empty", limit=1.0)
    assert record.violations == ("no torque was recorded",)
    write_bag(tmp_path / "other", [(f"/hw/{names.JOINT_STATES}", _BEGIN, encode_joint_state(_BEGIN))], seal_every=1)
    with pytest.raises(DataError, match="has no topic applied_effort"):
        check_bag(tmp_path / "other", limit=1.0)
