"""The reader of any recording: open it, map it, and show what was guessed."""

from __future__ import annotations

import json
import math
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.array_files import read_matlab, read_numpy
from pendulum_bags.recordings.bag_columns import read_bag_columns
from pendulum_bags.recordings.bridge_programs import last_words, run_bridge_program
from pendulum_bags.recordings.column_names import is_of
from pendulum_bags.recordings.columns import Column, Columns, part_of
from pendulum_bags.recordings.contract_bags import read_contract_bag
from pendulum_bags.recordings.delimited import read_delimited
from pendulum_bags.recordings.guess import Guess, guess_rules
from pendulum_bags.recordings.mapping import MAPPINGS, Motion, Rules, apply_rules, load_rules
from pendulum_bags.recordings.tables import is_lerobot, read_lerobot, read_parquet
from pendulum_msgs_py.contract.names import JOINT_STATES
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import Bag, read_bag
from pendulum_rosbag.reader.open_source import is_bag_folder, is_ros1

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["FOUND", "GUESS_HEAD", "SUFFIXES", "Reading", "guess_rows", "holds_states", "print_guesses", "write_mapping"]

GUESS_HEAD = ("recording", "quantity", "column", "unit", "how")

SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".mat", ".h5", ".hdf5", ".npz", ".npy", ".parquet", ".json", ".hebilog")
"""Files that are recordings, beside bags and LeRobot datasets."""
FOUND = frozenset({".csv", ".tsv", ".mat", ".h5", ".hdf5", ".npz", ".parquet", ".hebilog"})
"""Files that are taken for recordings where a folder is searched."""
_TEXT = (".csv", ".txt", ".tsv", ".dat")
_BAGS = (".mcap", ".db3", ".bag", ".zstd")
_EACH = 4
"""Recordings up to which each has rows of its own in the table of guesses."""
GUESS = "guess"
"""Mapping that guesses even where the columns have the names of the built-in mapping."""
_TIMEOUT = 300.0
"""Longest time that reading a HEBI log may take [s]."""
_ROLES = {
    "joint_states": "states", "states": "states", "position": "position", "velocity": "velocity", "input": "input",
    "applied_effort": "input", "effort_command": "input", "effort": "input", "reference": "reference",
    "disturbance": "disturbance", "time": "time",
}  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """A recording, and how to read it; where a path is expected, it is one.

    Attributes:
        path: File or folder; ``FILE#2`` is the second recording of a file of several.
        mapping: Mapping file, name of a built-in mapping, or the mapping itself; None to guess.
        topics: ``ROLE=TOPIC`` or ``ROLE=COLUMN``: where a role is taken from, such as ``joint_states=/robot/state``.
        dt: Time between two rows of a file without a time column [s].
        start, stop: Part to take, from the beginning of the recording [s].
        alone: Whether ``topics`` are of no other recording: each is to be in this one.
        effort, namespace: As :func:`~pendulum_bags.recordings.contract_bags.read_contract_bag` takes them.
    """

    path: Path
    mapping: str | Path | Mapping[str, Any] | None = None
    topics: Sequence[str] = ()
    dt: float | None = None
    start: float | None = None
    stop: float | None = None
    alone: bool = False
    effort: str = "applied"
    namespace: str | None = None
    _cache: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def of(cls, path: str | os.PathLike[str]) -> Reading:
        """Return a path as a reading."""
        return path if isinstance(path, Reading) else cls(Path(path))

    @property
    def name(self) -> str:
        """Name of the file or folder."""
        return self.path.resolve().name

    @property
    def is_bag(self) -> bool:
        """Whether it is a bag whose topics may have the names of this project's contract, which need no mapping."""
        source, _ = part_of(self.path)
        if self.topics or self.mapping not in (None, "free_swing"):
            return False
        if source.is_dir():
            return is_bag_folder(source) and not is_lerobot(source)
        return source.suffix.lower() in _BAGS and not is_ros1(source)

    @property
    def has_states(self) -> bool:
        """Whether it is a bag with states under the name of the contract."""
        if self.is_bag and "states" not in self._cache:
            with read_bag(part_of(self.path)[0]) as bag:
                self._cache["states"] = holds_states(bag)
        return self.is_bag and bool(self._cache["states"])

    @property
    def was_mapped(self) -> bool:
        """Whether its columns were mapped so far."""
        return "rules" in self._cache

    @property
    def columns(self) -> Columns:
        """The recording as columns."""
        if "columns" not in self._cache:
            self._cache["columns"] = self._open()
        return self._cache["columns"]

    @property
    def rules(self) -> Rules:
        """Its mapping, guessed where none was given."""
        return self._rules_and_guesses[0]

    @property
    def guesses(self) -> Sequence[Guess]:
        """What was guessed; nothing with a mapping."""
        return self._rules_and_guesses[1]

    def add_guess(self, guess: Guess) -> None:
        """Show a further guess with those of the columns."""
        rules, guesses = self._rules_and_guesses
        self._cache["rules"] = (rules, [*guesses, guess])

    @property
    def _rules_and_guesses(self) -> tuple[Rules, Sequence[Guess]]:
        if "rules" not in self._cache:
            known = self._known()
            if known is not None:
                rules = load_rules(known, self.path)
                self._cache["rules"] = (rules, _taken_by_name(self.columns, known, rules) if self.is_guessed else ())
            else:
                self._cache["rules"] = self._guess()
        return self._cache["rules"]

    def _guess(self) -> tuple[Rules, Sequence[Guess]]:
        wanted = _roles(self.topics)
        here = {role: place for role, place in wanted.items() if any(is_of(one, place) for one in self.columns.columns)}
        lacking = {role: place for role, place in wanted.items() if role not in here}
        for role, place in lacking.items():
            if self.alone:
                known = ", ".join(self.columns.columns)
                raise DataError(
                    f"{self.path} has no {place!r}, which --topic names for {role}; expected one of {known}"
                )
        rules, guesses = guess_rules(self.columns, period=self.dt, only=here)
        how = "--topic names {!r}, which is not in this recording"
        return rules, [*guesses, *(Guess(role, "", "", how.format(place), True) for role, place in lacking.items())]

    def _known(self) -> str | Path | Mapping[str, Any] | None:
        """Return the mapping that was given, or that of a format whose columns are known; else None."""
        if self.path.suffix.lower() == ".hebilog":
            return "pendulum"  # the mapping is the lab file
        if self.mapping is None and {"timestamp", "goal_position", "torque_enable"} <= self.columns.columns.keys():
            return "servo_log"
        if self.mapping is None and not (self.topics or self.dt) and self.path.suffix.lower() in _TEXT:
            # Columns of these very names are in SI by contract, and are held to it.
            sections = MAPPINGS["pendulum"]
            wanted = [sections[key]["column"] for key in ("time", "position", "input")]
            if all(self.columns.find([one] if isinstance(one, str) else one) for one in wanted):
                return "pendulum"
        return None if self.mapping == GUESS else self.mapping

    @property
    def is_guessed(self) -> bool:
        """Whether its columns were guessed, not stated; a HEBI log has its own."""
        return self.mapping in (None, GUESS) and self.path.suffix.lower() != ".hebilog"

    @property
    def motion(self) -> Motion:
        """The recording in SI units."""
        if "motion" not in self._cache:
            if self.has_states:
                free = self.mapping == "free_swing"
                source, _ = part_of(self.path)
                self._cache["motion"] = read_contract_bag(
                    source, effort=self.effort, namespace=self.namespace, swings_freely=free
                )
            else:
                self._cache["motion"] = apply_rules(self.columns, self.rules)
                self.columns.forget()
        return self._cache["motion"]

    def rows(self, time: Array) -> slice:
        """Return the rows of stamps [s] in the part that was chosen; a DataError if they are under four."""
        if self.start is None and self.stop is None:
            return slice(0, time.size)
        begin, stop = self.start or 0.0, math.inf if self.stop is None else self.stop
        first, last = (int(row) for row in np.searchsorted(time - time[0], (begin, stop)))
        if last - first < 4:
            until = "" if self.stop is None else f" to {stop:g} s"
            raise DataError(
                f"{self.path} has {last - first} samples from {begin:g} s{until} after its start, and ends at "
                f"{time[-1] - time[0]:.2f} s; expected at least 4"
            )
        return slice(first, last)

    def forget(self) -> None:
        """Free the columns and the motion; mapping and guesses stay."""
        for key in ("columns", "motion"):
            self._cache.pop(key, None)

    def _open(self) -> Columns:
        source, part = part_of(self.path)
        if not source.exists():
            raise DataError(f"{source} does not exist; expected a recording: a file of columns or arrays, or a bag")
        suffix = source.suffix.lower()
        if source.is_dir():
            if is_lerobot(source):
                return read_lerobot(source, part)
            if is_bag_folder(source):
                return read_bag_columns(source)
            if any(source.glob("*.npy")):
                return read_numpy(source)
            raise DataError(
                f"{source} is a folder without a bag, a LeRobot dataset or .npy files; expected a recording"
            )
        if suffix in _TEXT:
            rules = None if self.mapping in (None, GUESS) else load_rules(self.mapping, self.path)
            return read_delimited(source, **({} if rules is None else _layout(rules.further, rules.origin)))
        if suffix in {".mat", ".h5", ".hdf5"}:
            return read_matlab(source, part)
        if suffix in {".npz", ".npy"}:
            return read_numpy(source, part)
        if suffix == ".parquet":
            return read_parquet(source)
        if suffix == ".json":
            return _read_json(source)
        if suffix == ".hebilog":
            return _read_hebi_log(source, part, self.mapping)
        if suffix in _BAGS:
            return read_bag_columns(source)
        raise DataError(
            f"{source} has the suffix {suffix!r}; expected {', '.join(SUFFIXES)}, .mcap, .db3, .bag or a bag folder"
        )


