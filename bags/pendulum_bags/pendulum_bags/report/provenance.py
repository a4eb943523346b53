"""Where the data of a report come from, and everything that is needed to make them again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from pendulum_bags.comparison.pairs import Pair
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.tables import parameter_rows, typeset
from pendulum_bags.runs.run_data import OpenBag, RunData, is_emulated
from pendulum_bags.runs.run_folder import REPEATS
from pendulum_bags.runs.run_record import record_named, run_record
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.plants.joint_parameters import DRIVETRAIN_SPECS
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, read_plants
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, PlantParameters

__all__ = ["citation", "emulator_table", "provenance_table", "seed_of", "settings_table"]

_AUTHORS = "Pendulum maintainers"
_TITLE = "Pendulum: is your simulation good enough to design a controller on?"


def provenance_table(data: ReportData) -> Table:
    """Return where the data come from: bags, seed, strategy, versions, settings."""
    summary, run = data.summary, data.run
    revision = str(run.get("git_revision") or summary.get("git_revision") or "unknown")
    rows: list[tuple[str, str]] = [
        *([("seed", str(summary.get("seed", "unknown")))] if len(data.comparison.pairs) == 1 else []),
        ("effort strategy", str(summary.get("strategy", "unknown"))),
        ("revision", revision),
        *_occasion(data),
    ]
    if data.comparison.of_files:
        rows = [row for row in rows if row[1] not in {"unknown", "None"}]
    rows += _runs(data.comparison.pairs)
    for run_data in data.comparison.own:
        if all(run_data is not pair.simulation for pair in data.comparison.pairs):
            rows.append((f"bag of the {run_data.label}", f"{_short_path(run_data.source)} (seed {seed_of(run_data)})"))
    for key in ("controller", "disturbance"):
        if key in run:
            rows.append((key, json.dumps(run[key])))
    if data.plant is not None:
        rows.append(("plant of the design", _plant_in_words(data.plant)))
    versions = summary.get("versions") or run.get("versions") or {}
    began = _began(data)
    year = f"{began:%Y}" if began else "n.d."
    rows.append(("cite as", citation(str(versions.get("pendulum_bags", "")), revision, year)))
    if versions:
        rows.append(("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return Table(
        "Provenance",
        "Everything that is needed to make these figures again: bags, seeds, parameters, versions and the git revision "
        "of every run (+changes: edits were not committed).",
        ("what", "value"),
        rows,
        "Provenance",
    )


def _runs(pairs: Sequence[Pair]) -> list[tuple[str, str]]:
    """Return the bags of every run; for several also seed, command, revision and versions."""
    rows = []
    commands = {"", str(run_record(pairs[0].simulation.metadata).get("command", ""))}
    for number, pair in enumerate(pairs, start=1):
        of = f"run {number}, " if len(pairs) > 1 else ""
        sides = (pair.simulation, pair.hardware)
        if of:
            rows.append((f"{of}seed", " and ".join(dict.fromkeys(seed_of(one) for one in sides))))
        for one in sides:
            name = run_record(one.metadata).get("plant", "unknown")
            plant = "" if one.of_file else f" (plant {name})"
            what = "recording" if one.of_file else "bag"
            rows.append((f"{of}{what} of the {one.label}", f"{_short_path(one.source)}{plant}"))
            rows += [(f"{of}damage of the {one.label}'s {what}", text) for text in one.damage]
        if of:
            found = [str(run_record(one.metadata).get("command", "")) for one in sides]
            rows += [(f"{of}command", command) for command in dict.fromkeys(found) if command not in commands]
            commands.update(found)
            made = _made_with(pair)
            first = number > 1 and made == _made_with(pairs[0])
            rows.append((f"{of}revision and versions", "as run 1" if first else made))
    return rows


def _made_with(pair: Pair) -> str:
    by_label = {}
    for one in (pair.simulation, pair.hardware):
        record = run_record(one.metadata)
        versions = record.get("versions")
        software = [("git", record.get("git_revision", "unknown"))]
        software += versions.items() if isinstance(versions, Mapping) else ()
        by_label[one.label] = ", ".join(f"{name} {version}" for name, version in software)
    texts = set(by_label.values())
    return texts.pop() if len(texts) == 1 else "; ".join(f"{label}: {text}" for label, text in by_label.items())


def seed_of(run: RunData) -> str:
    """Return the seed of a run's bag."""
    return str(run_record(run.metadata).get("seed", "unknown"))


