"""Recordings as others make them: sparse tables, comments, decimal commas, no effort, no stamps, pauses, joints."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.recordings.mapping import MAPPINGS
from pendulum_bags.runs.datasets import check_consistency, data_notes, gaps
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.storage import BagWriter

TIME = np.arange(0.0, 4.0, 0.01)
ANGLE = 0.5 * np.sin(3.0 * TIME)
SPEED = 1.5 * np.cos(3.0 * TIME)
TORQUE = np.round(np.sin(TIME), 3)
JOINT_STATE = "sensor_msgs/msg/JointState"
BEGIN = 1_700_000_000 * 10**9


def rows(*columns: np.ndarray, mark: str = ",") -> str:
    return "".join(
        mark.join("" if np.isnan(cell) else f"{cell:.6f}" for cell in row) + "\n" for row in np.stack(columns, axis=1)
    )


def save(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def bag(
    path: Path, times: np.ndarray, *, effort: float | None = 0.5, stamped: bool = True, topic: str = "joint_states"
):
    with BagWriter(path) as writer:
        writer.add_topic(topic, JOINT_STATE)
        for t in times:
            now = BEGIN + round(t * 1e9)
            q, v = 0.5 * np.sin(3.0 * t), 1.5 * np.cos(3.0 * t)
            stamp = now if stamped else 0
            writer.write(topic, now, encode_joint_state(stamp, position=q, velocity=v, effort=effort))
    return path


def test_empty_cells_are_left_out_as_nan_is(tmp_path):
    angle = ANGLE.copy()
    angle[7::13] = np.nan
    path = save(tmp_path / "holes.csv", "time,position,velocity,torque\n" + rows(TIME, angle, SPEED, TORQUE))
    mapping = {**MAPPINGS["pendulum"], "drop_nan": True}
    recording = read_recording(path, mapping)
    assert recording.time.size == np.isfinite(angle).sum()
    np.testing.assert_allclose(recording.position, angle[np.isfinite(angle)], atol=1e-6)
    with pytest.raises(DataError, match="`drop_nan: true` in the mapping file leaves such rows out"):
        read_recording(path)


@pytest.mark.parametrize("drop", [False, True])
def test_a_log_with_a_row_for_each_topic_takes_each_from_its_own_rows(tmp_path, drop):
    text = "time,position,velocity,torque\n"
    for t, q, v, u in zip(TIME, ANGLE, SPEED, TORQUE, strict=True):
        text += f"{t:.6f},{q:.6f},{v:.6f},\n{t + 0.004:.6f},,,{u:.6f}\n"
    recording = read_recording(save(tmp_path / "sparse.csv", text), {**MAPPINGS["pendulum"], "drop_nan": drop})
    np.testing.assert_allclose(recording.time, TIME)
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    np.testing.assert_allclose(recording.input_stamps, TIME + 0.004)
    np.testing.assert_allclose(recording.input, TORQUE)
    assert "each is taken from its own rows" in " ".join(data_notes(recording))


def test_topics_that_meet_in_some_rows_are_still_taken_from_their_own(tmp_path):
    text = "time,position,velocity,torque\n"
    for k, (t, q, v, u) in enumerate(zip(TIME, ANGLE, SPEED, TORQUE, strict=True)):
        state, command = f"{t:.6f},{q:.6f},{v:.6f},", f"{u:.6f}\n"
        text += state + command if k % 50 == 0 else f"{state}\n{t + 0.004:.6f},,,{command}"
    recording = read_recording(save(tmp_path / "sparse.csv", text))
    np.testing.assert_allclose(recording.time, TIME)
    np.testing.assert_allclose(recording.input, TORQUE)


def test_a_comment_with_units_below_the_header_names_no_columns(tmp_path):
    text = "# time,position,velocity,torque\n# s,rad,rad/s,N m\n" + rows(TIME, ANGLE, SPEED, TORQUE)
    assert read_recording(save(tmp_path / "run.csv", text)).time.size == TIME.size


def test_columns_between_spaces_are_read(tmp_path):
    path = save(tmp_path / "run.csv", "time position velocity torque\n" + rows(TIME, ANGLE, SPEED, TORQUE, mark=" "))
    assert read_recording(path).time.size == TIME.size
    assert read_recording(path, {**MAPPINGS["pendulum"], "delimiter": " "}).time.size == TIME.size


@pytest.mark.parametrize(
    "before",
    ["# logger 3\n#\n# made on Monday, by hand\n", "# a, b: 5\n\n", "", "# 1, 2, 3\n"],
    ids=["block", "blank line", "none", "numbers"],
)
@pytest.mark.parametrize("head", ["time,position,velocity,torque\n", "# time,position,velocity,torque\n"])
def test_comments_before_the_header_need_no_skip(tmp_path, before, head):
    path = save(tmp_path / "run.csv", before + head + rows(TIME, ANGLE, SPEED, TORQUE) + "# end\n")
    assert read_recording(path).time.size == TIME.size


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_semicolons_tabs_and_decimal_commas_are_read(tmp_path, mark, decimal):
    text = rows(TIME, ANGLE, SPEED, TORQUE, mark=mark).replace(".", decimal)
    path = save(tmp_path / "run.csv", mark.join(["time", "position", "velocity", "torque"]) + "\n" + text)
    np.testing.assert_allclose(read_recording(path).position, ANGLE, atol=1e-6)


def test_a_column_of_dates_hides_no_decimal_commas(tmp_path):
    text = rows(TIME, ANGLE, SPEED, TORQUE, mark=";").replace(".", ",").replace("\n", ";27.11.2026\n")
    path = save(tmp_path / "run.csv", "time;position;velocity;torque;date\n" + text)
    np.testing.assert_allclose(read_recording(path).position, ANGLE, atol=1e-6)


def test_decimal_commas_between_commas_are_named(tmp_path):
    path = save(tmp_path / "run.csv", "time,position\n0,00,0,50\n0,01,0,49\n")
    with pytest.raises(DataError, match="decimal commas cannot be told from those between columns"):
        read_recording(path)


@pytest.mark.parametrize("effort", [None, float("nan")])
@pytest.mark.parametrize("mapping", [None, "free_swing"])
def test_a_bag_without_effort_is_a_free_swing(tmp_path, effort, mapping):
    recording = read_recording(bag(tmp_path / "bag", TIME, effort=effort), mapping)
    assert recording.input_kind == "none"
    assert "taken for a free swing" in " ".join(data_notes(recording))


def test_a_free_swing_takes_no_effort_from_a_bag_that_has_one(tmp_path):
    path = bag(tmp_path / "bag", TIME)
    assert read_recording(path, "free_swing").input_kind == "none"
    assert read_recording(path).input_kind == "effort"


def test_a_bag_whose_stamps_were_never_set_has_all_its_samples(tmp_path):
    recording = read_recording(bag(tmp_path / "bag", TIME, stamped=False))
    np.testing.assert_allclose(recording.time, TIME, atol=1e-9)
    assert "have no stamp" in " ".join(data_notes(recording))


@pytest.mark.parametrize("pause", [0.3, 5.0, 3600.0])
@pytest.mark.parametrize("kind", ["bag", "csv"])
def test_a_pause_is_a_gap_and_no_wrong_unit(tmp_path, kind, pause):
    later = np.where(TIME < 2.0, TIME, TIME + pause)
    if kind == "bag":
        path = bag(tmp_path / "bag", later)
    else:
        table = rows(later, 0.5 * np.sin(3.0 * later), 1.5 * np.cos(3.0 * later), TORQUE)
        path = save(tmp_path / "run.csv", "time,position,velocity,torque\n" + table)
    recording = read_recording(path)
    (gap,) = gaps(recording)
    assert gap[1] - gap[0] == pytest.approx(pause + 0.01, abs=1e-6)


@pytest.mark.parametrize("back", [0.02, 0.08, 0.5, 50.0])
@pytest.mark.parametrize("kind", ["bag", "csv"])
def test_a_clock_that_steps_back_is_cut_there_and_nothing_is_mixed(tmp_path, kind, back):
    if kind == "csv":
        stamps = np.where(TIME < 2.0, TIME, TIME - back)
        path = save(tmp_path / "run.csv", "time,position,velocity,torque\n" + rows(stamps, ANGLE, SPEED, TORQUE))
    else:
        path = tmp_path / "bag"
        with BagWriter(path) as writer:
            writer.add_topic("/joint_states", JOINT_STATE)
            for t, q, v, u in zip(TIME, ANGLE, SPEED, TORQUE, strict=True):
                now = BEGIN + round((t if t < 2.0 else t - back) * 1e9)
                writer.write("/joint_states", now, encode_joint_state(now, position=q, velocity=v, effort=u))
    recording = read_recording(path)
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    assert len(gaps(recording)) == 1
    assert re.search(r"steps? back", " ".join(data_notes(recording)))


def test_two_recordings_that_were_joined_are_cut_apart(tmp_path):
    angle = np.concatenate([ANGLE, ANGLE[::-1] + 2.0])
    time = np.concatenate([TIME, TIME + 4.0])
    speed = np.concatenate([SPEED, -SPEED[::-1]])
    table = rows(time, angle, speed, np.concatenate([TORQUE, TORQUE]))
    recording = read_recording(save(tmp_path / "run.csv", "time,position,velocity,torque\n" + table))
    np.testing.assert_allclose(recording.position, angle, atol=1e-6)
    assert len(gaps(recording)) == 1
    assert "two recordings that were joined" in " ".join(data_notes(recording))


def test_a_wrong_unit_is_still_found_in_a_recording_with_a_pause(tmp_path):
    later = np.where(TIME < 2.0, TIME, TIME + 5.0)
    table = rows(later, 0.5 * np.sin(3.0 * later), np.degrees(1.5 * np.cos(3.0 * later)), TORQUE)
    path = save(tmp_path / "run.csv", "time,position,velocity,torque\n" + table)
    with pytest.raises(DataError, match="deg/s instead of rad/s"):
        check_consistency(read_recording(path))


@pytest.mark.parametrize("drop", [False, True])
@pytest.mark.parametrize("driven", [False, True])
def test_position_and_velocity_in_rows_of_their_own_are_both_read(tmp_path, drop, driven):
    text = "time,position,velocity,torque\n"
    for t, q, v, u in zip(TIME, ANGLE, SPEED, TORQUE, strict=True):
        text += f"{t:.6f},{q:.6f},,\n{t + 0.002:.6f},,{v:.6f},\n" + f"{t + 0.004:.6f},,,{u:.6f}\n" * driven
    mapping = MAPPINGS["pendulum" if driven else "free_swing"]
    recording = read_recording(save(tmp_path / "sparse.csv", text), {**mapping, "drop_nan": drop})
    np.testing.assert_allclose(recording.time, TIME)
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    expected = np.interp(TIME, TIME + 0.002, SPEED)
    np.testing.assert_allclose(recording.velocity, expected, atol=1e-6)
    assert "each is taken from its own rows, the velocity by interpolation" in " ".join(data_notes(recording))
    if driven:
        np.testing.assert_allclose(recording.input_stamps, TIME + 0.004)
        np.testing.assert_allclose(recording.input, TORQUE)


def test_a_velocity_apart_from_rows_with_angle_and_torque_costs_no_torque(tmp_path):
    text = "time,position,velocity,torque\n"
    for t, q, v, u in zip(TIME, ANGLE, SPEED, TORQUE, strict=True):
        text += f"{t:.6f},{q:.6f},,{u:.6f}\n{t + 0.002:.6f},,{v:.6f},\n"
    recording = read_recording(save(tmp_path / "sparse.csv", text))
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    np.testing.assert_allclose(recording.input, TORQUE)
    assert recording.velocity is not None


def test_an_empty_optional_column_is_none(tmp_path):
    table = rows(TIME, ANGLE, np.full(TIME.size, np.nan), TORQUE)
    path = save(tmp_path / "run.csv", "time,position,velocity,torque\n" + table)
    for drop in (False, True):
        recording = read_recording(path, {**MAPPINGS["pendulum"], "drop_nan": drop})
        assert recording.velocity is None
        assert recording.time.size == TIME.size


def test_a_row_of_units_below_the_header_is_no_data_and_is_compared(tmp_path):
    table = rows(TIME, ANGLE, SPEED, TORQUE)
    head = "time,position,velocity,torque\n"
    recording = read_recording(save(tmp_path / "units.csv", f"{head}[s],[rad],[rad/s],[N m]\n{table}"))
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    with pytest.raises(
        DataError, match="column 'position' is in deg by what the file says; built-in mapping 'pendulum' says 'rad'"
    ):
        read_recording(save(tmp_path / "deg.csv", f"{head}s,deg,rad/s,N m\n{table}"))


@pytest.mark.parametrize("torn", ["4.000000,0.1", "4.000000,0.1,0.2,0.3e", "4.000000,"])
def test_a_last_line_that_was_not_written_whole_is_left_out(tmp_path, torn):
    table = rows(TIME, ANGLE, SPEED, TORQUE)
    recording = read_recording(save(tmp_path / "torn.csv", f"time,position,velocity,torque\n{table}{torn}"))
    assert recording.time.size == TIME.size
    assert f"the last line, {torn!r}, is not whole" in " ".join(data_notes(recording))


def test_a_short_line_in_the_middle_is_still_an_error(tmp_path):
    lines = rows(TIME, ANGLE, SPEED, TORQUE).splitlines()
    lines[100] = "1.0,0.1"
    path = save(tmp_path / "short.csv", "time,position,velocity,torque\n" + "\n".join(lines) + "\n")
    with pytest.raises(DataError, match="line 102 has 2 cells; expected 4"):
        read_recording(path)


@pytest.mark.parametrize("before", ["Messung;Pendel 3\nDatum;27.11.2026\n", "mass_A;;\n", "1.0;2.0\nlog of run\n"])
def test_lines_above_the_names_are_left_out(tmp_path, before):
    table = rows(TIME, ANGLE, SPEED, TORQUE).replace(",", ";")
    path = save(tmp_path / "run.csv", f"{before}time;position;velocity;torque\n{table}")
    np.testing.assert_allclose(read_recording(path).position, ANGLE, atol=1e-6)
    skipped = {**MAPPINGS["pendulum"], "skip": before.count("\n")}
    np.testing.assert_allclose(read_recording(path, skipped).position, ANGLE, atol=1e-6)


def test_a_file_in_the_letters_of_windows_is_read_and_its_degrees_are_known(tmp_path):
    path = tmp_path / "run.csv"
    table = rows(TIME, np.degrees(ANGLE))
    path.write_bytes(f"time,Winkel [\N{DEGREE SIGN}]\n{table}".encode("cp1252"))
    recording = read_recording(path)
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-6)
    assert "is read as WINDOWS-1252" in " ".join(data_notes(recording))


def test_two_machines_in_one_table_are_refused(tmp_path):
    angle = ANGLE + 0.3 * (np.arange(TIME.size) % 2)
    path = save(tmp_path / "two.csv", "time,position,torque\n" + rows(TIME, angle, TORQUE))
    with pytest.raises(DataError, match=r"two\.csv holds two motions .* jump by 0\.29 rad and back"):
        read_recording(path)


@pytest.mark.parametrize("drop", [False, True])
def test_a_column_without_any_number_is_not_advised_to_drop_rows(tmp_path, drop):
    table = rows(TIME, ANGLE, SPEED, np.full(TIME.size, np.nan))
    path = save(tmp_path / "run.csv", "time,position,velocity,torque\n" + table)
    with pytest.raises(DataError, match=r"column 'torque' holds no number at all; .*: name another one$"):
        read_recording(path, {**MAPPINGS["pendulum"], "drop_nan": drop})
    with pytest.raises(DataError, match=r"`--mapping free_swing` reads a pendulum that nothing drives$"):
        read_recording(path)
    assert read_recording(path, "free_swing").time.size == TIME.size
