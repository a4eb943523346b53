"""Controllers of a ranking: all different, and able to run on every plant of the answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.frequency_response.designs import lqr_name
from pendulum_bags.ranking.collect import collect_contenders
from pendulum_bags.ranking.ranking import Ranking, rank
from pendulum_bags.runs.case import Case
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.results import write_outcome
from pendulum_bags.studies.study_file import load_study
from pendulum_msgs_py.errors import PendulumError

__all__ = [
    "CONTENDERS",
    "LENGTH",
    "MOST",
    "contender_specs",
    "keep_run",
    "place_of",
    "rank_folders",
    "simulate_contenders",
]

CONTENDERS, MOST = 6, 32
"""Controllers that a ranking compares by default, and at most."""
SEEDS = 3
"""Seeds of the noise under which each runs."""
_FIRST = ("lqr", "lqi", "pid", "sliding_mode", "lqr_q1_0.01_r1", "lqr_q10000_0.01_r0.1")
"""The thesis's LQR, laws of other kinds, and an LQR much softer and one much stiffer."""
OWN_NOISE = 3_000_000
"""Added to the seeds of the simulation: it picks under other noise than that which judges its pick."""
_COSTS, _VELOCITIES, _POSITIONS = (1.0, 100.0, 10.0, 0.1, 1e3, 0.01), (1.0, 30.0), (1.0, 10.0, 0.1)
"""By what the weights of several joints' own LQR are multiplied: those of efforts, velocities and positions."""
LENGTH = 5.0
"""Longest noise under which controllers run [s]."""
_PROBE = 1.0
"""Length of the run that shows whether two controllers differ [s]."""


def _laws(spec: RunSpec) -> dict[str, dict[str, Any]]:
    """Return the changes of a run for each contender, by name."""
    if (mechanism := spec.mechanism) is None:
        runs = load_study("ranking", seeds=[spec.seed]).runs
        fields = ("controller", "controller_parameters", "disturbance", "duration")
        named = {
            str(run.labels["controller"]): {field: getattr(run.spec, field) for field in fields}
            for run in runs
            if run.spec is not None
        }
        return {name: named[name] for name in dict.fromkeys((*_FIRST, *named))}
    weights, cost = mechanism.weights
    half = len(weights) // 2
    noise = {"duration": min(spec.duration, LENGTH)}
    laws: dict[str, dict[str, Any]] = {}
    for stiff, quick, dear in product(_POSITIONS, _VELOCITIES, _COSTS):
        q = [*(stiff * one for one in weights[:half]), *(quick * one for one in weights[half:])]
        name = lqr_name(q, dear * cost)
        laws[name] = {"controller": "lqr", "controller_parameters": {"q": q, "r": dear * cost}, **noise}
        if len(laws) == 1:
            laws |= {kind: {"controller": kind, "controller_parameters": {}, **noise} for kind in ("lqi", "lqg")}
    return laws


def contender_specs(
    sim: RunSpec, hw: RunSpec, count: int, seed: int, seeds: int = SEEDS
) -> dict[str, list[tuple[RunSpec, RunSpec]]]:
    """Return the runs of at most ``count`` contenders on both sides, under each seed of the noise.

    Controllers that refuse the plant are left out, and those that command the same as an earlier one.
    """
    found: dict[str, list[tuple[RunSpec, RunSpec]]] = {}
    seen: list[Any] = []
    for name, law in _laws(replace(sim, seed=seed)).items():
        if len(found) == count:
            break
        try:
            own, theirs = (replace(one, **law) for one in (sim, hw))
            commands = simulate(replace(own, duration=_PROBE, seed=seed)).command
        except PendulumError:  # a law that the plant is none for, such as one for rigid plants alone
            continue
        if any(np.allclose(commands, others, rtol=1e-6, atol=1e-9, equal_nan=True) for others in seen):
            continue
        seen.append(commands)
        numbers = range(seed, seed + seeds)
        found[name] = [(replace(own, seed=OWN_NOISE + number), replace(theirs, seed=number)) for number in numbers]
    return found


def place_of(folder: Path, name: str, spec: RunSpec) -> Path:
    """Return the folder of one run of a ranking."""
    return folder / f"{name}_seed{spec.seed}" / spec.side


def keep_run(place: Path, name: str, spec: RunSpec, failure: str = "") -> None:
    """Store the record of a run of a ranking and its metrics; ``failure`` is why the plant stopped, or empty."""
    write_json(place / "spec.json", spec.to_json())
    write_outcome(place, spec, {"controller": name}, failure)


def simulate_contenders(
    folder: Path, specs: Mapping[str, Sequence[RunSpec]], before: Callable[[], None] = lambda: None
) -> None:
    """Simulate every run in this process, and store it."""
    for name, runs in specs.items():
        for spec in runs:
            before()
            place = place_of(folder, name, spec)
            place.mkdir(parents=True)
            np.savez(place / "run.npz", **vars(simulate(spec)))
            keep_run(place, name, spec)


def rank_folders(sim: Path, hw: Path) -> tuple[Ranking, Case]:
    """Return the ranking of simulated runs in one folder and the machine's in another, or raise a DataError."""
    contenders, case = collect_contenders([*sim.glob("*/sim"), *hw.glob("*/hw")])
    return rank(contenders), case
