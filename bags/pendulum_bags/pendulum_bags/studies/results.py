"""Results of a study's runs: metrics of each run, and means with intervals over seeds."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.metrics import METRICS, Episode, metrics_of
from pendulum_bags.distributions import mean_interval, share_interval
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.study_file import AXES, Study, StudyRun
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError, PendulumError
from pendulum_rosbag.reader import read_bag

__all__ = [
    "Group",
    "collect",
    "episode_of_run",
    "group_runs",
    "groups_to_json",
    "read_record",
    "run_metrics",
    "write_outcome",
    "write_table",
]

SUCCESS_ERROR = 0.1
"""Mean distance from the set-point over the last tenth below which a run has succeeded [rad]."""
SHARES = frozenset({"success"})
"""Metrics that are 1 or 0 in each run: their mean is a share, and more is better."""
_LEAST_STEP = 1e-6


@dataclass(frozen=True)
class Group:
    """All runs that differ in seed and repeat only.

    Attributes:
        values: Metric -> one value for each run; infinity where it did not happen.
    """

    labels: Mapping[str, Any]
    seeds: tuple[int, ...]
    values: Mapping[str, Array]
    failed: int

    def mean(self, metric: str) -> tuple[float, float, float]:
        """Return mean and 95 % interval over the runs: Student's t for numbers, Wilson for shares; or NaN."""
        values = self.values[metric]
        if metric in SHARES:
            low, high = share_interval(int(values.sum()), values.size)
            return float(values.mean()), low, high
        return mean_interval(values[np.isfinite(values)])

    def worst(self, metric: str) -> tuple[float, int]:
        """Return the largest absolute value over the runs (of a share, the smallest) and its seed, to replay it."""
        values = self.values[metric]
        if metric in SHARES:
            index = int(np.argmin(values))
            return float(values[index]), self.seeds[index]
        values = np.abs(values)
        index = int(np.nanargmax(values))
        return float(values[index]), self.seeds[index]


def episode_of_run(place: Path, spec: RunSpec) -> Episode:
    """Return motion and torque of a run from its folder's ``bag`` or ``run.npz``, or raise a DataError."""
    if (place / "run.npz").is_file():
        with np.load(place / "run.npz") as arrays:
            stamps, position, velocity = arrays["stamp_ns"], arrays["position"], arrays["velocity"]
            command = arrays["command"]
    else:
        with read_bag(place / "bag") as bag:
            states, commands = bag[f"{spec.namespace}/joint_states"], bag[f"{spec.namespace}/effort_command"]
        _, first = np.unique(states["stamp_ns"], return_index=True)
        states = states[first]
        stamps, position, velocity = states["stamp_ns"], states["position"], states["velocity"]
        _, at, where = np.intersect1d(stamps, commands["stamp_ns"], return_indices=True)
        command = np.full(stamps.size, np.nan)
        command[at] = commands["effort"][where]
    if stamps.size < 10:
        raise DataError(f"run {place} has {stamps.size} states; expected at least 10")
    error = np.unwrap(wrap(position - UPRIGHT - spec.set_point))
    error -= 2.0 * np.pi * np.round(error[-1] / (2.0 * np.pi))
    step = float(error[0]) if abs(error[0]) > _LEAST_STEP and _is_step(spec) else 0.0
    return Episode((stamps - stamps[0]) / NANOSECONDS, error, velocity, np.nan_to_num(command), step)


def write_outcome(place: Path, spec: RunSpec | None, labels: Mapping[str, Any], failure: str = "", **more: Any) -> str:
    """Store the outcome of a run as ``run.json`` in its folder; return the reason of a failure, also one of reading.

    Args:
        place: Folder of the run, with ``bag`` or ``run.npz``.
        spec: The run, of which metrics are stored where it has one joint, or None.
        failure: Reason of its failure, or empty.
    """
    record: dict[str, Any] = {**more, "labels": dict(labels)}
    if not failure and spec is not None and spec.mechanism is None:
        try:
            record["metrics"] = run_metrics(place, spec)
        except PendulumError as error:
            failure = f"recorded, but cannot be read: {error}"
    record.update(status="failed" if failure else "done", reason=failure)
    write_json(place / "run.json", record)
    return failure


def run_metrics(place: Path, spec: RunSpec) -> dict[str, float | None]:
    """Return every metric of a run, ``success`` among them; None stands for infinity."""
    episode = episode_of_run(place, spec)
    values: dict[str, float | None] = {
        name: value if math.isfinite(value) else None for name, value in metrics_of(episode).items()
    }
    tail = episode.error[-max(1, episode.error.size // 10) :]
    values["success"] = float(np.mean(np.abs(tail)) < SUCCESS_ERROR)
    return values


def read_record(folder: Path, run: StudyRun) -> dict[str, Any] | None:
    """Return the result of a run that has ended, well or not; None for one that has not."""
    path = folder / "runs" / run.name / "run.json"
    if not path.is_file():
        return None
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record


def collect(folder: Path, study: Study) -> list[dict[str, Any]]:
    """Return the records of all runs that have ended."""
    records = (read_record(folder, run) for run in study.runs)
    return [record for record in records if record is not None]


def group_runs(records: Sequence[Mapping[str, Any]]) -> list[Group]:
    """Return the runs grouped by all axes but seed and repeat, in the order of the file."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for record in records:
        groups.setdefault(tuple(record["labels"][axis] for axis in AXES), []).append(record)
    found = []
    for key, members in groups.items():
        done = [member for member in members if member["status"] == "done"]
        names = [metric.name for metric in METRICS] + ["success"]
        values = {
            name: np.array([math.inf if m["metrics"][name] is None else m["metrics"][name] for m in done])
            for name in names
            if done and all(name in m.get("metrics", {}) for m in done)
        }
        seeds = tuple(int(member["labels"]["seed"]) for member in done)
        found.append(Group(dict(zip(AXES, key, strict=True)), seeds, values, len(members) - len(done)))
    return found


def groups_to_json(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Return the groups as JSON: labels, and mean, interval, worst case and its seed for each metric."""
    rows = []
    for group in groups:
        metrics = {}
        for name in group.values:
            mean, low, high = group.mean(name)
            worst, seed = group.worst(name)
            numbers = {"mean": mean, "low": low, "high": high, "worst": worst}
            metrics[name] = {
                **{key: value if math.isfinite(value) else None for key, value in numbers.items()},
                "worst_seed": seed,
                "never": int(np.sum(~np.isfinite(group.values[name]))),
            }
        rows.append({**group.labels, "runs": len(group.seeds), "failed": group.failed, "metrics": metrics})
    return rows


def write_table(path: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Write one CSV row for each run: labels, status, metrics."""
    names = sorted({name for record in records for name in record.get("metrics", {})})
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        axes = (*AXES, "seed", "repeat")
        writer.writerow(["number", *axes, "status", "reason", "wall_s", *names])
        for record in records:
            metrics = record.get("metrics", {})
            row = [record["number"], *(record["labels"][axis] for axis in axes)]
            row += [record["status"], record["reason"], record["wall_s"]]
            writer.writerow([*row, *("" if metrics.get(name) is None else metrics[name] for name in names)])


def _is_step(spec: RunSpec) -> bool:
    return abs(wrap(spec.theta - UPRIGHT - spec.set_point)) > _LEAST_STEP
