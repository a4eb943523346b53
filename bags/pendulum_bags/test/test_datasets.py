"""Reading recordings: columns, units, signs, and the sentences for what is wrong with a file."""

import json
import re

import numpy as np
import pytest

from pendulum_bags.recordings.mapping import MAPPINGS
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import DataError

TIME = np.arange(0.0, 2.0, 0.01)
ANGLE = 0.5 * np.sin(3.0 * TIME)
SPEED = 1.5 * np.cos(3.0 * TIME)


def write(path, header, *columns):
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
    return path


def refused(text):
    return pytest.raises(DataError, match=re.escape(text))


def test_a_csv_with_the_usual_names_needs_no_mapping(tmp_path):
    path = write(tmp_path / "run.csv", "time,position,velocity,torque", TIME, ANGLE, SPEED, SPEED)
    recording = read_recording(path)
    assert recording.input_kind == "effort"
    assert recording.hold == "linear"
    np.testing.assert_allclose(recording.position, ANGLE)
    np.testing.assert_allclose(recording.velocity, SPEED)
    assert recording.period == pytest.approx(0.01)


def test_a_mapping_file_turns_units_signs_and_offsets_into_si(tmp_path):
    path = write(tmp_path / "run.csv", "ms,deg,dps,mv", 1e3 * TIME, 180.0 - np.degrees(ANGLE), -np.degrees(SPEED), TIME)
    mapping = tmp_path / "map.yaml"
    mapping.write_text(
        "format: pendulum_columns/1\n"
        "time: {column: ms, unit: ms}\n"
        "position: {column: deg, unit: deg, sign: -1, offset: -180.0}\n"
        "velocity: {column: dps, unit: deg/s, sign: -1}\n"
        "input: {column: mv, unit: mV}\n"
        "meta: {mass: 0.5}\n"
    )
    recording = read_recording(path, mapping)
    np.testing.assert_allclose(recording.position, ANGLE, atol=1e-12)
    np.testing.assert_allclose(recording.velocity, SPEED, atol=1e-12)
    np.testing.assert_allclose(recording.time, TIME, atol=1e-12)
    np.testing.assert_allclose(recording.input, 1e-3 * TIME)
    assert (recording.input_kind, recording.hold, recording.meta["mass"]) == ("voltage", "zero", 0.5)


def test_irregular_sampling_stays_as_it_is(tmp_path):
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.uniform(0.004, 0.02, 300))
    path = write(tmp_path / "run.csv", "time,position,torque", stamps, np.sin(stamps), stamps)
    np.testing.assert_allclose(read_recording(path).time, stamps, rtol=1e-15)


def test_a_missing_column_is_named_with_those_that_there_are(tmp_path):
    path = write(tmp_path / "run.csv", "time,angle,torque", TIME, ANGLE, SPEED)
    with pytest.raises(DataError, match=r"no column 'position' for position .* it has time, angle, torque"):
        read_recording(path, "pendulum")
    np.testing.assert_allclose(read_recording(path).position, ANGLE)


def test_unsorted_time_is_refused_with_both_stamps(tmp_path):
    stamps = TIME.copy()
    stamps[7] = 0.01
    path = write(tmp_path / "run.csv", "time,position,torque", stamps, ANGLE, SPEED)
    with refused("time goes from 0.060000 s to 0.010000 s in sample 7"):
        read_recording(path)


def test_a_stamp_that_a_logger_wrote_twice_counts_once(tmp_path):
    stamps = TIME.copy()
    stamps[7] = stamps[6]
    path = write(tmp_path / "run.csv", "time,position,torque", stamps, ANGLE, SPEED)
    recording = read_recording(path)
    assert recording.meta["repeated_stamps"] == 1
    np.testing.assert_allclose(recording.time, np.delete(stamps, 7))
    np.testing.assert_allclose(recording.position, np.delete(ANGLE, 7))


