"""The questions of :mod:`pendulum_bags.analyse.questions` for many recordings, here or on a cluster, cached."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.analyse.questions import QUESTIONS
from pendulum_bags.recordings.reading import FOUND, Reading
from pendulum_bags.runs.find_bags import bags_below
from pendulum_bags.runs.run_folder import is_repeat, write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.studies.chunks import Connect, carry_out
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import BagError, ParameterError, PendulumError
from pendulum_rosbag.reader import Bag, read_bag
from pendulum_rosbag.reader.open_source import is_storage_file
from pendulum_rosbag.storage.metadata_file import METADATA_NAME

__all__ = ["Piece", "Table", "analyse_bags", "find_pieces"]

_LABELS = ("bag", "plant", "error")

Row = dict[str, Any]


@dataclass(frozen=True)
class Piece:
    """One recording, or one run folder with the bags ``sim`` and ``hw``; ``how`` to read it if it is no bag."""

    name: str
    path: str
    is_run: bool
    how: tuple[Any, ...] = ()

    @property
    def reading(self) -> Reading:
        """The recording."""
        return Reading(Path(self.path), *self.how)

    def fingerprint(self, questions: Sequence[str]) -> str:
        """Return a hash of what it holds, by sizes and times of its files, of the questions, and of the program."""
        path = Path(self.path)
        inside = (file for file in path.rglob("*") if file.name == METADATA_NAME or is_storage_file(file))
        files = [path] if path.is_file() else sorted(filter(Path.is_file, inside))
        seen = [(str(file.relative_to(path)), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        given = [*map(str, self.how)]
        content = json.dumps([self.name, self.is_run, given, list(questions), seen, program_hash()])
        return hashlib.sha256(content.encode()).hexdigest()[:16]


ANSWERING = ("pendulum_bags", "pendulum_lqr", "pendulum_msgs_py", "pendulum_rosbag", "pendulum_sim")
"""Packages of the project that results depend on."""


@cache
def program_hash() -> str:
    """Return a hash of the files that results depend on: another version of the program computes them again."""
    digest = hashlib.sha256()
    for package in ANSWERING:
        folder = Path(str(resources.files(package)))
        for file in sorted(file for file in folder.rglob("*") if file.is_file() and file.suffix != ".pyc"):
            digest.update(f"{package}/{file.relative_to(folder)}".encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Table:
    """The results, and the time that this call took [s]."""

    bags: Sequence[Row]
    runs: Sequence[Row]
    cached: int = 0
    wall: float = field(default=0.0, compare=False)

    @property
    def failed(self) -> int:
        """How many rows hold an error."""
        return sum(bool(row["error"]) for row in (*self.bags, *self.runs))


def find_pieces(folders: Sequence[Path], questions: Sequence[str], how: Reading | None = None) -> list[Piece]:
    """Return every bag, and every run folder if a question needs them, below some folders, ordered by name.

    Recordings of other formats count if their folder has no bag, or if they are given themselves.

    Args:
        questions: Names of ``QUESTIONS``.

    Raises:
        BagError: A folder does not exist, or there is no bag in any of them.
        ParameterError: A question is unknown.
    """
    for question in questions:
        if question not in QUESTIONS:
            raise ParameterError(f"question is {question!r}; expected one of {', '.join(QUESTIONS)}")
    bags: dict[Path, str] = {}
    for folder in folders:
        if not folder.exists():
            raise BagError(f"{folder} does not exist; expected a folder of bags, or a bag")
        for path in [*bags_below(folder)] or bags_below(folder, FOUND):
            own = folder.resolve().name
            below = own if path == folder else str(path.relative_to(folder))
            name = f"{own}/{below}" if len(folders) > 1 and path != folder else below
            bags.setdefault(path.resolve(), name)
    kinds = {QUESTIONS[question].of_runs for question in questions}
    found: list[Piece] = []
    for path, name in _distinct(bags).items():
        if False in kinds:
            given = () if how is None else (how.mapping, how.topics, how.dt, how.start, how.stop)
            found.append(Piece(name, str(path), False, given))
        run = path.parent
        if True in kinds and path.name == "sim" and (run / "hw").is_dir() and not is_repeat(run):
            found.append(Piece(str(Path(name).parent) if len(Path(name).parts) > 1 else run.name, str(run), True))
    if not found:
        what = " or ".join(sorted("run folder with the bags sim and hw" if of_runs else "bag" for of_runs in kinds))
        raise BagError(f"{', '.join(map(str, folders))}: no {what} in there")
    return sorted(found, key=lambda piece: (piece.name, piece.is_run))


def _distinct(bags: Mapping[Path, str]) -> dict[Path, str]:
    """Return the bags with distinct names, from their common folder where two are alike."""
    if len(set(bags.values())) == len(bags):
        return dict(bags)
    common = Path(os.path.commonpath([path.parent for path in bags]))
    return {path: str(path.relative_to(common)) for path in bags}


def analyse_bags(
    folder: Path,
    pieces: Sequence[Piece],
    questions: Sequence[str],
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Table:
    """Compute what is missing of every piece, and write ``bags.csv``, ``runs.csv`` and their JSON.

    Args:
        folder: For results and tables; existing results are continued.
        questions: Names of ``QUESTIONS``.
        connect: To a Dask cluster (`cluster_client`) with the bags under the same paths; by default this process.
    """
    began = time.monotonic()
    answers = folder / "answers"
    answers.mkdir(parents=True, exist_ok=True)
    # The key of a result covers bag and questions, so that a changed bag is analysed again.
    keys = [piece.fingerprint(questions) for piece in pieces]
    rows = {index: found for index, key in enumerate(keys) if (found := _cached(answers / f"{key}.json")) is not None}
    cached = len(rows)
    on_progress(cached, len(pieces))
    job = (tuple(pieces), tuple(questions), str(folder.resolve()))
    missing = [index for index in range(len(pieces)) if index not in rows]
    for index, found in carry_out(_ask, job, missing, connect):
        write_json(answers / f"{keys[index]}.json", found)
        rows[index] = found
        on_progress(len(rows), len(pieces))
    table = Table(
        bags=[row for index, piece in enumerate(pieces) if not piece.is_run for row in rows[index]],
        runs=[row for index, piece in enumerate(pieces) if piece.is_run for row in rows[index]],
        cached=cached,
        wall=time.monotonic() - began,
    )
    for name, content in (("bags", table.bags), ("runs", table.runs)):
        if content:
            _write_table(folder / f"{name}.csv", content)
            write_json(folder / f"{name}.json", content)
    return table


def _ask(job: tuple[Sequence[Piece], Sequence[str], str], index: int, _threads: int | None) -> list[Row]:
    """Return the rows of a piece; a failure is reported in its row."""
    pieces, questions, out = job
    piece = pieces[index]
    if not Path(piece.path).exists():
        raise BagError(f"{piece.path} is not on this machine; expected the bags under the same path on every worker")
    chosen = [QUESTIONS[question].answer for question in questions if QUESTIONS[question].of_runs is piece.is_run]
    if piece.is_run:
        row: Row = {"bag": piece.name, "plant": "", "error": ""}
        _answer(row, chosen, Path(piece.path), Path(out), piece.name)
        return [row]
    reading = piece.reading
    try:
        plants, facts = [""], {}
        if reading.has_states:
            with read_bag(piece.path) as bag:
                plants, facts = _plants(bag), _run_facts(bag)
    except Exception as error:  # noqa: BLE001  # one bag must not cost the table of a thousand others
        return [{"bag": piece.name, "plant": "", "error": _sentence(error)}]
    if not plants:
        return [{"bag": piece.name, "plant": "", "error": f"the bag has no topic that ends in {names.JOINT_STATES}"}]
    rows = []
    for plant in plants:
        row = {"bag": piece.name, "plant": plant, "error": "", **facts}
        _answer(row, chosen, reading, plant)
        row |= {"guessed": _guessed(reading)} if reading.was_mapped and not row["error"] else {}
        rows.append(row)
    return rows


def _answer(row: Row, questions: Sequence[Callable[..., Mapping[str, Any]]], *arguments: Any) -> None:
    errors = []
    for question in questions:
        try:
            row.update({name: _plain(value) for name, value in question(*arguments).items()})
        except Exception as error:  # noqa: BLE001  # as above
            errors.append(_sentence(error))
    row["error"] = "; ".join(dict.fromkeys(errors))


def _sentence(error: Exception) -> str:
    if isinstance(error, PendulumError):
        return str(error)
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _guessed(reading: Reading) -> str:
    return "; ".join(
        f"{one.quantity}: {one.column} [{one.unit}]{' (assumed)' * one.assumed}" for one in reading.guesses if one.unit
    )


def _plants(bag: Bag) -> list[str]:
    ending = f"/{names.JOINT_STATES}"
    return sorted(topic[: -len(ending)] for topic in bag.topics if topic.endswith(ending))


def _run_facts(bag: Bag) -> Row:
    run = run_record(bag.metadata)
    controller = run.get("controller")
    kind = controller.get("kind") if isinstance(controller, Mapping) else controller
    found = {"experiment": run.get("experiment"), "seed": run.get("seed"), "controller": kind}
    return {name: value for name, value in found.items() if isinstance(value, (str, int, float))}


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cached(path: Path) -> list[Row] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, list) else None


def _write_table(path: Path, rows: Sequence[Row]) -> None:
    columns = list(dict.fromkeys((*_LABELS, *(name for row in rows for name in row))))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
