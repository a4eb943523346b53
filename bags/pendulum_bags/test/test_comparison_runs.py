"""Comparison of recorded runs, from bags to verdict."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline

from pendulum_bags.commands.compare_cli import main
from pendulum_bags.commands.report_cli import main as report_main
from pendulum_bags.commands.whole_run import _print_summary
from pendulum_bags.comparison import Outcome, compare_folders, compare_runs, read_run
from pendulum_bags.comparison.compare import _pool
from pendulum_bags.report import FIGURES
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.tables import make_tables
from pendulum_bags.runs.run_data import missed_periods, timing_warning
from pendulum_bags.verdict.same_run import seen_note
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import BagError, DataError
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.synthetic_runs import regulate, run_metadata, write_bag, write_run_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run_folder(tmp_path_factory.mktemp("runs") / "first", seed=1)


def test_figures_of_a_plant_are_those_of_its_arrays(folder: Path) -> None:
    columns = regulate(rate=100.0, seed=1, hardware=True)
    plant = compare_folders([folder]).plants["hw"]
    assert plant["std_theta"] == pytest.approx(columns["position"].std(ddof=1), rel=1e-12)
    assert plant["std_theta_dot"] == pytest.approx(columns["velocity"].std(ddof=1), rel=1e-12)
    assert plant["max_abs_u"] == np.abs(columns["command"]).max()
    assert plant["rate_hz"] == pytest.approx(100.0)
    assert plant["missed_deadlines"] == 0
    assert plant["noise_hold_time"] == 0.01


def test_unpaired_statistics_are_those_of_the_thesis(folder: Path) -> None:
    """Cubic interpolation by scipy at the simulation's stamps, difference, description by pandas."""
    sim = regulate(rate=500.0, seed=1_000_001, hold_time=0.002)
    hw = regulate(rate=100.0, seed=1, hardware=True)
    times = sim["t"][sim["t"] <= hw["t"][-1] + 1e-9]
    spline = CubicSpline(hw["t"], hw["position"])(times)
    expected = pd.Series(spline - sim["position"][: times.size]).describe()
    found = compare_folders([folder]).unpaired["position"]
    np.testing.assert_allclose(list(found.values()), expected.to_numpy(), rtol=1e-6, atol=1e-12)


def test_runs_under_one_noise_are_paired_and_close(folder: Path) -> None:
    comparison = compare_runs(folder / "sim", folder / "hw", sim_prefix="/sim", hw_prefix="/hw")
    assert comparison.is_paired
    paired = comparison.paired
    assert paired["position"]["count"] == 500
    assert paired["disturbance_alignment"]["correlation"] == pytest.approx(1.0)
    assert paired["path"] < 0.2
    assert 0.0 < paired["response_alignment"]["delay_s"] < 0.006  # 4 ms of delay, seen through the plant
    assert paired["aligned"]["rms_position"] < paired["rms_position"]


def test_noise_held_for_another_time_is_no_pair_and_says_nothing_of_the_plants(folder: Path) -> None:
    comparison = compare_runs(folder / "sim_500hz", folder / "hw")
    assert not comparison.is_paired
    assert "the recorded disturbances differ" in comparison.paired["reason"]
    assert comparison.unpaired_verdict.outcome is Outcome.DIFFERENT
    assert comparison.verdict.outcome is Outcome.UNDECIDED
    assert "the disturbance was held for 2 ms in simulation and for 10 ms on hardware" in comparison.verdict.sentence


