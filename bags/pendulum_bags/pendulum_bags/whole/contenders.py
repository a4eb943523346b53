"""Controllers that a ranking compares: each differs from all others, and runs on every plant of the answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.ranking.collect import collect_contenders
from pendulum_bags.ranking.ranking import Ranking, rank
from pendulum_bags.runs.case import Case
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.results import run_metrics
from pendulum_bags.studies.study_file import load_study
from pendulum_msgs_py.errors import PendulumError

__all__ = ["contender_specs", "keep_run", "place_of", "rank_folders", "simulate_contenders"]

SEEDS = 3
"""Seeds of the noise under which each runs."""
_FIRST = ("lqr", "lqi", "pid", "sliding_mode", "lqr_q1_0.01_r1", "lqr_q10000_0.01_r0.1")
"""The thesis's LQR, laws of other kinds, and an LQR much softer and one much stiffer."""
_PROBE = 1.0
"""Length of the run that shows whether two controllers differ [s]."""


def contender_specs(sim: RunSpec, hw: RunSpec, count: int, seed: int) -> dict[str, list[tuple[RunSpec, RunSpec]]]:
    """Return the runs of each contender on both sides, under each seed of the noise.

    Of controllers that command the same, the first alone contends: it would count twice in a correlation. One that
    refuses the plant does not contend.

    Args:
        sim: The simulation under any controller and disturbance.
        hw: The hardware likewise.
        count: Number of contenders, fewer where fewer differ.
        seed: First seed.
    """
    runs = load_study("ranking", seeds=[seed]).runs
    named = {str(run.labels["controller"]): run.spec for run in runs if run.spec is not None}
    found: dict[str, list[tuple[RunSpec, RunSpec]]] = {}
    seen: list[Any] = []
    for name in dict.fromkeys((*_FIRST, *named)):
        if len(found) == count:
            break
        spec = named[name]
        law: dict[str, Any] = {"controller": spec.controller, "controller_parameters": spec.controller_parameters}
        noise: dict[str, Any] = {"disturbance": spec.disturbance, "duration": spec.duration}
        own, theirs = (replace(one, **law, **noise) for one in (sim, hw))
        try:
            commands = simulate(replace(own, duration=_PROBE, seed=seed)).command
        except PendulumError:  # a law that the plant is none for, such as one for rigid plants alone
            continue
        if any(np.allclose(commands, others, rtol=1e-6, atol=1e-9, equal_nan=True) for others in seen):
            continue
        seen.append(commands)
        seeds = range(seed, seed + SEEDS)
        found[name] = [(replace(own, seed=number), replace(theirs, seed=number)) for number in seeds]
    return found


def place_of(folder: Path, name: str, spec: RunSpec) -> Path:
    """Return the folder of one run of a ranking."""
    return folder / f"{name}_seed{spec.seed}" / spec.side


def keep_run(place: Path, name: str, spec: RunSpec, failure: str = "") -> None:
    """Store what a run of a ranking is, and its metrics, as a study does; its bag or arrays are in the folder.

    Args:
        place: Folder of the run.
        name: Of its controller.
        spec: The run.
        failure: Why the plant stopped; empty where it did not.
    """
    write_json(place / "spec.json", spec.to_json())
    record: dict[str, Any] = {"labels": {"controller": name}, "status": "failed" if failure else "done"}
    record |= {"reason": failure} if failure else {"metrics": run_metrics(place, spec)}
    write_json(place / "run.json", record)


def simulate_contenders(folder: Path, specs: Mapping[str, Sequence[RunSpec]]) -> None:
    """Simulate every run in this process, and store it."""
    for name, runs in specs.items():
        for spec in runs:
            place = place_of(folder, name, spec)
            place.mkdir(parents=True)
            np.savez(place / "run.npz", **vars(simulate(spec)))
            keep_run(place, name, spec)


def rank_folders(sim: Path, hw: Path) -> tuple[Ranking, Case]:
    """Return the ranking of the contenders with simulated runs in one folder and the machine's in another.

    Raises:
        DataError: They do not make a ranking.
    """
    contenders, case = collect_contenders([*sim.glob("*/sim"), *hw.glob("*/hw")])
    return rank(contenders), case