def _taken_by_name(columns: Columns, mapping: str | Path | Mapping[str, Any], rules: Rules) -> Sequence[Guess]:
    """Return the rows of a built-in mapping that the names of the columns chose."""
    how = f"by its name, as {mapping} has it, 0 hanging down; --mapping {GUESS} tests it"
    sections = {"time": rules.time, **rules.joints[""]}
    names = {key: columns.find(np.atleast_1d(section["column"])) for key, section in sections.items()}
    return [Guess(key, name, str(sections[key]["unit"]), how, True) for key, name in names.items() if name]


def holds_states(bag: Bag) -> bool:
    """Return whether a bag has states under the name of the contract, or no topic at all."""
    return not bag.topics or any(f"/{topic}".endswith(f"/{JOINT_STATES}") for topic in bag.topics)


def _roles(topics: Sequence[str]) -> dict[str, str]:
    found = {}
    for text in topics:
        role, _, place = text.partition("=")
        if role not in _ROLES or not place:
            raise DataError(f"--topic is {text!r}; expected ROLE=NAME with a role of {', '.join(_ROLES)}")
        found[_ROLES[role]] = place
    return found


def _layout(further: Mapping[str, Any], origin: str) -> dict[str, Any]:
    delimiter, skip = further.get("delimiter", ""), further.get("skip", 0)
    if "delimiter" in further and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter in '\r\n"'):
        raise DataError(f"{origin}: delimiter is {delimiter!r}; expected one character")
    if type(skip) is not int or skip < 0:
        raise DataError(f"{origin}: skip is {skip!r}; expected a number of lines before the header, >= 0")
    return {"delimiter": delimiter, "skip": skip}