def test_references_that_began_apart_are_no_difference_of_the_plants(tmp_path: Path) -> None:
    """One plant under one noise along one sine; the noise begins as long after the controller on both sides, or not."""
    moving = {
        "controller": "lqr_tracking",
        "reference": "sine",
        "set_point": 0.1,
        "amplitude": 0.3,
        "frequency": 0.2,
        "move_time": 1.5,
    }

    def record(side: str, name: str, after: float, **reference: float) -> Path:
        columns = regulate(rate=100.0, seed=1, hardware=side == "hw")
        columns["position"] = columns["position"] + 0.1 + 0.3 * np.sin(2.0 * np.pi * 0.2 * (columns["t"] + after))
        metadata = {**run_metadata(1), "pendulum.parameters": {f"/{side}/controller": {**moving, **reference}}}
        metadata["pendulum.run"]["controller"] = {"kind": "lqr_tracking"}
        return write_bag(tmp_path / name, columns, f"/{side}", metadata=metadata, ramps=after > 0.0)

    simulation = record("sim", "sim", 1.0)
    together = compare_runs(simulation, record("hw", "hw", 1.0))
    assert together.unlike_references == ""
    assert together.seen == "at the slower plant's sampling times and below 20 Hz"
    assert together.plants["hw"]["rms_tracking_error"] == pytest.approx(
        regulate(rate=100.0, seed=1, hardware=True)["position"].std(), rel=0.1
    )
    apart = compare_runs(simulation, record("hw", "late", 0.0))
    assert apart.verdict.outcome is Outcome.UNDECIDED
    assert "the moving references of both sides were" in apart.verdict.sentence
    assert apart.is_paired
    assert apart.seen == "below 20 Hz", "the tests are those without pairs"
    # Five seconds are a whole period: what is said is no matter of where in it the noise began.
    assert float(apart.unlike_references.split(" were ")[1].split()[0]) == pytest.approx(
        0.3 * np.sqrt(2.0) * np.sin(np.pi * 0.2), rel=0.05
    )
    told = run_metadata(1)
    told["pendulum.run"]["controller"] = {"kind": "lqr_tracking"}
    untold = write_bag(tmp_path / "untold", regulate(rate=100.0, seed=1, hardware=True), "/hw", metadata=told)
    assert "not known on both sides which and since when" in compare_runs(simulation, untold).verdict.sentence


def test_content_is_json_with_the_fields_that_a_summary_promises(folder: Path) -> None:
    content = compare_folders([folder], margin={"mean_angle": 0.5}).to_json()
    text = json.dumps(content, allow_nan=False)
    again = json.loads(text)
    for plant in ("sim", "hw"):
        for key in ("rate_hz", "missed_deadlines", "std_theta", "std_theta_dot", "max_abs_u"):
            assert isinstance(again["plants"][plant][key], (int, float))
    for block in ("paired", "unpaired"):
        for key in ("position", "velocity"):
            assert list(again[block][key]) == ["count", "mean", "std", "min", "25%", "50%", "75%", "max"]
    assert again["seed"] == 1
    assert again["strategy"] == "direct_pwm"
    assert again["versions"]
    assert again["verdict"]["margins"]["stated"] == ["mean_angle"]


def test_a_difference_in_the_plant_is_found(tmp_path: Path) -> None:
    folder = write_run_folder(tmp_path / "stiff", ramps=False, changes={"damping": 25.0})
    verdict = compare_folders([folder]).verdict
    assert verdict.outcome is Outcome.DIFFERENT
    assert "spread of velocity" in verdict.sentence


def test_pooled_runs_narrow_the_intervals(folder: Path, tmp_path: Path) -> None:
    folders = [folder, *(write_run_folder(tmp_path / str(seed), seed, ramps=False) for seed in (2, 3, 4))]
    one, four = compare_folders(folders[:1]), compare_folders(folders)
    widths = [
        [test.interval.high - test.interval.low for test in result.unpaired_verdict.tests] for result in (one, four)
    ]
    assert np.median(np.array(widths[1]) / np.array(widths[0])) < 0.8
    content = four.to_json()
    assert content["runs"] == 4
    assert len(content["paired"]["runs"]) == 4
    assert content["plants"]["hw"]["samples"] == 2000


def test_figures_of_several_runs_are_those_of_all_their_samples(tmp_path: Path) -> None:
    """A run of 1 s beside one of 4 s, with means of their own: numpy on the samples themselves is the reference."""
    folders, columns = [], []
    for seed, duration, offset in ((1, 1.0, 0.0), (2, 4.0, 0.004)):
        place = tmp_path / str(seed)
        sim = regulate(rate=500.0, seed=seed, duration=duration)
        hw = regulate(rate=100.0, seed=seed, duration=duration, hardware=True)
        hw["position"] = hw["position"] + offset
        for name, motion in (("sim", sim), ("hw", hw)):
            write_bag(place / name, motion, f"/{name}", metadata=run_metadata(seed), ramps=False)
        folders.append(place)
        columns.append(hw)
    comparison = compare_folders(folders)
    plant = comparison.plants["hw"]
    position, velocity, command = (
        np.concatenate([one[name] for one in columns]) for name in ("position", "velocity", "command")
    )
    assert plant["std_theta"] == pytest.approx(position.std(ddof=1), rel=1e-9)
    assert plant["std_theta_dot"] == pytest.approx(velocity.std(ddof=1), rel=1e-9)
    assert plant["mean_theta"] == pytest.approx(position.mean(), rel=1e-12)
    assert plant["rms_u"] == pytest.approx(np.sqrt(np.mean(command**2)), rel=1e-9)
    assert plant["max_abs_u"] == np.abs(command).max()
    assert plant["samples"] == position.size == 500
    assert plant["duration_s"] == pytest.approx(0.99 + 3.99)
    assert plant["effective_samples"] == pytest.approx(
        sum(compare_folders([one]).plants["hw"]["effective_samples"] for one in folders)
    )
    assert plant["rate_hz"] == pytest.approx(100.0)
    (row,) = [row for row in make_tables(ReportData(comparison, {}))[0].rows if row[0] == "noise recorded [s]"]
    assert row[1:] == ("5", "4.98")
    assert make_tables(ReportData(comparison, {}))[0].sentence.startswith(
        "All samples of 2 runs, so that a run counts by their number"
    )
    alone = compare_folders(folders[:1])
    assert make_tables(ReportData(alone, {}))[0].sentence.startswith("The torque is at most")


