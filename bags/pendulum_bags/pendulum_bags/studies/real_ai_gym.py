"""Public contests on a real acrobot and pendubot: would their simulation have picked the best controller?

Each trial on the machines is scored from its trajectory and compared with its published score; then each contest's
simulation ranks the controllers that ran on both sides.

Source: github.com/dfki-ric-underactuated-lab/real_ai_gym_leaderboard (81ea5bc), read from a clone; rules: its folder
leaderboards and github.com/dfki-ric-underactuated-lab/double_pendulum (1e8544e), folder leaderboard.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.ranking.contender import Contender
from pendulum_bags.ranking.ranking import Ranking, rank
from pendulum_bags.recordings.delimited import read_delimited
from pendulum_bags.studies.mechanism_benchmark import (
    BENCHMARK_PLANTS,
    CRITERIA,
    CRITERIA_HARDWARE,
    Criterion,
    benchmark_plant,
    criteria_of,
    score_v1,
    score_v2,
    time_above_line,
)
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import load_yaml

__all__ = [
    "CONTESTS",
    "SIMULATED",
    "TOLERANCE",
    "Comparison",
    "Contest",
    "Trial",
    "comparisons",
    "published_score",
    "read_trials",
    "score_of",
    "score_of_rows",
    "trajectory_rows",
]

TOLERANCE = 0.005
"""Largest difference of a score from the published one that counts as equal."""
SIMULATED = {
    "score": "scores*.csv",
    "score by the machine's norms": "sim_swingup.csv",
    "robustness": "scores.yml",
}
"""What a simulation picks by, and the files that give it. Score v2 has other norms in simulation than on machines."""
_SCORE, _NORMS, _ROBUSTNESS = SIMULATED
_LEAST = 3
"""Smallest number of controllers of a ranking, and of rows of a run."""
_WHOLE = 0.99
"""Share of its planned length from which a run may be a success."""
_ALIASES = {"MC-PILCO": "mcpilco", "ilqr_tvlqr": "ilqr_tvlqr_lqr"}
"""Folders of controllers that have another name elsewhere."""
_COLUMNS = ("time", "pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2", "tau_con1", "tau_con2")


class Contest(NamedTuple):
    """A contest: folder of its trials below ``data/ROBOT``, version of its score, folder of its simulation or empty.

    ``duration`` is the planned length of a trial [s]; ``paired`` says that trial i of each controller had the same
    perturbations; ``norms`` are a robot's own, where its board was made with others.
    """

    name: str
    folder: str
    version: str
    simulation: str = ""
    duration: float = 10.0
    paired: bool = False
    norms: tuple[tuple[str, tuple[Criterion, ...]], ...] = ()


_PERTURBED = tuple(one._replace(norm=1.0) if one.name == "torque_smoothness" else one for one in CRITERIA)
CONTESTS = (
    Contest("first board", "real_system", "v1", "simulation"),
    Contest("first board by v2", "real_system", "v2", "simulation_v2"),
    Contest("first board, perturbed", "real_system_perturbed", "v2", norms=(("acrobot", _PERTURBED),)),
    Contest("IROS 2024", "real_system_iros2024", "v2", "simulation_v2", paired=True),
    Contest("ICRA 2025", "real_system_icra2025", "v3", "simulation_icra2025", 60.0),
)


class Trial(NamedTuple):
    """A trial on a machine: its published score, that of its trajectory or None, and a tested cause of a difference."""

    contest: Contest
    robot: str
    controller: str
    number: int
    published: float
    computed: float | None
    reason: str = ""

    @property
    def score(self) -> float:
        """The computed score, or else the published one."""
        return self.published if self.computed is None else self.computed


class Comparison(NamedTuple):
    """A contest's ranking by a criterion of its simulation, judged by the trials on the machine.

    There is none of fewer than three controllers; ``trials`` counts those on the machine by controller.
    """

    contest: Contest
    robot: str
    criterion: str
    ranking: Ranking | None
    trials: dict[str, int]


def trajectory_rows(trajectory: Path) -> Array:
    """Return a trajectory's rows of time, measured state and commanded torques, shape (N, 7).

    Raises:
        DataError: The file lacks one of these columns, or has fewer than 3 rows of finite numbers.
    """
    table = read_delimited(trajectory)
    if missing := [name for name in _COLUMNS if name not in table.columns]:
        raise DataError(
            f"{trajectory} lacks the columns {', '.join(missing)}; expected a trajectory of the leaderboard"
        )
    rows = np.stack([table.values(name) for name in _COLUMNS], axis=1)
    finite = int(np.isfinite(rows).all(axis=1).sum())
    if not _LEAST <= finite == len(rows):
        raise DataError(f"{trajectory} has {finite} of {len(rows)} rows finite; expected all, and at least {_LEAST}")
    return rows


def score_of(contest: Contest, robot: str, trajectory: Path) -> tuple[float, float]:
    """Return a trajectory's score by the contest's rules on the machine, and the same of a run of any length."""
    return score_of_rows(contest, robot, trajectory_rows(trajectory))


def score_of_rows(contest: Contest, robot: str, rows: Array, *, simulated: bool = False) -> tuple[float, float]:
    """Return both scores of :func:`score_of`; of a ``simulated`` run by the simulation's norms."""
    times, states, efforts, plant = rows[:, 0], rows[:, 1:5], rows[:, 5:], benchmark_plant(robot)
    if contest.version == "v3":
        return (time_above_line(plant, times, states) / contest.duration,) * 2
    criteria, end = criteria_of(plant, times, states, efforts), float(times[-1])
    norms = CRITERIA if simulated else dict(contest.norms).get(robot, CRITERIA_HARDWARE)
    score = score_v1(criteria, end) if contest.version == "v1" else score_v2(criteria, end, norms)
    return score if end >= _WHOLE * contest.duration else 0.0, score


