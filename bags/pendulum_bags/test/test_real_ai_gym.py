"""The study of public contests: scores with known values, a clone made by hand, and the real one if available."""

from __future__ import annotations

import csv
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.public_study_cli import main
from pendulum_bags.studies.real_ai_gym import CONTESTS, SIMULATED, TOLERANCE, comparisons, read_trials, score_of
from pendulum_bags.studies.real_ai_gym_page import Study, study_text
from pendulum_msgs_py.errors import DataError

FIRST, BY_V2, PERTURBED, IROS, ICRA = CONTESTS
TANH_V2 = (2.0 / 20.0, math.pi / 60.0, 10.0 / 100.0, 0.0, 0.0)
"""Of the swing-up below, up from 2 s on: time, energy, torque cost, smoothness and velocity cost per norm."""
SCORES = {
    "v1": 1.0 - (0.2 * 2.0 / 10.0 + 0.1 / 6.0 + 0.1 * math.pi / 100.0 + 0.1 * 10.0 / 60.0 + 0.1 * 10.0 / 360.0),
    "v2": 1.0 - sum(math.tanh(math.pi * share) for share in TANH_V2) / 5.0,
}


def swing_up(path: Path, *, up: float = 2.0, end: float = 10.0, torque: float = 1.0) -> Path:
    """Write a trajectory at rest, hanging and from ``up`` [s] on upright, under a constant torque of the shoulder."""
    t = np.round(np.arange(0.0, end + 0.005, 0.01), 2)
    zero = np.zeros_like(t)
    columns = (t, np.where(t >= up, math.pi, 0.0), zero, zero, zero, torque + zero, zero)
    path.parent.mkdir(parents=True, exist_ok=True)
    header = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2"
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
    return path


def publish(path: Path, score: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"Swingup Success,RealAI Score\n1.0,{score!r}\n")


@pytest.mark.parametrize("robot", ["acrobot", "pendubot"])
def test_scores_of_a_swing_up_are_those_of_its_criteria(tmp_path, robot):
    path = swing_up(tmp_path / "run.csv")
    assert score_of(FIRST, robot, path) == pytest.approx((SCORES["v1"],) * 2, rel=1e-9)
    assert score_of(IROS, robot, path) == pytest.approx((SCORES["v2"],) * 2, rel=1e-9)
    # The sample at 2 s counts for the interval before it.
    assert score_of(ICRA, robot, path)[0] == pytest.approx(8.01 / 60.0, rel=1e-9)


def test_the_perturbed_acrobot_has_norms_of_its_own(tmp_path):
    path = swing_up(tmp_path / "run.csv")
    harder = SCORES["v2"] - (math.tanh(math.pi * 10.0 / 20.0) - math.tanh(math.pi * 10.0 / 100.0)) / 5.0
    assert score_of(PERTURBED, "acrobot", path)[0] == pytest.approx(harder, rel=1e-9)
    assert score_of(PERTURBED, "pendubot", path)[0] == pytest.approx(SCORES["v2"], rel=1e-9)


def test_a_run_that_falls_or_ends_early_scores_nothing(tmp_path):
    assert score_of(IROS, "acrobot", swing_up(tmp_path / "down.csv", up=11.0)) == (0.0, 0.0)
    early = score_of(IROS, "acrobot", swing_up(tmp_path / "early.csv", end=9.8))
    assert early[0] == 0.0
    assert early[1] > 0.5
    assert score_of(IROS, "acrobot", swing_up(tmp_path / "whole.csv", end=9.9))[0] > 0.5


@pytest.fixture
def clone(tmp_path):
    """A clone with three controllers on the pendubot of IROS 2024: the simulation prefers the worst of the machine."""
    real, simulation = (tmp_path / "data" / "pendubot" / name for name in (IROS.folder, IROS.simulation))
    for name, simulated, ups in (("a", 0.7, (4.0, 4.1, 4.4)), ("b", 0.5, (2.0, 2.2, 2.1)), ("c", 0.3, (3.0, 3.1, 3.2))):
        publish(simulation / name / "scores.csv", simulated)
        for number, up in enumerate(ups, start=1):
            folder = real / name / f"experiment{number:02}"
            publish(folder / "scores_v2.csv", score_of(IROS, "pendubot", swing_up(folder / "trajectory.csv", up=up))[0])
    publish(simulation / "elsewhere" / "scores.csv", 0.9)
    return tmp_path


def test_a_clone_is_ranked_and_its_scores_are_checked(clone):
    wrong = clone / "data" / "pendubot" / IROS.folder / "b" / "experiment01"
    publish(wrong / "scores_v2.csv", 0.1)
    (wrong.with_name("experiment02") / "trajectory.csv").unlink()
    early = wrong.parents[2] / PERTURBED.folder / "b" / "experiment07"
    publish(early / "scores_v2.csv", score_of(PERTURBED, "pendubot", swing_up(early / "trajectory.csv", end=5.0))[1])
    trials = read_trials(clone)
    (one,) = comparisons(clone, trials)
    assert (one.contest, one.robot, one.criterion, one.trials) == (IROS, "pendubot", "score", {"a": 3, "b": 3, "c": 3})
    assert one.ranking is not None
    assert (one.ranking.pick, one.ranking.best) == ("a", "b")
    assert [(pair.picked, pair.better, pair.sure) for pair in one.ranking.wrong] == [("a", "b", True), ("a", "c", True)]
    text = "\n".join(study_text(Study(trials, [one])))
    assert "7 of 9 scores computed from trajectories equal the published ones" in text
    assert "IROS 2024, b, trial 1: computed 0.8" in text
    assert "published 0.100, for a cause that is not known" in text
    assert "perturbed, b, trial 7: computed 0.000, published 0.8" in text
    assert "up at its end before 10 s" in text
    assert "By score the simulation's pick is the best on the machine in 0 of 1 contests, a random pick in 0.3" in text


