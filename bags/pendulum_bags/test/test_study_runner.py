"""Studies carried out in one process: resumed, retried, refused, and summed up."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.studies import pooled, runner
from pendulum_bags.studies.results import collect, episode_of_run, group_runs, run_metrics
from pendulum_bags.studies.runner import open_study_folder, read_record, run_study
from pendulum_bags.studies.study_file import Study, load_study
from pendulum_msgs_py.errors import BagError, DataError, ParameterError

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
    (tmp_path / "runs" / hands.runs[0].name / "run" / "identified.json").write_text("{}", encoding="utf-8")
    with pytest.raises(DataError, match="holds no identification"):
        pooled.analyse(tmp_path, hands, records)
