"""Where the data of a report come from, and everything that is needed to make them again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.tables import typeset
from pendulum_bags.runs.run_record import record_named, run_record
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, PlantParameters

__all__ = ["citation", "provenance_table", "settings_table"]

_AUTHORS = "Pendulum maintainers"
_TITLE = "Pendulum: is your simulation good enough to design a controller on?"


def provenance_table(data: ReportData) -> Table:
    """Return where the data come from: bags, seed, strategy, versions, settings."""
    summary, run = data.summary, data.run
    revision = str(run.get("git_revision") or summary.get("git_revision") or "unknown")
    rows: list[tuple[str, str]] = [
        ("seed", str(summary.get("seed", "unknown"))),
        ("effort strategy", str(summary.get("strategy", "unknown"))),
        ("revision", revision),
        *_occasion(data),
    ]
    for pair in data.comparison.pairs:
        for one in (pair.simulation, pair.hardware):
            name = run_record(one.metadata).get("plant", "unknown")
            rows.append((f"bag of the {one.label}", f"{_short_path(one.source)} (plant {name})"))
            rows += [(f"damage of the {one.label}'s bag", text) for text in one.damage]
    for run_data in data.comparison.own:
        if all(run_data is not pair.simulation for pair in data.comparison.pairs):
            rows.append((f"bag of the {run_data.label}", _short_path(run_data.source)))
    for key in ("controller", "disturbance"):
        if key in run:
            rows.append((key, json.dumps(run[key])))
    if data.plant is not None:
        rows.append(("plant of the design", _plant_in_words(data.plant)))
    versions = summary.get("versions") or run.get("versions") or {}
    began = _began(data)
    year = f"{began:%Y}" if began else "n.d."
    rows.append(("cite as", citation(str(versions.get("pendulum_bags", "")), revision, year)))
    rows += [(f"version of {name}", str(version)) for name, version in versions.items()]
    return Table(
        "Provenance",
        "Everything that is needed to make these figures again: seeds, parameters, versions and the git revision of "
        "the run (+changes: edits were not committed).",
        ("what", "value"),
        rows,
        "Provenance",
    )


def _occasion(data: ReportData) -> list[tuple[str, str]]:
    """Return when, on which computers and by which command the first run was recorded, as far as its bags say."""
    pair = data.comparison.pairs[0]
    tellers = [record_named(one.metadata, "pendulum.recorder") for one in (pair.simulation, pair.hardware)]
    rows = []
    if when := _began(data):
        rows.append(("recorded", f"{when:%Y-%m-%d %H:%M} UTC"))
    if "command" in data.run:
        rows.append(("command", str(data.run["command"])))
    computers = (
        " · ".join(str(teller[key]) for key in ("host", "system", "rmw") if key in teller) for teller in tellers
    )
    return [*rows, *(("computer", text) for text in dict.fromkeys(computers) if text)]


def _began(data: ReportData) -> datetime | None:
    pair = data.comparison.pairs[0]
    tellers = [record_named(one.metadata, "pendulum.recorder") for one in (pair.simulation, pair.hardware)]
    begun = [began for teller in tellers if isinstance(began := teller.get("started_ns"), int)]
    return datetime.fromtimestamp(min(begun) * 1e-9, timezone.utc) if begun else None


def settings_table(data: ReportData) -> Table | None:
    """Return the parameters of the nodes of the first run, or None where its bags do not have them."""
    pair = data.comparison.pairs[0]
    nodes: dict[str, Mapping[str, Any]] = {}
    for one in (pair.simulation, pair.hardware):
        nodes.update(record_named(one.metadata, "pendulum.parameters"))
    rows = [
        (node, "; ".join(f"{name} {_setting(value)}" for name, value in sorted(parameters.items())))
        for node, parameters in sorted(nodes.items())
        if isinstance(parameters, Mapping)
    ]
    if not rows:
        return None
    return Table(
        "Settings",
        "ROS parameters of the nodes while the run was recorded, in SI units.",
        ("node", "parameters"),
        rows,
        "Provenance",
    )


def _setting(value: Any) -> str:
    return repr(value) if isinstance(value, str) else json.dumps(value)


def citation(version: str, revision: str, year: str = "n.d.") -> str:
    """Return how to cite the software that made a report, in APA style, with what CITATION.cff says.

    Args:
        version: Of the software; empty where it is unknown.
        revision: Of its source code.
        year: In which the run was recorded.
    """
    told = f" (version {version})" if version else ""
    return f"{_AUTHORS} ({year}). {_TITLE}{told} [Computer software]. Git revision {revision}. No DOI is assigned."


def _plant_in_words(plant: PlantParameters) -> str:
    """Return the parameters of a plant that are not zero, with units."""
    told = [
        f"{spec.name} {quantity(float(value), '' if spec.unit == '-' else typeset(spec.unit), 5)}"
        for spec in PLANT_SPECS
        if (value := getattr(plant, spec.name)) != 0.0
    ]
    return f"{plant.name}: {', '.join(told)}"


def _short_path(path: str) -> str:
    """Return folder and bag: the rest of the path is nobody else's business."""
    return "/".join(Path(path).parts[-2:])
