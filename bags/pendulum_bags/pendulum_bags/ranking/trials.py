"""Trials of controllers: recordings of any format, or scores, named by a folder, an option or a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.identification.joint_recordings import matched_joints
from pendulum_bags.ranking.joint_choice import cost_of_motion
from pendulum_bags.recordings.reading import FOUND, Reading
from pendulum_bags.runs.find_bags import bags_below
from pendulum_bags.runs.run_data import RunData, read_run
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import BagError, DataError
from pendulum_msgs_py.parameters import load_yaml
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_rosbag.reader import read_bag

__all__ = [
    "TABLES",
    "Trial",
    "joint_parts",
    "names_its_run",
    "run_of",
    "side_and_controller",
    "table_rows",
    "trial_rows",
    "trials_below",
    "trials_of",
]

TABLES = (".csv", ".tsv", ".yaml", ".yml")
"""Files that are tables of trials."""
_SIDES = {"sim": "sim", "simulation": "sim", "hw": "hw", "hardware": "hw", "machine": "hw"}
_COLUMNS = {"controller", "side", "seed", "file", "cost", "score"}
_HANGING = 0.5


@dataclass(frozen=True)
class Trial:
    """One run of one controller on one side.

    Attributes:
        controller: Its name.
        side: ``sim`` or ``hw``.
        reading: Its recording; None where a number is given.
        cost: What it cost, of a score its negative; None where it is computed, or the run failed.
        seed: Of its disturbance; None where that is its own.
        is_score: Whether the number is a score, of which more is better.
    """

    controller: str
    side: str
    reading: Reading | None = None
    cost: float | None = None
    seed: int | None = None
    is_score: bool = False

    @property
    def kind(self) -> str:
        """``file``, ``cost`` or ``score``."""
        return "file" if self.reading else "score" if self.is_score else "cost"


def side_and_controller(folder: Path, path: Path) -> tuple[str, str] | None:
    """Return what the folders above a recording name: its side, and its controller; None where they name no side.

    Args:
        folder: The folder that was given; its own name may be that of a side.
        path: A recording below it.
    """
    inside = path.relative_to(folder).parts
    parts = [*inside[:-1], path.stem if path.is_file() else path.name] if inside else []
    above = [_SIDES[part.casefold()] for part in parts if part.casefold() in _SIDES]
    sides = above or [_SIDES[name] for name in [folder.resolve().name.casefold()] if name in _SIDES]
    names = [part for part in parts if part.casefold() not in _SIDES]
    if len(sides) != 1 or not names:
        return None
    # The folders are the controller, and a file alone is one.
    return sides[0], "/".join(names[:-1] or names)


def names_its_run(facts: Mapping[str, Any]) -> str:
    """Return the side of a bag that says which controller ran on which side; empty of another.

    Args:
        facts: Its record of its run.
    """
    side = str(facts.get("side") or str(facts.get("namespace", "")).strip("/"))
    return side if isinstance(facts.get("controller"), Mapping) and side in SIDES else ""


def trials_below(folder: Path, template: Reading) -> list[Trial]:
    """Return the recordings below a folder that say nothing of their run, and of which a folder names the side."""
    found = []
    for path in bags_below(folder, FOUND):
        named = side_and_controller(folder, path)
        # What studies keep is theirs.
        if named is None or any((parent / "spec.json").is_file() for parent in path.parents):
            continue
        reading = replace(template, path=path, _cache={})
        if reading.is_bag:
            try:
                with read_bag(path) as bag:
                    if bag.damage or names_its_run(run_record(bag.metadata)):
                        continue
            except BagError:
                continue  # it is named with the bags
        found.append(Trial(named[1], named[0], reading))
    return found


def trials_of(rows: Sequence[Mapping[str, Any]], origin: str, folder: Path, template: Reading) -> list[Trial]:
    """Return the trials of a table's rows: ``controller``, ``side``, and ``file``, ``cost`` or ``score``; ``seed``.

    Args:
        rows: Values by name; an empty cost or score is a run that failed.
        origin: Where they are from, for messages.
        folder: Where their files are.
        template: How the files are read.

    Raises:
        DataError: A row lacks something, or has what is unknown.
    """
    trials = []
    for number, row in enumerate(rows, start=1):
        given = {str(key).strip().casefold(): value for key, value in row.items() if key is not None}
        of = f"row {number} of {origin}"
        what = [key for key in ("file", "cost", "score") if key in given]
        if set(given) - _COLUMNS or len(what) != 1 or not {"controller", "side"} <= set(given):
            raise DataError(
                f"{of} has {', '.join(given)}; expected controller, side, one of file, cost, score, and perhaps seed"
            )
        side, (key,) = str(given["side"]).strip(), what
        if side.casefold() not in _SIDES:
            raise DataError(f"{of}: side is {side!r}; expected simulation or hardware")
        name, value = str(given["controller"]).strip(), given[key]
        if name in {"", "None"}:
            raise DataError(f"{of} names no controller; expected its name")
        number_of = None if given.get("seed") in (None, "") else _number(given["seed"], f"{of}: seed")
        if number_of is not None and not (number_of >= 0.0 and number_of.is_integer()):
            raise DataError(f"{of}: seed is {given['seed']!r}; expected a whole number, 0 or more")
        seed = None if number_of is None else int(number_of)
        trial = Trial(name, _SIDES[side.casefold()], seed=seed, is_score=key == "score")
        if key == "file":
            trial = replace(trial, reading=replace(template, path=folder / str(value).strip(), _cache={}))
        elif value not in (None, ""):
            trial = replace(trial, cost=(-1.0 if trial.is_score else 1.0) * _number(value, f"{of}: {key}"))
        trials.append(trial)
    return trials


def trial_rows(texts: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return rows of texts ``CONTROLLER,SIDE,FILE``.

    Raises:
        DataError: A text has not three parts.
    """
    rows: list[Mapping[str, Any]] = []
    for text in texts:
        parts = text.split(",", 2)
        if len(parts) != 3:
            raise DataError(f"--trial is {text!r}; expected CONTROLLER,SIDE,FILE")
        rows.append(dict(zip(("controller", "side", "file"), parts, strict=True)))
    return rows


