"""Costs of controllers from runs: studies, bags that name their controller and side, and trials of any format."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.metrics import episode_of, metrics_of
from pendulum_bags.experiments.run_spec import SIDES, RunSpec
from pendulum_bags.ranking.contender import Contender, contenders_of
from pendulum_bags.ranking.joint_choice import joint_cost_parts
from pendulum_bags.ranking.trials import Trial, joint_parts, names_its_run, run_of
from pendulum_bags.runs.case import IDENTITY, Case
from pendulum_bags.runs.find_bags import bags_below
from pendulum_bags.runs.run_data import RunData, is_emulated, joints_of, read_run
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.errors import DataError, ParameterError, PendulumError
from pendulum_rosbag.reader import read_bag

__all__ = ["WEIGHTS", "collect_contenders", "cost_parts"]

WEIGHTS = (100.0, 0.01, 0.1)
"""q11 [1/rad^2], q22 [s^2/rad^2] and r [1/(N m)^2] of the thesis's choice: the cost that its LQR minimises."""
_NAMED = 5
_FALLEN = 0.5
"""Largest angle from the set-point at which a run still counts as a success [rad]."""


def cost_parts(metrics: Mapping[str, float | None], duration: float, weights: Sequence[float] = WEIGHTS) -> Array:
    """Return the parts of the mean cost of a run of a duration [s], shape (3,), by weights q11, q22 and r.

    ``metrics`` has ``ise``, ``rms_velocity`` and ``effort_energy``. A DataError if a part is no finite number.
    """
    ise, velocity, energy = (metrics[name] for name in ("ise", "rms_velocity", "effort_energy"))
    if ise is None or velocity is None or energy is None:
        raise DataError("a run has no finite cost")
    parts = np.array([weights[0] * ise / duration, weights[1] * velocity**2, weights[2] * energy / duration])
    if not np.all(np.isfinite(parts)):
        raise DataError("a run has no finite cost")
    return parts


def collect_contenders(
    folders: Sequence[Path],
    weights: Sequence[float] = WEIGHTS,
    trials: Sequence[Trial] = (),
    *,
    plant: str = "",
) -> tuple[list[Contender], Case]:
    """Return the controllers that ran on both sides, from all runs below some folders, and the plants that ran.

    Args:
        folders: Studies, run folders, or folders of bags.
        weights: q11, q22 and r of the cost.
        trials: Further runs.
        plant: Whose LQR weighs recordings of several joints.

    Raises:
        DataError: There are no runs, those of one side are of two plants, or a recording that may be one is damaged:
            it may be the run that fell; or costs of several kinds are mixed.
        ParameterError: A weight is negative or no number.
    """
    if not all(math.isfinite(weight) and weight >= 0.0 for weight in weights):
        raise ParameterError(f"weights are {', '.join(f'{weight:g}' for weight in weights)}; expected finite ones >= 0")
    runs: list[_Run] = []
    unread: list[str] = []
    for folder in folders:
        if not folder.is_dir():
            raise DataError(f"{folder} is no folder; expected one with runs")
        _collect(folder, weights, runs, unread)
    for number, trial in enumerate(trials):
        try:
            # Under a seed that no other has: runs of one seed share their disturbance.
            runs.append(_trial_run(trial, weights, plant, -1 - number if trial.seed is None else trial.seed))
        except PendulumError as error:
            unread.append(str(error))
    if unread:
        more = f"; and {len(unread) - _NAMED} more" if len(unread) > _NAMED else ""
        raise DataError(
            f"{len(unread)} of {len(runs) + len(unread)} recordings cannot be ranked, and a run that is left out may "
            f"be one that fell: {'; '.join(unread[:_NAMED])}{more}. Repair them"
            + " (python -m pendulum_rosbag repair BAG)" * any(" bag " in one or "states" in one for one in unread)
            + ", or leave them out of folder and table"
        )
    if not runs:
        where = ", ".join(map(str, folders))
        raise DataError(
            f"{where} holds no runs; expected a study, bags that say which controller ran on which side, "
            "recordings as FOLDER/simulation/CONTROLLER/FILE and FOLDER/hardware/CONTROLLER/FILE, or a table of trials"
        )
    if len(kinds := {trial.kind for trial in trials} | {"file" for _ in runs[len(trials) :]}) > 1:
        raise DataError(f"the trials have {' and '.join(sorted(kinds))}; expected one kind of them")
    costs: dict[str, dict[str, list[tuple[int, Array | None]]]] = {}
    for run in runs:
        costs.setdefault(run.name, {"sim": [], "hw": []})[run.side].append((run.seed, run.parts))
    alone = [name for name in {trial.controller for trial in trials} if not all(costs[name].values())]
    if alone:
        ran = [f"{name} on {'hardware' if costs[name]['hw'] else 'simulation'}" for name in sorted(alone)]
        raise DataError(
            f"{', '.join(ran)} alone: a controller that is left out may be the one that the simulation picks; "
            "expected runs of each on both sides, under one name, or none"
        )
    case = Case.of(*([{IDENTITY: run.identity} for run in runs if run.side == side] for side in SIDES))
    return contenders_of(costs, {run.name for run in runs if not run.emulated}), case


