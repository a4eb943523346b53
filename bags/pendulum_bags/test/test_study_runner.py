"""Studies carried out in one process: resumed, retried, refused, and summed up."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.processes import Child, ProcessSet
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.studies import pid_vs_lqr, pooled, runner
from pendulum_bags.studies.results import (
    Group,
    collect,
    episode_of_run,
    group_runs,
    groups_to_json,
    read_record,
    run_metrics,
)
from pendulum_bags.studies.runner import open_study_folder, run_study
from pendulum_bags.studies.study_file import Study, load_study
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_testing.synthetic_runs import write_run_folder

TEXT = """format: pendulum_study/1
name: small
duration: 0.5
plants:
  sim: {engine: process}
controllers:
  lqr: {q: [100.0, 0.01], r: 0.1}
disturbances:
  noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}
seeds: {first: 1, count: 3}
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    path = tmp_path / "small.yaml"
    path.write_text(TEXT, encoding="utf-8")
    return load_study(path)


def test_study_resumes_where_it_stopped(tmp_path: Path, study: Study) -> None:
    folder = tmp_path / "out"
    open_study_folder(folder, study)

    def stop_after_one(progress: runner.StudyProgress) -> None:
        if progress.done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(folder, study, workers=1, on_progress=stop_after_one)
    before = [read_record(folder, run) for run in study.runs]
    assert sum(record is not None for record in before) == 1

    open_study_folder(folder, study)
    end = run_study(folder, study, workers=1)
    assert (end.done, end.skipped, end.failed) == (3, 1, 0)
    assert read_record(folder, study.runs[0]) == before[0]


def test_runs_in_lockstep_fill_the_cores_and_others_have_the_machine_to_themselves(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert runner.default_workers(study) == 3
    assert runner.default_workers(replace(study, clock="realtime")) == 1


@pytest.mark.parametrize(("clock", "alone"), [("lockstep", False), ("realtime", True)])
def test_runs_in_lockstep_share_processes_and_others_start_afresh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: str, alone: bool
) -> None:
    path = tmp_path / "nodes.yaml"
    path.write_text(f"clock: {clock}\n{TEXT.replace('engine: process', '')}", encoding="utf-8")
    nodes, started, hosts = load_study(path), [], []
    open_study_folder(tmp_path / "out", nodes)
    start = ProcessSet.start

    def note(processes: ProcessSet, name: str, command: Sequence[str], **settings: Any) -> Child:
        started.append(settings.pop("alone"))
        hosts.append(processes.hosts)
        return start(processes, name, [sys.executable, "-c", ""], **settings)

    monkeypatch.setattr(ProcessSet, "start", note)
    assert run_study(tmp_path / "out", nodes, workers=1).failed == 3  # nothing was recorded
    assert started == [alone] * 3
    assert None not in hosts


