"""The benchmark's jobs, one process each, and the rows that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pendulum_bags.studies.benchmark_controllers import make_contender
from pendulum_bags.studies.mechanism_benchmark import benchmark_plant
from pendulum_bags.studies.mechanism_benchmark_runs import (
    DT,
    Stepper,
    Trajectory,
    Trial,
    knock_downs,
    make_stepper,
    robustness_of,
    robustness_trials,
    swing_up,
    try_once,
)
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Bench", "Job", "Row", "document", "prepare", "run_job", "score_rows"]
Job = tuple[str, str, int]
"""What is run (swing_up, uptime or trial), by which controller, with which seed or as which trial."""


@dataclass(frozen=True)
class Row:
    """Results of a controller: scores v2 and v3 (one for each seed), and the shares of its tests of robustness."""

    controller: str
    score: float
    criteria: dict[str, float]
    shares: dict[str, float]
    uptimes: tuple[float, ...]
    run: Trajectory

    @property
    def robustness(self) -> float | None:
        """Overall robustness v2; None if it was not tested."""
        return float(np.mean(list(self.shares.values()))) if self.shares else None

    @property
    def uptime_text(self) -> str:
        """Mean of score v3 with its standard deviation over the seeds."""
        if not self.uptimes:
            return "–"
        spread = f" ± {np.std(self.uptimes):.3f}" if len(self.uptimes) > 1 else ""
        return f"{np.mean(self.uptimes):.3f}{spread}"


@dataclass(frozen=True)
class Bench:
    """What all jobs of a benchmark share."""

    plant: str
    names: tuple[str, ...]
    seed: int
    compiled: bool


@dataclass(frozen=True)
class _Prepared:
    plant: PlantParameters
    stepper: Stepper
    controllers: dict[str, Controller]
    trials: list[Trial]


@cache
def prepare(bench: Bench) -> _Prepared:
    """Design the controllers and compile the simulation, once in a process."""
    model = benchmark_plant(bench.plant)
    controllers = {name: make_contender(name, model, DT) for name in bench.names}
    stepper = make_stepper(model, compiled=bench.compiled)
    return _Prepared(model, stepper, controllers, robustness_trials(model, bench.seed))


def run_job(bench: Bench, job: Job) -> Any:
    """Run one job and return its result."""
    ready = prepare(bench)
    kind, name, number = job
    controller = ready.controllers[name]
    if kind == "swing_up":
        return swing_up(ready.plant, ready.stepper, controller)
    if kind == "uptime":
        return knock_downs(ready.plant, ready.stepper, controller, number)[1]
    return try_once(ready.plant, ready.stepper, controller, ready.trials[number])


def score_rows(names: Sequence[str], jobs: Sequence[Job], results: Sequence[Any], trials: Sequence[Trial]) -> list[Row]:
    """Return a row for each controller."""
    rows = []
    for name in names:
        mine = [(kind, result) for (kind, owner, _), result in zip(jobs, results, strict=True) if owner == name]
        run, criteria, score = next(result for kind, result in mine if kind == "swing_up")
        uptimes = tuple(result for kind, result in mine if kind == "uptime")
        shares = robustness_of(trials, [result for kind, result in mine if kind == "trial"]) if trials else {}
        rows.append(Row(name, score, criteria, shares, uptimes, run))
    return rows


def document(plant: str, seed: int, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the results as JSON would have them, the published rows among them."""
    from pendulum_bags.studies.mechanism_benchmark import PUBLISHED

    return {
        "plant": plant,
        "seed": seed,
        "rows": [
            {
                "controller": row.controller,
                "score_v2": row.score,
                "criteria": row.criteria,
                "robustness_v2": row.robustness,
                "robustness_shares": row.shares,
                "score_v3": float(np.mean(row.uptimes)) if row.uptimes else None,
                "score_v3_runs": list(row.uptimes),
            }
            for row in rows
        ],
        "published": [
            {
                "method": row.method,
                "score_v2": row.score,
                "robustness_v2": row.robustness,
                "score_v3": row.uptime_score,
            }
            for row in PUBLISHED
            if row.plant == plant
        ],
    }