def table_rows(path: Path) -> list[Mapping[str, Any]]:
    """Return the rows of a table of trials, CSV or YAML.

    Raises:
        DataError: It is no table of trials.
    """
    expected = "expected a folder, or a table (.csv, .yaml) with controller, side, and file, cost or score"
    if not path.exists():
        raise DataError(f"{path} does not exist; {expected}")
    if path.suffix.lower() in {".yaml", ".yml"}:
        rows = load_yaml(path).get("trials")
        if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
            raise DataError(
                f"{path}: trials is {type(rows).__name__}; expected a list of entries with controller, side"
            )
        return rows
    if path.suffix.lower() not in TABLES:
        raise DataError(f"{path} is no table of trials; {expected}")
    with path.open(newline="", encoding="utf-8-sig") as file:
        text = [line for line in file if line.strip() and not line.startswith("#")]
    delimiter = max(",;\t", key=(text or [""])[0].count)
    rows = list(csv.DictReader(text, delimiter=delimiter))
    if not rows or "controller" not in {str(name).strip().casefold() for name in rows[0]}:
        raise DataError(f"{path} has the columns {', '.join(map(str, rows[0])) if rows else 'of nothing'}; {expected}")
    for number, row in enumerate(rows, start=1):
        # An empty cost is a run that failed; one that lacks its cell may have lost another.
        if None in row.values() or any(row.get(None, ())):
            raise DataError(f"row {number} of {path} has not as many cells as there are columns; {expected}")
    return rows


def _number(value: Any, what: str) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = math.nan
    if not math.isfinite(found):
        raise DataError(f"{what} is {value!r}; expected a finite number")
    return found


def run_of(trial: Trial, *, needs_input: bool) -> RunData:
    """Return the run of a trial of a plant of one joint, whole or the part that was chosen.

    Raises:
        DataError: It has no torque where that costs, or its guessed zero is that of an angle which is 0 upright.
    """
    reading = trial.reading
    assert reading is not None
    run = read_run(reading, or_all=True)
    if needs_input and run.of_file and run.applied is None:
        raise DataError(f"{reading} has no input; expected the torque, or --weights with a third of 0")
    if needs_input and run.window.effort_unit != "N m":
        raise DataError(
            f"{reading} has its input in {run.window.effort_unit}; expected N m, or --weights with a third of 0"
        )
    middle = float(np.median(run.window.position))
    if run.guessed and abs(middle) < _HANGING:
        raise DataError(
            f"{reading} hangs by the guess of its zero (median angle {middle:.3g} rad, upright is pi); expected a run "
            "that is held upright: where 0 is upright, write the guess with --write-mapping, set the offset of its "
            "position to 3.14159 (180 in deg), and give it as --mapping"
        )
    return run


def joint_parts(reading: Reading, joints: Sequence[str], plant: str) -> Array | None:
    """Return the parts of the cost of a recording of several joints, shape (3,); None where the plant fell.

    Args:
        reading: The recording.
        joints: Its joints.
        plant: Plant file or preset whose LQR weighs.

    Raises:
        DataError: No plant is given, or it has other joints.
    """
    if not plant:
        raise DataError(f"{reading} has the joints {', '.join(joints)}; expected --plant, whose LQR weighs them")
    own = load_mechanism(plant)
    names = own.coordinates.names
    if sorted(names) != sorted(joints):
        moved = [one.name for one in reading.motion.joints if one.drive is not None] if not reading.has_states else []
        found = matched_joints(joints, moved, own.coordinates)
        names = tuple(found[0]) if found else names
    if sorted(names) != sorted(joints):
        raise DataError(f"{reading} has the joints {', '.join(joints)}; expected {', '.join(names)}, as {own.name} has")
    runs = [read_run(reading, joint=joint, or_all=True) for joint in names]
    windows = [run.window for run in runs]
    position, velocity, effort = (
        np.stack([getattr(window, what) for window in windows], axis=1) for what in ("position", "velocity", "effort")
    )
    stamps = np.round(windows[0].t * NANOSECONDS).astype(np.int64)
    return cost_of_motion(own, stamps, position, velocity, effort)