def test_capital_letters_and_blanks_in_a_header_are_the_same_names(tmp_path):
    path = write(tmp_path / "run.csv", "Time , POSITION, Torque", TIME, ANGLE, SPEED)
    np.testing.assert_allclose(read_recording(path).position, ANGLE)
    path = write(tmp_path / "two.csv", "time,Position,POSITION,torque", TIME, ANGLE, ANGLE, SPEED)
    with refused("no column 'position'"):
        read_recording(path, "pendulum")


def test_another_delimiter_and_a_file_without_rows_are_named(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time;position;torque\n0;0;0\n0.01;0;0\n")
    with refused("has no row of numbers between ','"):
        read_recording(path, {**MAPPINGS["pendulum"], "delimiter": ","})
    path.write_text("time,position,torque\n")
    with refused("has no rows below its header"):
        read_recording(path)


def test_nan_is_refused_with_column_and_row(tmp_path):
    angle = ANGLE.copy()
    angle[11] = np.nan
    path = write(tmp_path / "run.csv", "time,position,torque", TIME, angle, SPEED)
    with refused("column 'position' is nan in row 11"):
        read_recording(path)


def test_a_cell_that_is_no_number_is_named_with_its_line(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time,position,torque\n0,0,0\n0.01,oops,0\n")
    with refused("line 3, column 'position' holds 'oops'"):
        read_recording(path)


def test_a_file_without_names_is_refused(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("0,0,0\n0.01,1,0\n")
    with refused("has no column of time; it has column0, column1, column2: --dt SECONDS"):
        read_recording(path)


@pytest.mark.parametrize(
    ("position", "velocity", "text"),
    [
        (ANGLE, np.degrees(SPEED), "deg/s instead of rad/s in the velocity"),
        (ANGLE, SPEED * 30.0 / np.pi, "rpm instead of rad/s in the velocity"),
        (ANGLE, -SPEED, "a reversed sign in the velocity"),
        (np.degrees(ANGLE), SPEED, "deg instead of rad in the position"),
    ],
)
def test_velocity_that_is_not_the_derivative_names_the_likely_unit(tmp_path, position, velocity, text):
    path = write(tmp_path / "run.csv", "time,position,velocity,torque", TIME, position, velocity, SPEED)
    with refused(text):
        read_recording(path)


def test_time_in_milliseconds_without_saying_so_is_refused(tmp_path):
    path = write(tmp_path / "run.csv", "time,position,torque", 1e3 * TIME, ANGLE, SPEED)
    with refused("is the unit ms, us or ns?"):
        read_recording(path)


@pytest.mark.parametrize(
    ("mapping", "text"),
    [
        ({"time": {"column": "time", "unit": "s"}}, "has no 'position'"),
        (
            {"time": {"column": "time", "unit": "h"}, "position": {"column": "position", "unit": "rad"}},
            "unit of time is 'h'",
        ),
        ({"tme": {}, "position": {}}, "did you mean 'time'?"),
        (
            {
                "time": {"column": "time", "unit": "s"},
                "position": {"column": "position", "unit": "rad"},
                "input": {"column": "torque", "unit": "lb"},
            },
            "unit of input is 'lb'",
        ),
    ],
)
def test_a_wrong_mapping_is_refused(tmp_path, mapping, text):
    path = write(tmp_path / "run.csv", "time,position,torque", TIME, ANGLE, SPEED)
    with refused(text):
        read_recording(path, mapping)


def test_a_servo_log_is_read_with_its_constants(tmp_path):
    entries = [
        {
            "timestamp": 0.01 * i,
            "position": 0.1,
            "speed": 0.0,
            "goal_position": 0.2,
            "torque_enable": i > 2,
            "load": 65530,
        }
        for i in range(10)
    ]
    path = tmp_path / "log.json"
    path.write_text(json.dumps({"mass": 0.49, "length": 0.1, "kp": 100, "vin": 7.4, "entries": entries}))
    recording = read_recording(path)
    assert recording.input_kind == "position_goal"
    assert recording.meta["kp"] == 100
    assert recording.meta["load"][0] == pytest.approx(-0.006)
    np.testing.assert_array_equal(recording.enabled[:4], [0, 0, 0, 1])
    del entries[4]["goal_position"]
    path.write_text(json.dumps({"entries": entries}))
    with refused("column 'goal_position' is nan in row 4"):
        read_recording(path)


def test_rows_keep_the_input_before_them_for_delays():
    recording = Recording(TIME, ANGLE, SPEED, SPEED)
    part = recording.rows(50, 100)
    assert part.time[0] == TIME[50]
    assert part.input_stamps[0] == TIME[0]
    assert recording.between(0.5, 1.0).time.size == 50


def test_the_duty_gain_of_a_part_of_a_servo_log_is_that_of_its_own_rows():
    from pendulum_bags.identification.output_error import _duty_gain

    goal = ANGLE + 0.1 * np.sign(np.sin(7.0 * TIME))
    meta = {"kp": 100.0, "load": 0.25 * (goal - ANGLE)}
    log = Recording(TIME, ANGLE, SPEED, goal, "position_goal", "zero", enabled=np.ones_like(TIME), meta=meta)
    for part in (log, log.rows(50, 150), log.between(0.5, 1.0)):
        assert _duty_gain(part) == pytest.approx(0.0025)


def test_what_does_not_exist_or_has_an_unknown_suffix_is_refused(tmp_path):
    with refused("does not exist"):
        read_recording(tmp_path / "nothing.csv")
    (tmp_path / "data.xyz").write_text("")
    with refused("has the suffix '.xyz'; expected .csv, .txt"):
        read_recording(tmp_path / "data.xyz")


def test_a_hebi_log_that_cannot_be_read_is_reported_by_the_program_that_reads_it(tmp_path):
    (tmp_path / "hw.hebilog").write_bytes(b"no log")
    with refused("is no HEBI log"):
        read_recording(tmp_path / "hw.hebilog")
    with refused("expected the lab file of a HEBI log"):
        read_recording(tmp_path / "hw.hebilog", {"time": {"column": "t"}})


def test_words_and_holes_in_columns_that_no_mapping_wants_are_no_matter(tmp_path):
    path = tmp_path / "run.csv"
    rows = [f'{t},"swing, free",{q},,{v},{v}' for t, q, v in zip(TIME, ANGLE, SPEED, strict=True)]
    path.write_text("\n".join(["time,label,Position,gap,velocity,torque", *rows]) + "\n", encoding="utf-8")
    np.testing.assert_allclose(read_recording(path).position, ANGLE)
    path.write_text("time,label,position,torque\n0.0,a,1.0,0.0\n0.1,b,oops,0.0\n", encoding="utf-8")
    with refused("line 3, column 'position' holds 'oops'; expected a number"):
        read_recording(path)
    path.write_text("time,label,position,torque\n0.0,a,1.0,0.0\n0.1,b,1.0\n0.2,c,1.0,0.0\n", encoding="utf-8")
    with refused("line 3 has 3 cells; expected 4"):
        read_recording(path)


def test_a_hole_in_a_column_that_no_mapping_wants_drops_no_row(tmp_path):
    other = np.where(np.arange(TIME.size) % 2, np.nan, 1.0)
    path = write(tmp_path / "run.csv", "time,position,other", TIME, ANGLE, other)
    columns = {name: {"column": name, "unit": unit} for name, unit in (("time", "s"), ("position", "rad"))}
    assert read_recording(path, {**columns, "drop_nan": True}).time.size == TIME.size


def test_a_mapping_that_asks_for_other_columns_names_those_that_there_are(tmp_path):
    path = write(tmp_path / "run.csv", "t,theta", TIME, ANGLE)
    with refused("has no column 'time' for time (asked for by built-in mapping 'pendulum'); it has t, theta"):
        read_recording(path, "pendulum")
    with pytest.raises(DataError) as caught:
        read_recording(path, {"time": {"column": "s", "unit": "s"}, "position": {"column": "q", "unit": "rad"}})
    assert "--mapping" not in str(caught.value)