def test_trials_are_pairs_where_the_contest_gave_all_controllers_the_same_perturbations(clone):
    """Each controller's trials scatter far more than any two differ: only as pairs is the order sure."""
    for name, later in (("a", 0.2), ("b", 0.0), ("c", 0.1)):
        for number, up in enumerate((1.0, 2.0, 3.0), start=1):
            folder = clone / "data" / "pendubot" / IROS.folder / name / f"experiment{number:02}"
            swing_up(folder / "trajectory.csv", up=up + later)
    trials = read_trials(clone)
    (paired,) = comparisons(clone, trials)
    apart = [one._replace(contest=IROS._replace(paired=False)) for one in trials]
    (unpaired,) = comparisons_of(clone, apart)
    assert all(pair.sure for pair in paired.ranking.wrong)
    assert not any(pair.sure for pair in unpaired.ranking.wrong)


def comparisons_of(clone, trials):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pendulum_bags.studies.real_ai_gym.CONTESTS", [trials[0].contest])
        return comparisons(clone, trials)


def test_the_simulation_also_picks_by_the_machines_norms_and_by_its_robustness(clone):
    pendubot = clone / "data" / "pendubot"
    for name, up in (("a", 5.0), ("b", 4.0), ("c", 3.0)):
        swing_up(pendubot / IROS.simulation / name / "sim_swingup.csv", up=up)
        (pendubot / "robustness_v2" / name).mkdir(parents=True)
        (pendubot / "robustness_v2" / name / "scores.yml").write_text(f"delay: 0.5\nmodel: {1.0 - 0.1 * up}\n")
    found = {one.criterion: one.ranking for one in comparisons(clone, read_trials(clone))}
    assert list(found) == list(SIMULATED)
    assert [one.pick for one in found.values()] == ["a", "c", "c"]
    by_robustness = dict(zip(found["robustness"].names, found["robustness"].sim, strict=True))
    assert by_robustness == pytest.approx({"a": 0.5, "b": 0.55, "c": 0.6})


def test_the_command_prints_writes_and_refuses(clone, capsys, tmp_path):
    out = tmp_path / "out"
    assert main(["real_ai_gym", "--data", str(clone), "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "real_ai_gym.json").read_text())
    assert printed["comparisons"][0]["ranking"]["pick"] == "a"
    assert "IROS 2024, pendubot" in (out / "real_ai_gym.html").read_text()
    assert (out / "figures" / "scores_1.pdf").stat().st_size > 5_000
    assert main(["real_ai_gym", "--data", str(clone)]) == 0
    assert "9 of 9 scores" in capsys.readouterr().out
    assert main(["real_ai_gym", "--data", str(tmp_path / "none")]) == 2
    assert "expected a clone of github.com" in capsys.readouterr().err


def test_files_that_are_none_are_named(clone):
    file = clone / "data" / "pendubot" / IROS.folder / "a" / "experiment01" / "trajectory.csv"
    rows = [row[:-1] for row in csv.reader(file.read_text().splitlines())]
    file.write_text("\n".join(",".join(row) for row in rows))
    with pytest.raises(DataError, match=r"trajectory\.csv lacks the columns tau_con2"):
        read_trials(clone)
    for torque, rows in ((math.nan, "0 of 1001"), (1.0, "2 of 2")):
        swing_up(file, torque=torque, end=0.01 if rows == "2 of 2" else 10.0)
        with pytest.raises(DataError, match=rf"trajectory\.csv has {rows} rows finite; expected all, and at least 3"):
            read_trials(clone)
    for content in ("Score\n", "RealAI Score\nnan\n"):
        (file.parent / "scores_v2.csv").write_text(content)
        with pytest.raises(DataError, match="no finite number under RealAI Score"):
            read_trials(clone)
    publish(swing_up(file).with_name("scores_v2.csv"), 0.5)
    file.parent.rename(file.parent.with_name("experiment01b"))
    with pytest.raises(DataError, match="experiment01b has no number; expected a folder of a trial"):
        read_trials(clone)


def test_the_published_scores_of_the_real_trials_are_reproduced(shared_data):
    data = Path(os.environ.get("REAL_AI_GYM_LEADERBOARD", shared_data / "real_ai_gym_leaderboard"))
    if not (data / "data").is_dir():
        pytest.skip(f"no clone of real_ai_gym_leaderboard at {data}; REAL_AI_GYM_LEADERBOARD names its folder")
    trials = read_trials(data)
    assert sum(one.computed is not None for one in trials) >= 190
    differing = [one for one in trials if abs(one.score - one.published) > TOLERANCE]
    assert [(one.contest, one.robot, one.number) for one in differing] == [(PERTURBED, "pendubot", 8)]
    assert differing[0].reason
    found = {(one.contest.name, one.robot, one.criterion): one.ranking for one in comparisons(data, trials)}
    first = found["first board", "pendubot", "score"]
    assert (first.pick, first.best, first.regret.value) == ("mcpilco", "mcpilco", 0.0)
    iros, icra = (found[name, "pendubot", "score"] for name in ("IROS 2024", "ICRA 2025"))
    assert (iros.pick, iros.best, round(iros.regret.value, 3)) == ("history_sac", "ar_eapo", 0.303)
    assert (icra.pick, icra.best, round(icra.regret.value, 3)) == ("vimppi", "acados_mpc", 0.353)
    assert round(icra.spearman, 2) == -0.4