def _read_json(path: Path) -> Columns:
    """Return the columns of a JSON file: lists of numbers by name, or a list of entries with the same names."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not JSON: {error}") from error
    rows, meta = content, {}
    if isinstance(content, dict):
        meta = {str(key): value for key, value in content.items() if not isinstance(value, (list, dict))}
        entries = (value for value in content.values() if isinstance(value, list) and value)
        rows = next((value for value in entries if isinstance(value[0], dict)), content)
    lists: dict[str, Any] = {}
    if isinstance(rows, list) and rows and all(isinstance(row, dict) for row in rows):
        keys = dict.fromkeys(str(key) for row in rows for key in row)
        lists = {key: [row.get(key) for row in rows] for key in keys}
    elif isinstance(rows, dict):
        lists = {str(key): value for key, value in rows.items() if isinstance(value, list) and len(value) > 2}
    columns = {}
    for name, values in lists.items():
        try:
            array = np.array([np.nan if value is None else value for value in values], dtype=float)
        except (TypeError, ValueError, OverflowError):
            continue
        if array.ndim == 1:
            columns[name] = Column(name, array.size, array.__getitem__, by_rows=True)
    if not columns:
        raise DataError(f"{path} has no list of numbers, and no list of entries with numbers; expected a recording")
    is_table = len({column.size for column in columns.values()}) == 1
    return Columns(path, "JSON file", columns, is_table=is_table, meta=meta)


def _read_hebi_log(path: Path, part: int, lab: str | Path | Mapping[str, Any] | None) -> Columns:
    """Return the columns of a HEBI log; the vendor's library stays with the bridge, whose program ``convert`` reads it.

    ``part`` is the module's number from 1, 0 for the only one; ``lab`` its lab file with zero, sign and tare.
    """
    if isinstance(lab, Mapping):
        raise DataError(f"{path}: mapping is given as values; expected the lab file of a HEBI log")
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "log.csv"
        options = [*(["--lab", str(lab)] if lab else []), *(["--module", str(part - 1)] if part else [])]
        try:
            done = run_bridge_program("convert", str(path), "--out", str(table), *options, timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise DataError(f"{path} was not read within {_TIMEOUT:g} s") from None
        if done.returncode != 0:
            raise DataError(last_words(done.stderr, f"{path} cannot be read"))
        found = read_delimited(table)
        for name in found.columns:
            found.values(name)  # before the table is gone
    return replace(found, path=path, kind="HEBI log")


def write_mapping(path: Path, readings: Sequence[Reading]) -> None:
    """Write the mappings of some recordings to a file that ``--mapping`` reads; one for all where they are alike."""
    import yaml

    from pendulum_msgs_py.atomic_write import write_atomically

    each: dict[str, Any] = {}
    for reading in readings:
        rules = reading.rules.to_yaml()
        if each.setdefault(reading.name, rules) != rules:
            raise DataError(
                f"two recordings are called {reading.name}, and their mappings differ; expected other names"
            )
    contents = list(each.values())
    content: dict[str, Any] = contents[0]
    if any(other != contents[0] for other in contents):
        content = {"format": contents[0]["format"], "recordings": {}}
        for name, rules in each.items():
            content["recordings"][name] = {key: value for key, value in rules.items() if key != "format"}
    write_atomically(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120))


def guess_rows(readings: Sequence[Reading]) -> list[tuple[tuple[str, ...], bool]]:
    """Return what was guessed of some recordings, as rows under ``GUESS_HEAD``, and whether part of each is assumed."""
    alike: dict[str, list[Reading]] = {}
    for reading in readings:
        if reading.guesses:
            key = json.dumps(reading.rules.to_yaml()) if len(readings) > _EACH else str(reading)
            alike.setdefault(key, []).append(reading)
    rows = [(same, guess) for same in alike.values() for guess in same[0].guesses]
    found: list[tuple[tuple[str, ...], bool]] = []
    last = None
    for same, guess in rows:
        name = same[0].name + (f" and {len(same) - 1} mapped alike" if len(same) > 1 else "")
        cells = ("" if same is last else name, guess.quantity, guess.column, guess.unit, guess.how)
        found.append((cells, guess.assumed))
        last = same
    return found


def print_guesses(console: Console, readings: Sequence[Reading]) -> None:
    """Print what was guessed of some recordings, in one table."""
    from pendulum_msgs_py.programs.terminal import WholeTable

    if rows := guess_rows(readings):
        table = WholeTable(*GUESS_HEAD, title="Guessed from names, tested by the data")
        for cells, assumed in rows:
            table.add_row(*cells, style="yellow" if assumed else None)
        console.print(table)