def test_failed_run_is_recorded_and_retried_only_on_request(
    tmp_path: Path, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    open_study_folder(folder, study)

    def fail(_run: object, _place: Path) -> None:
        raise DataError("the plant is out for lunch")

    monkeypatch.setattr(runner, "_simulate", fail)
    assert run_study(folder, study, workers=1).failed == 3
    monkeypatch.undo()
    assert run_study(folder, study, workers=1).failed == 3
    record = read_record(folder, study.runs[0])
    assert record is not None
    assert record["reason"] == "the plant is out for lunch"

    assert run_study(folder, study, workers=1, retry_failed=True).failed == 0
    record = read_record(folder, study.runs[0])
    assert record is not None
    assert record["attempts"] == 2


def test_folder_of_another_study_is_refused(tmp_path: Path, study: Study) -> None:
    folder = tmp_path / "out"
    open_study_folder(folder, study)
    other = tmp_path / "other.yaml"
    other.write_text(TEXT.replace("amplitude: 2.5", "amplitude: 1.0"), encoding="utf-8")
    with pytest.raises(BagError, match="another study"):
        open_study_folder(folder, load_study(other))


def test_a_study_that_is_given_seeds_and_plants_keeps_what_was_carried_out(tmp_path: Path, study: Study) -> None:
    folder = tmp_path / "out"
    run_study(folder, open_study_folder(folder, study), workers=1)
    before = {run.name: read_record(folder, run) for run in study.runs}
    grown = tmp_path / "grown.yaml"
    for text in (
        TEXT.replace("count: 3", "count: 5"),
        # A plant before the others: in the order of the file every run has another number now.
        TEXT.replace("count: 3", "count: 5").replace("  sim: {", "  fine: {engine: process, method: etd4}\n  sim: {"),
    ):
        grown.write_text(text, encoding="utf-8")
        larger = open_study_folder(folder, load_study(grown))
        end = run_study(folder, larger, workers=1)
        assert (end.done, end.skipped) == (len(larger.runs), len(before))
        assert {name: read_record(folder, run) for run in larger.runs if (name := run.name) in before} == before
        assert sorted(run.number for run in larger.runs) == list(range(1, len(larger.runs) + 1))
        before = {run.name: read_record(folder, run) for run in larger.runs}
    groups = group_runs(collect(folder, larger))
    assert {group.labels["plant"]: sorted(group.seeds) for group in groups} == {
        "fine": [1, 2, 3, 4, 5],
        "sim": [1, 2, 3, 4, 5],
    }
    with pytest.raises(BagError, match=r"run 4 \(sim_lqr_noise_upright_seed4\) is not in it"):
        open_study_folder(folder, study)


def test_repeats_are_added_too(tmp_path: Path) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(TEXT + "repeats: 2\n", encoding="utf-8")
    folder = tmp_path / "out"
    first = open_study_folder(folder, load_study(path))
    path.write_text(TEXT + "repeats: 3\n", encoding="utf-8")
    second = open_study_folder(folder, load_study(path))
    numbers = {(run.labels["seed"], run.labels["repeat"]): run.number for run in second.runs}
    assert {key: numbers[key] for key in ((run.labels["seed"], run.labels["repeat"]) for run in first.runs)} == {
        (run.labels["seed"], run.labels["repeat"]): run.number for run in first.runs
    }
    assert sorted(numbers.values()) == list(range(1, 10))


@pytest.mark.parametrize("key", ["plant", "design_plant"])
def test_a_plant_file_that_changed_makes_another_study(tmp_path: Path, key: str) -> None:
    plant = tmp_path / "mine.yaml"
    write_plant(plant, replace(load_plant("thesis"), name="mine"))
    path = tmp_path / "small.yaml"
    path.write_text(TEXT.replace("engine: process", f"engine: process, {key}: {plant}"), encoding="utf-8")
    folder = tmp_path / "out"
    open_study_folder(folder, load_study(path))
    open_study_folder(folder, load_study(path))
    write_plant(plant, load_plant("thesis").with_values(name="mine", inertia=0.06))
    with pytest.raises(BagError, match="the files that it names included"):
        open_study_folder(folder, load_study(path))


def test_a_share_of_successes_has_an_interval_of_a_share_and_a_failure_is_its_worst() -> None:
    values = {"success": np.array([1.0, 1.0, 0.0, 1.0, 1.0]), "ise": np.array([1.0, 2.0, 9.0, 1.0, 1.0])}
    group = Group({}, (11, 12, 13, 14, 15), values, 0)
    # Wilson's interval of 4 in 5, by hand: (0.8 + 1.9208/5 +- 1.96 sqrt(0.16/5 + 0.9604/25)) / (1 + 3.8416/5).
    assert group.mean("success") == pytest.approx((0.8, 0.3755, 0.9638), abs=1e-4)
    assert group.worst("success") == (0.0, 13)
    assert group.worst("ise") == (9.0, 13)
    (row,) = groups_to_json([group])
    assert (row["metrics"]["success"]["worst"], row["metrics"]["success"]["worst_seed"]) == (0.0, 13)
    all_of_them = Group({}, (1, 2), {"success": np.ones(2)}, 0).mean("success")
    assert all_of_them[1] < 1.0 == all_of_them[2]


def test_pairs_of_controllers_are_of_one_disturbance_and_one_start() -> None:
    records = []
    for number, (disturbance, factor) in enumerate((("weak", 2.0), ("strong", 3.0))):
        for controller in ("pid", "lqr"):
            for seed in (1, 2, 3):
                ise = (1.0 + seed + 10.0 * number) * (factor if controller == "lqr" else 1.0)
                labels = {
                    "plant": "sim",
                    "controller": controller,
                    "disturbance": disturbance,
                    "set_point": 0.0,
                    "start": "upright",
                    "seed": seed,
                    "repeat": 1,
                }
                records.append({"status": "done", "labels": labels, "metrics": dict.fromkeys(pid_vs_lqr.COMPARED, ise)})
    pairs = pid_vs_lqr._paired(pid_vs_lqr._by_place(records))
    assert {(pair["plant"], pair["seeds"], round(pair["ratio"], 9)) for pair in pairs} == {
        ("sim, weak", 3, 2.0),
        ("sim, strong", 3, 3.0),
    }
    alone = [record for record in records if record["labels"]["disturbance"] == "weak"]
    assert {pair["plant"] for pair in pid_vs_lqr._paired(pid_vs_lqr._by_place(alone))} == {"sim"}


def test_groups_have_means_with_intervals_and_the_seed_of_the_worst_case(tmp_path: Path, study: Study) -> None:
    folder = tmp_path / "out"
    open_study_folder(folder, study)
    run_study(folder, study, workers=2)
    (group,) = group_runs(collect(folder, study))
    values = group.values["max_effort"]
    mean, low, high = group.mean("max_effort")
    assert mean == pytest.approx(values.mean())
    # Student's t of two degrees of freedom at 97.5 %: 4.3027.
    assert high - low == pytest.approx(2 * 4.302652729911275 * values.std(ddof=1) / math.sqrt(3))
    worst, seed = group.worst("max_effort")
    spec = study.runs[seed - 1].spec
    assert spec is not None
    again = simulate(spec)
    assert np.abs(again.command).max() == worst


def test_run_from_far_ends_on_the_turn_on_which_it_stands(tmp_path: Path) -> None:
    spec = RunSpec(theta=-2.0, duration=3.0, controller_parameters={"q": [100.0, 0.01], "r": 0.1})
    np.savez(tmp_path / "run.npz", **vars(simulate(spec)))
    episode = episode_of_run(tmp_path, spec)
    assert episode.error[0] == pytest.approx(math.pi - 2.0)
    assert abs(episode.error[-1]) < 0.01
    metrics = run_metrics(tmp_path, spec)
    assert metrics["success"] == 1.0
    assert metrics["overshoot"] == pytest.approx(0.0, abs=1e-3)


def test_run_survives_the_way_through_json() -> None:
    spec = RunSpec(side="hw", controller="pid", disturbance={"kind": "sine", "frequency": 2.0}, seed=9)
    assert RunSpec.from_json(json.loads(json.dumps(spec.to_json()))) == spec
    with pytest.raises(ParameterError, match="unknown parameter"):
        RunSpec.from_json({**spec.to_json(), "colour": "red"})


def test_hands_of_an_identification_experiment_are_pooled(tmp_path: Path) -> None:
    path = tmp_path / "hands.yaml"
    path.write_text(
        "format: pendulum_study/1\nname: hands\nexperiment: inertia_damping\nseeds: [1, 2, 3]\n", encoding="utf-8"
    )
    hands = load_study(path)
    records = []
    for run, damping in zip(hands.runs, (11.0, 12.0, 99.0), strict=True):
        place = tmp_path / "runs" / run.name / "run"
        place.mkdir(parents=True)
        found = {"average": {"damping": damping}, "intervals": {"damping": [damping - 0.1, damping + 0.1]}}
        (place / "identified.json").write_text(json.dumps(found), encoding="utf-8")
        records.append({"number": run.number, "status": "failed" if damping == 99.0 else "done"})
    result = pooled.analyse(tmp_path, hands, records)
    assert [row["seed"] for row in result["identified"]] == [1, 2]
    # Student's t of one degree of freedom at 97.5 %: 12.706.
    half = 12.706204736174698 * math.sqrt(0.5) / math.sqrt(2.0)
    assert result["pooled"]["damping"] == pytest.approx({"mean": 11.5, "low": 11.5 - half, "high": 11.5 + half})
    # A number that is none is null in a result file; the table says so.
    first = tmp_path / "runs" / hands.runs[0].name / "run" / "identified.json"
    first.write_text('{"average": {"damping": null}, "intervals": {"damping": [null, 1.0]}}', encoding="utf-8")
    console = Console(width=200, record=True)
    pooled.print_table(console, pooled.analyse(tmp_path, hands, records))
    assert "nan (nan to 1)" in console.export_text()
    first.write_text("{}", encoding="utf-8")
    with pytest.raises(DataError, match="holds no identification"):
        pooled.analyse(tmp_path, hands, records)


def test_only_runs_that_differ_in_their_seed_alone_are_pooled_and_a_repeated_seed_counts_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "noises.yaml"
    path.write_text(
        "format: pendulum_study/1\nname: noises\nexperiment: thesis\nseeds: [1, 2]\nrepeats: 2\n"
        "plants:\n  sim: {plant: thesis}\n"
        "controllers:\n  lqr: {q: [100.0, 0.01], r: 0.1}\n  soft: {kind: lqr, q: [1.0, 0.1], r: 0.1}\n"
        "disturbances:\n  noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}\n",
        encoding="utf-8",
    )
    noises = load_study(path)
    assert len(noises.runs) == 8
    made = {seed: write_run_folder(tmp_path / f"seed_{seed}", seed, ramps=False) for seed in (1, 2)}
    for run in noises.runs:
        place = tmp_path / "runs" / run.name / "run"
        place.parent.mkdir(parents=True)
        place.symlink_to(made[run.labels["seed"]])
    # Both runs of the last seed under the second controller failed.
    failed = {run.number for run in noises.runs if (run.labels["controller"], run.labels["seed"]) == ("soft", 2)}
    assert len(failed) == 2
    records = [{"number": run.number, "status": "failed" if run.number in failed else "done"} for run in noises.runs]
    result = pooled.analyse(tmp_path, noises, records)
    told = {content["of"][1]: content["runs"] for content in result["comparisons"]}
    assert told == {"lqr": 2, "soft": 1}
    pooled.print_table(Console(width=200), result)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[:2] for line in lines] == [
        ["sim, lqr, noise", "2 runs pooled"],
        ["sim, soft, noise", "1 run"],
    ]