class _Run(NamedTuple):
    """One run: parts of its cost, or None where it failed, and the identity of its plant."""

    name: str
    side: str
    seed: int
    parts: Array | None
    emulated: bool
    identity: str


def _collect(folder: Path, weights: Sequence[float], runs: list[_Run], unread: list[str]) -> None:
    """Append the runs below a folder, and a sentence for each recording that may be one and cannot be read."""
    studied: set[Path] = set()
    for record in sorted(folder.rglob("run.json")):
        if not record.with_name("spec.json").is_file():
            continue
        studied.add(record.parent.resolve())
        try:
            runs.append(_studied_run(record, weights))
        except (PendulumError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            unread.append(f"{record} ({_why(error)})")
    for bag in bags_below(folder):
        # The whole messages of BAG.broken, which repair leaves, are in BAG.
        repaired = ".broken" in bag.name and bag.with_name(bag.name.split(".broken")[0]).exists()
        if repaired or any(parent in studied for parent in (bag.resolve(), *bag.resolve().parents)):
            continue
        try:
            found = _recorded_run(bag, weights)
        except PendulumError as error:
            unread.append(_why(error) if str(bag) in str(error) else f"{bag} ({_why(error)})")
        else:
            runs += [] if found is None else [found]


def _trial_run(trial: Trial, weights: Sequence[float], plant: str, seed: int) -> _Run:
    if trial.reading is None:
        parts = None if trial.cost is None else np.array([trial.cost])
    elif joints := joints_of(trial.reading):
        parts = joint_parts(trial.reading, joints, plant)
    else:
        parts = _upright_parts(run_of(trial, needs_input=weights[2] > 0.0), weights, str(trial.reading))
    if trial.reading is not None:
        trial.reading.forget()
    return _Run(trial.controller, trial.side, seed, parts, trial.side == "sim", "")


def _why(error: Exception) -> str:
    return str(error) if isinstance(error, (PendulumError, OSError)) else f"{type(error).__name__}: {error}"


def _studied_run(record: Path, weights: Sequence[float]) -> _Run:
    result, spec = (json.loads(path.read_text(encoding="utf-8")) for path in (record, record.with_name("spec.json")))
    name, run = str(result["labels"]["controller"]), RunSpec.from_json(spec)
    parts = None
    if result.get("status") == "done" and run.mechanism is not None:
        parts = joint_cost_parts(record.parent, run)
    elif result.get("status") == "done" and result.get("metrics", {}).get("success"):
        parts = _parts(result["metrics"], run.duration, weights, f"{name} on {run.side} under seed {run.seed}")
    return _Run(name, run.side, run.seed, parts, True, run.identity)


def _parts(metrics: Mapping[str, float | None], duration: float, weights: Sequence[float], who: str) -> Array:
    try:
        return cost_parts(metrics, duration, weights)
    except DataError as error:
        raise DataError(
            f"the cost of {who} is no finite number; expected finite angles, velocities and torques"
        ) from error


def _recorded_run(bag: Path, weights: Sequence[float]) -> _Run | None:
    """Return the run that a bag holds, None for a sound one that names no controller and side.

    A BagError or a DataError if it cannot be read, is damaged, or its run is not whole.
    """
    with read_bag(bag) as opened:
        facts, damage = run_record(opened.metadata), list(opened.damage)
    if damage:
        # What is lost may be the record of the run, or the moment in which it fell.
        raise DataError(f"bag {bag} is damaged: {', '.join(damage)}")
    side = names_its_run(facts)
    if not side:
        return None
    run = read_run(bag)
    name, seed = _name(facts), int(facts.get("seed") or 0)
    parts = _upright_parts(run, weights, f"{name} on {side} under seed {seed}")
    return _Run(name, side, seed, parts, side == "sim" or is_emulated(run), str(facts.get(IDENTITY, "")))


def _upright_parts(run: RunData, weights: Sequence[float], who: str) -> Array | None:
    """Return the parts of the cost of a run that is to stay upright, shape (3,); None where it fell."""
    episode = episode_of(run.window)
    # (no comparison with a number is true of NaN)
    if np.max(np.abs(episode.error)) > _FALLEN:
        return None
    return _parts(metrics_of(episode), float(episode.t[-1]), weights, who)


def _name(facts: Mapping[str, Any]) -> str:
    """Return the name of a run's controller; two policies of one file name are two."""
    controller = facts["controller"]
    digest, file = facts.get("policy_sha256"), controller.get("policy")
    if isinstance(digest, str) and isinstance(file, str):
        rest = {key: value for key, value in controller.items() if key not in {"kind", "policy"}}
        controller = {"kind": f"policy {Path(file).stem}", "file": digest[:8], **rest}
    given = ", ".join(f"{key}={_short(value)}" for key, value in controller.items() if key != "kind")
    return f"{controller.get('kind', 'controller')}" + (f" ({given})" if given else "")


def _short(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "/".join(map(_short, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
