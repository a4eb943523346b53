"""Pooled results of several runs of a named experiment: equivalence over all noises, parameters over all hands."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from pendulum_bags.comparison import compare_folders
from pendulum_bags.distributions import mean_interval
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.identification.model import UNITS
from pendulum_bags.studies.study_file import Study, StudyRun
from pendulum_msgs_py.errors import DataError

__all__ = ["analyse", "print_table"]


def analyse(folder: Path, study: Study, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the pooled comparison of regulation experiments, or the parameters of all identification experiments."""
    done = {int(record["number"]) for record in records if record["status"] == "done"}
    runs = [(run, folder / "runs" / run.name / "run") for run in study.runs if run.number in done]
    if study.experiment == "thesis":
        alike = _alike(runs).items()
        return {"comparisons": [{"of": list(filter(None, of)), **compare_folders(at).to_json()} for of, at in alike]}
    rows = []
    for run, place in runs:
        path = place / "identified.json"
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            values = {name: _number(value) for name, value in found["average"].items()}
            intervals = {name: [_number(end) for end in ends] for name, ends in found["intervals"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(f"{path} holds no identification: {error}") from error
        rows.append({"seed": run.labels["seed"], "values": values, "intervals": intervals})
    pooled = {name: _mean([row["values"][name] for row in rows]) for name in rows[0]["values"]} if rows else {}
    return {"identified": rows, "pooled": pooled}


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _alike(runs: Sequence[tuple[StudyRun, Path]]) -> dict[tuple[str, ...], list[Path]]:
    """Return the folders of runs that differ in their seed alone, each seed once."""
    groups: dict[tuple[str, ...], dict[Any, Path]] = {}
    for run, place in runs:
        kind = tuple(str(run.labels[axis]) for axis in ("plant", "controller", "disturbance"))
        groups.setdefault(kind, {}).setdefault(run.labels["seed"], place)
    return {kind: list(places.values()) for kind, places in groups.items()}


def print_table(console: Console, result: Mapping[str, Any]) -> None:
    """Print what :func:`analyse` found."""
    if "comparisons" in result:
        for content in result["comparisons"]:
            pooled = "1 run" if content["runs"] == 1 else f"{content['runs']} runs pooled"
            sources = ", ".join(content["of"])
            console.print(f"{sources}: {pooled}: {content['verdict']['sentence']}", markup=False, highlight=False)
        return
    names = (f"{name} \\[{UNITS.get(name, '')}]" for name in result["pooled"])
    table = number_table("Identified, 95 % interval over trials", "seed", *names, left=0)
    for row in result["identified"]:
        cells = [
            f"{row['values'][name]:.4g} ({row['intervals'][name][0]:.4g} to {row['intervals'][name][1]:.4g})"
            for name in result["pooled"]
        ]
        table.add_row(str(row["seed"]), *cells)
    if len(result["identified"]) > 1:
        pooled = result["pooled"].values()
        table.add_row("all", *(f"{one['mean']:.4g} ({one['low']:.4g} to {one['high']:.4g})" for one in pooled))
    console.print(table)


def _mean(values: Sequence[float]) -> dict[str, float | None]:
    mean, low, high = mean_interval(values)
    return {"mean": mean, "low": low, "high": high} if len(values) > 1 else {"mean": mean, "low": None, "high": None}