def test_the_terminal_says_of_which_samples_its_figures_are(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    second = write_run_folder(tmp_path / "second", 2, ramps=False)
    comparison = compare_folders([folder, second])
    _print_summary(make_console(), comparison, "hebi")
    assert main([str(folder), str(second)]) == 0
    for told in capsys.readouterr().out.split("Plants during the noise"):
        words = " ".join(told.split())
        assert ", all samples of 2 runs" in words
        assert re.search(r"noise recorded \[s\]\W+10\.0\W+10\.0", words)
    assert seen_note(comparison) in words
    assert main([str(folder)]) == 0
    assert "all samples of" not in capsys.readouterr().out


def test_the_rate_of_several_runs_is_that_over_their_time() -> None:
    rows = [
        {"samples": 100, "duration_s": 1.0, "rate_hz": 100.0},
        {"samples": 600, "duration_s": 3.0, "rate_hz": 200.0},
    ]
    assert _pool(rows)["rate_hz"] == pytest.approx(175.0)
    rows = [
        {**row, "noise_hold_time": hold, "rms_tracking_error": hold}
        for row, hold in zip(rows, (0.1, None), strict=True)
    ]
    assert _pool(rows)["noise_hold_time"] is None
    rows = [{**row, "rms_tracking_error": error} for row, error in zip(rows, (1.0, 2.0), strict=True)]
    assert _pool(rows)["rms_tracking_error"] == pytest.approx(np.sqrt((100 * 1.0 + 600 * 4.0) / 700))


def test_states_that_are_missing_count_as_missed_deadlines() -> None:
    stamps = np.array([0, 2, 4, 10, 12, 14, 16, 20]) * 1_000_000
    assert missed_periods(stamps) == 3


def test_a_run_that_lost_many_states_is_distinguished_from_a_sound_one(folder: Path) -> None:
    plants = compare_folders([folder]).plants
    assert timing_warning(plants) == ""
    disturbed = {**plants, "sim": {**plants["sim"], "samples": 2384, "missed_deadlines": 116}}
    assert "sim missed 116 of 2500 states (4.6 %); check for pauses, end other programs" in timing_warning(disturbed)
    assert "busy" not in timing_warning(disturbed)


def test_without_events_the_window_is_that_of_the_disturbance(tmp_path: Path) -> None:
    columns = regulate(rate=100.0, seed=5)
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("joint_states", "disturbance"):
            bag.add_topic(f"/hw/{topic}", "sensor_msgs/msg/JointState")
        for i in range(600):
            k = min(max(i - 50, 0), 499)
            state = {"position": columns["position"][k], "velocity": columns["velocity"][k], "effort": 0.0}
            bag.write("/hw/joint_states", 10_000_000 * i, encode_joint_state(10_000_000 * i, **state))
            effort = columns["disturbance"][k] if 50 <= i < 550 else 0.0
            bag.write("/hw/disturbance", 10_000_000 * i, encode_joint_state(10_000_000 * i, effort=effort))
    run = read_run(tmp_path / "bag")
    assert run.window.t[0] == pytest.approx(0.0)
    assert run.window.duration == pytest.approx(4.98, abs=0.011)


def test_a_bag_without_noise_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/sim/joint_states", "sensor_msgs/msg/JointState")
        for i in range(10):
            bag.write("/sim/joint_states", i, encode_joint_state(i * 1000, position=0.0, velocity=0.0, effort=0.0))
    with pytest.raises(DataError, match="has neither an event 'noise_start' nor a disturbance"):
        read_run(tmp_path / "bag")


def test_a_bag_of_two_plants_asks_which(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for name in ("/sim/joint_states", "/hw/joint_states"):
            bag.add_topic(name, "sensor_msgs/msg/JointState")
            bag.write(name, 1, encode_joint_state(1, position=0.0, velocity=0.0, effort=0.0))
    with pytest.raises(DataError, match=r"holds several plants \(/hw, /sim\); choose one by its namespace"):
        read_run(tmp_path / "bag")


@pytest.mark.parametrize("still", ["sim", "hw"])
def test_a_plant_that_never_moved_is_refused_by_name(tmp_path: Path, still: str) -> None:
    for number, (side, rate) in enumerate((("sim", 500.0), ("hw", 100.0))):
        columns = regulate(rate=rate, seed=3 + number, duration=2.0, hardware=side == "hw")
        if side == still:
            columns["position"][:] = 0.02
            columns["velocity"][:] = 0.0
        write_bag(tmp_path / side, columns, f"/{side}", metadata=run_metadata(3, 0.01), ramps=False)
    name = {"sim": "simulation", "hw": "hardware"}[still]
    with pytest.raises(DataError, match=rf"the {name} of .*{still} stood still at 0\.02 rad under the noise; expected"):
        compare_folders([tmp_path])


def test_a_run_folder_without_a_bag_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run" / "sim").mkdir(parents=True)
    with pytest.raises(BagError, match="has no bag hw; expected the folders sim and hw"):
        compare_folders([tmp_path / "run"])


# -- command line ------------------------------------------------------------------------------------------------


def test_command_prints_json_and_writes_files(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The others are drawn by the tests of the report, and take seconds.
    own = [(title, maker) for title, maker in FIGURES if title in {"Equivalence tests", "Distributions"}]
    monkeypatch.setattr("pendulum_bags.report.figures.FIGURES", own)
    arguments = [
        str(folder / "sim"),
        str(folder / "hw"),
        "--margin",
        "mean_angle=0.5deg",
        "--json",
        "-o",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "comparison.json").read_text())
    for name in ("equivalence", "distributions"):
        assert (tmp_path / "figures" / f"{name}.pdf").stat().st_size > 1000
    assert printed["verdict"]["outcome"] == "equivalent"


def test_a_report_uses_the_margins_that_the_run_was_compared_with(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    monkeypatch.setattr("pendulum_bags.report.figures.FIGURES", [])
    assert main([str(run / "sim"), str(run / "hw"), "--margin", "delay=17ms", "--margin", "spread_angle=0.5deg"]) == 0
    assert f"margins {run / 'margins.yaml'} (report uses them)" in capsys.readouterr().out
    assert report_main([str(run), "--png-only"]) == 0
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "±17 ms" in page
    assert "±0.5 deg" in page
    assert report_main([str(run), "--png-only", "--margin", "delay=9ms"]) == 0
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "±9 ms" in page
    assert "±0.5 deg" not in page


def test_command_prints_the_verdict_last(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    table, question, answer = printed.partition("Is the simulation good enough to design a controller on?")
    assert question
    assert "distance of velocities less the delay" in table
    assert answer.startswith(" Yes: in this run simulation and the hardware move alike within the default margins")
    assert "What to do next: - Measure “same for feedback” and “which controllers”: python -m pendulum_bags" in answer


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere", "nowhere"], "nowhere"),
        (["one"], "got one; "),
        (["a", "b", "--margin", "wide=1deg"], "margin has no 'wide'"),
        (["a", "b", "--margin", "delay=8ms", "--margin", "delay=9ms"], "margin delay is stated twice; expected once"),
    ],
)
def test_command_refuses_in_one_sentence(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert "Traceback" not in error


def test_metadata_of_a_run_names_its_hold_time(tmp_path: Path) -> None:
    columns = regulate(rate=100.0, seed=3, duration=1.0)
    write_bag(tmp_path / "bag", columns, "/hw", metadata=run_metadata(3, 0.01), ramps=False)
    run = read_run(tmp_path / "bag", label="hardware")
    assert run.metadata["pendulum.run"]["disturbance"]["hold_time"] == 0.01
    assert run.label == "hardware"