def read_trials(data: Path) -> list[Trial]:
    """Return every trial of all contests in a clone, scored where it has the trajectory.

    Raises:
        DataError: There are no trials, or a file is damaged.
    """
    trials = []
    for contest in CONTESTS:
        name = "scores.csv" if contest.version == "v1" else f"scores_{contest.version}.csv"
        for robot in BENCHMARK_PLANTS:
            for file in sorted((data / "data" / robot / contest.folder).glob(f"*/experiment*/{name}")):
                published, trajectory = published_score(file), file.with_name("trajectory.csv")
                of_rules, of_any = score_of(contest, robot, trajectory) if trajectory.is_file() else (None, published)
                short = of_rules is not None and abs(of_rules - of_any) > TOLERANCE >= abs(of_any - published)
                reason = f"up at its end before {contest.duration:g} s: published as a success, none by the rules"
                number = file.parent.name.removeprefix("experiment")
                if not number.isdecimal():
                    raise DataError(f"{file.parent} has no number; expected a folder of a trial, as experiment01")
                trials.append(Trial(contest, robot, _name(file, -3), int(number), published, of_rules, reason * short))
    if not trials:
        raise DataError(
            f"{data} holds no scores as data/acrobot/real_system/CONTROLLER/experiment01/scores.csv; expected a clone "
            "of github.com/dfki-ric-underactuated-lab/real_ai_gym_leaderboard"
        )
    return trials


def _name(file: Path, part: int) -> str:
    return _ALIASES.get(file.parts[part], file.parts[part])


def published_score(file: Path) -> float:
    """Return the score that a file of the leaderboard states."""
    try:
        score = float(next(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))["RealAI Score"])
    except (StopIteration, KeyError, TypeError, ValueError):
        score = math.nan
    if not math.isfinite(score):
        raise DataError(f"{file} has no finite number under RealAI Score; expected the published score")
    return score


def comparisons(data: Path, trials: Sequence[Trial]) -> list[Comparison]:
    """Return how each contest's simulation ranks the controllers that ran on both sides, by each of its criteria."""
    found = []
    for criterion in SIMULATED:
        for contest in CONTESTS:
            for robot in BENCHMARK_PLANTS:
                simulated = _simulated(data / "data" / robot, contest, robot, criterion)
                mine = [t for t in trials if (t.contest, t.robot) == (contest, robot) and t.controller in simulated]
                if mine:
                    found.append(_comparison(criterion, mine, simulated))
    return found


def _simulated(folder: Path, contest: Contest, robot: str, criterion: str) -> dict[str, float]:
    if not contest.simulation or (criterion == _NORMS and contest.version != "v2"):
        return {}
    below = contest.simulation.replace("simulation", "robustness") if criterion == _ROBUSTNESS else contest.simulation
    files = {_name(file, -2): file for file in sorted((folder / below).glob(f"*/{SIMULATED[criterion]}"))}
    if criterion == _ROBUSTNESS:  # shares of the levels held, one for each kind of disturbance
        return {
            name: float(np.mean([float(held) for held in load_yaml(file).values()])) for name, file in files.items()
        }
    if criterion == _NORMS:
        return {name: score_of(contest, robot, file)[0] for name, file in files.items()}
    return {name: published_score(file) for name, file in files.items()}


def _comparison(criterion: str, trials: Sequence[Trial], simulated: dict[str, float]) -> Comparison:
    contest, robot = trials[0].contest, trials[0].robot
    contenders = []
    for i, name in enumerate(dict.fromkeys(one.controller for one in trials)):
        mine = [one for one in trials if one.controller == name]
        # Trials of one seed are compared as pairs; seed 0 is the simulation's.
        seeds = tuple(one.number + (0 if contest.paired else i * len(trials)) for one in mine)
        scores = np.array([[-one.score] for one in mine])
        contenders.append(Contender(name, np.array([[-simulated[name]]]), scores, 0, 0, (0,), seeds, emulated=False))
    ranking = rank(contenders, of_scores=True) if len(contenders) >= _LEAST else None
    return Comparison(contest, robot, criterion, ranking, {one.name: len(one.hw) for one in contenders})