def _occasion(data: ReportData) -> list[tuple[str, str]]:
    """Return date, computers and command of the first run, as far as recorded."""
    rows = []
    if when := _began(data):
        rows.append(("recorded", f"{when:%Y-%m-%d %H:%M} UTC"))
    if "command" in data.run:
        rows.append(("command", str(data.run["command"])))
    computers = (
        " · ".join(str(facts[key]) for key in ("host", "system", "rmw") if key in facts) for facts in _recorders(data)
    )
    return [*rows, *(("computer", text) for text in dict.fromkeys(computers) if text)]


def _recorders(data: ReportData) -> list[Mapping[str, Any]]:
    pair = data.comparison.pairs[0]
    return [record_named(one.metadata, "pendulum.recorder") for one in (pair.simulation, pair.hardware)]


def _began(data: ReportData) -> datetime | None:
    begun = [began for facts in _recorders(data) if isinstance(began := facts.get("started_ns"), int)]
    return datetime.fromtimestamp(min(begun) * 1e-9, timezone.utc) if begun else None


def emulator_table(data: ReportData) -> Table | None:
    """Return the constants of the emulator of the first run; None where none was used, or its bag lacks them."""
    hardware = data.comparison.pairs[0].hardware
    plant = _emulated_plant(hardware, data.open_bag) if is_emulated(hardware) else None
    if plant is None:
        return None
    rows = [*parameter_rows(PLANT_SPECS, plant), *parameter_rows(DRIVETRAIN_SPECS, plant.drivetrain)]
    return Table(
        "Constants of the emulator",
        f"No machine was measured: these constants ({plant.name}) took the place of one, those of the link first, then "
        "those of motor, gears and spring. Noise, steps and timing of the feedback are those of the named version of "
        "pendulum_hw_bridge.",
        ("constant", "value", "unit", "meaning"),
        rows,
        "Provenance",
        folded=True,
    )


def _emulated_plant(run: RunData, open_bag: OpenBag) -> PlantParameters | None:
    space = str(run_record(run.metadata).get("namespace", "")).rstrip("/") + "/"
    try:
        with open_bag(run.source) as bag:
            messages = bag.messages(names.DIAGNOSTICS) if names.DIAGNOSTICS in bag.topics else []
        texts = (
            pair.value
            for stored in messages
            for status in stored.message.status
            for pair in status.values
            if status.name.startswith(space) and pair.key == PLANT_PARAMETERS
        )
        plants = read_plants(next(texts, "[]"))
    except (BagError, DataError, ParameterError):
        return None
    return next((plant for plant in plants if plant.drivetrain), None)


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
        folded=True,
    )


def _setting(value: Any) -> str:
    return repr(value) if isinstance(value, str) else json.dumps(value)


def citation(version: str, revision: str, year: str = "n.d.") -> str:
    """Return how to cite the software that made a report, in APA style, by CITATION.cff; ``version`` may be empty."""
    release = f" (version {version})" if version else ""
    return f"{_AUTHORS} ({year}). {_TITLE}{release} [Computer software]. Git revision {revision}. No DOI is assigned."


def _plant_in_words(plant: PlantParameters) -> str:
    constants = [
        f"{spec.name} {quantity(float(value), '' if spec.unit == '-' else typeset(spec.unit), 5)}"
        for spec in PLANT_SPECS
        if (value := getattr(plant, spec.name)) != 0.0
    ]
    return f"{plant.name}: {', '.join(constants)}"


def _short_path(path: str) -> str:
    """Return run folder and bag, with the repeat between them: the rest of the path is private."""
    parts = Path(path).parts
    return "/".join(parts[-4:] if parts[-3:-2] == (REPEATS,) else parts[-2:])
