"""Costs of controllers from folders of runs: studies, or any bags that say which controller ran on which side."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.comparison.metrics import episode_of, metrics_of
from pendulum_bags.ranking.ranking import Contender, contenders_of
from pendulum_bags.runs.run_data import is_emulated, read_run
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.errors import DataError, PendulumError

__all__ = ["WEIGHTS", "collect_contenders", "cost_parts"]

Array = NDArray[np.float64]

WEIGHTS = (100.0, 0.01, 0.1)
"""q11 [1/rad^2], q22 [s^2/rad^2] and r [1/(N m)^2] of the thesis's choice: the cost that its LQR minimises."""
_FALLEN = 0.5
"""Largest angle from the set-point at which a run still counts as a success [rad]."""


def cost_parts(metrics: Mapping[str, float | None], duration: float, weights: Sequence[float] = WEIGHTS) -> Array:
    """Return the parts of the mean cost of a run, shape (3,).

    Args:
        metrics: Of :mod:`pendulum_bags.comparison.metrics`: ``ise``, ``rms_velocity`` and ``effort_energy``.
        duration: Length of the run [s].
        weights: q11, q22 and r.
    """
    ise, velocity, energy = (metrics[name] for name in ("ise", "rms_velocity", "effort_energy"))
    if ise is None or velocity is None or energy is None:
        raise DataError("a run has no finite cost")
    return np.array([weights[0] * ise / duration, weights[1] * velocity**2, weights[2] * energy / duration])


def collect_contenders(folders: Sequence[Path], weights: Sequence[float] = WEIGHTS) -> list[Contender]:
    """Return the controllers that ran on both sides, from all runs below some folders.

    Args:
        folders: Studies, run folders, or folders of bags.
        weights: q11, q22 and r of the cost.

    Raises:
        DataError: There are no runs.
    """
    costs: dict[str, dict[str, list[tuple[int, Array | None]]]] = {}
    real: set[str] = set()
    count = 0
    for folder in folders:
        if not folder.is_dir():
            raise DataError(f"{folder} is no folder; expected one with runs")
        for name, side, seed, parts, emulated in _runs(folder, weights):
            if not emulated:
                real.add(name)
            costs.setdefault(name, {"sim": [], "hw": []})[side].append((seed, parts))
            count += 1
    if not count:
        told = ", ".join(map(str, folders))
        raise DataError(f"{told} holds no runs; expected a study, or bags that say which controller ran on which side")
    return contenders_of(costs, real)


def _runs(folder: Path, weights: Sequence[float]) -> Iterator[tuple[str, str, int, Array | None, bool]]:
    studied: set[Path] = set()
    for record in sorted(folder.rglob("run.json")):
        specification = record.with_name("spec.json")
        if not specification.is_file():
            continue
        studied.add(record.parent.resolve())
        told, spec = (json.loads(path.read_text(encoding="utf-8")) for path in (record, specification))
        parts = None
        if told.get("status") == "done" and told.get("metrics", {}).get("success"):
            parts = cost_parts(told["metrics"], float(spec["duration"]), weights)
        yield str(told["labels"]["controller"]), str(spec["side"]), int(spec["seed"]), parts, True
    for metadata in sorted(folder.rglob("metadata.yaml")):
        bag = metadata.parent
        if not any(parent in studied for parent in bag.resolve().parents):
            yield from _bag(bag, weights)


def _bag(bag: Path, weights: Sequence[float]) -> Iterator[tuple[str, str, int, Array | None, bool]]:
    try:
        run = read_run(bag)
    except PendulumError:
        # A folder may hold recordings of other things.
        return
    told = run_record(run.metadata)
    if not isinstance(told.get("controller"), Mapping):
        return
    side = str(told.get("side") or str(told.get("namespace", "")).strip("/"))
    if side not in {"sim", "hw"}:
        return
    episode = episode_of(run.window)
    fallen = bool(np.max(np.abs(episode.error)) > _FALLEN)
    parts = None if fallen else cost_parts(metrics_of(episode), float(episode.t[-1]), weights)
    yield _name(told["controller"]), side, int(told.get("seed") or 0), parts, side == "sim" or is_emulated(run)


def _name(controller: Mapping[str, Any]) -> str:
    given = ", ".join(f"{key}={_short(value)}" for key, value in controller.items() if key != "kind")
    return f"{controller.get('kind', 'controller')}" + (f" ({given})" if given else "")


def _short(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "/".join(map(_short, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
