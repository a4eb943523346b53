"""Mapping files: which column of a recording is what, in which unit, sign and zero.

Example::

    format: pendulum_columns/1
    time: {column: time, unit: ms}          # or {period: 0.025, unit: s} where there is no time column
    position: {column: alpha, unit: deg, sign: -1, offset: 180.0}
    velocity: {column: alpha_dot, unit: deg/s}
    input: {column: u, unit: V, hold: zero}

A plant of several joints has ``position``, ``velocity`` and ``input`` (or ``effort``) of each under ``joints``. A file
may hold the mappings of several recordings, by their names, under ``recordings``.

``offset`` has the column's unit and is added before sign and unit are applied: value = sign * (raw + offset).
The unit of ``input`` says what drives the joint: a torque, a voltage, a number without a unit (``-``, as of a pulse
width), or an angle (set point of a servo). Without ``input`` the pendulum swings freely. ``hold`` says what the input
does between two samples: ``zero`` stays (a command), ``linear`` goes straight to the next (a measurement; the default
for a torque). ``detrend: constant`` or ``linear`` takes a mean or a drift from the input of a bad torque sensor.
``reference`` is what a controller followed, ``disturbance`` what was added to its command. ``time: {own: true}`` takes
for each quantity the stamps that the file has for it. ``skip`` lines before the header, if any, are left out, as are
lines that begin with ``#``; ``drop_nan: true`` leaves out rows with a NaN or an empty cell. Where each row has the
columns of one topic, each quantity is taken from its own rows, a velocity by interpolation. A unit that the file states
is compared with the mapping. Where the time steps back, the recording is cut.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.clock import continued, first_of_each_stamp
from pendulum_bags.recordings.columns import Column, Columns
from pendulum_bags.recordings.units import factor, input_quantity, quantity_of
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import load_yaml, suggestion
from pendulum_rosbag.reader.joint_state import two_motions

__all__ = ["FORMAT", "MAPPINGS", "Drive", "JointMotion", "Motion", "Rules", "apply_rules", "load_rules"]

FORMAT = "pendulum_columns/1"
_FORMATS = (FORMAT, "pendulum_joint_columns/1")

MAPPINGS: Mapping[str, Mapping[str, Any]] = {
    "pendulum": {
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "position", "unit": "rad"},
        "velocity": {"column": "velocity", "unit": "rad/s", "optional": True},
        "input": {"column": ["torque", "effort"], "unit": "N m", "hold": "linear"},
    },
    "voltage_40hz": {
        "time": {"period": 0.025, "unit": "s"},
        "position": {"column": "th", "unit": "rad"},
        "input": {"column": "u", "unit": "V", "hold": "zero"},
    },
    "free_swing": {
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "position", "unit": "rad"},
        "velocity": {"column": "velocity", "unit": "rad/s", "optional": True},
    },
    "servo_log": {
        "time": {"column": "timestamp", "unit": "s"},
        "position": {"column": "position", "unit": "rad"},
        "velocity": {"column": "speed", "unit": "rad/s", "optional": True},
        "input": {"column": "goal_position", "unit": "rad", "hold": "zero"},
    },
}
"""Built-in mappings: ``pendulum``, ``voltage_40hz`` (a motor-driven disc, no time column), ``free_swing``, and
``servo_log`` (a log of the friction study: the set point of a servo is the input)."""

_VALUE_KEYS = {"column", "unit", "sign", "offset", "optional"}
_SECTION_KEYS = {
    "time": {"column", "unit", "period", "start", "own"},
    "position": _VALUE_KEYS - {"optional"},
    "velocity": _VALUE_KEYS,
    "input": {*_VALUE_KEYS, "hold", "detrend"},
    "reference": _VALUE_KEYS,
    "disturbance": {*_VALUE_KEYS, "hold"},
}
_OF_JOINT = tuple(key for key in _SECTION_KEYS if key != "time")
_TOP_KEYS = {"format", "delimiter", "skip", "rows", "drop_nan", "meta", "joints", *_SECTION_KEYS}

Sections = Mapping[str, Mapping[str, Any]]
_Rows = NDArray[np.bool_] | slice


@dataclass(frozen=True)
class Rules:
    """A mapping that has been checked: sections of time and of each joint (one without a name for a plant of one).

    ``origin`` is for messages; ``further`` has ``delimiter``, ``skip``, ``rows``, ``drop_nan`` and ``meta``.
    """

    time: Mapping[str, Any]
    joints: Mapping[str, Sections]
    origin: str = "mapping"
    further: Mapping[str, Any] = field(default_factory=dict)
    guessed: bool = False

    def to_yaml(self) -> dict[str, Any]:
        """Return the content of a mapping file."""
        content = {"format": FORMAT, "time": dict(self.time)}
        if list(self.joints) == [""]:
            content |= {key: dict(section) for key, section in self.joints[""].items()}
        else:
            content["joints"] = {
                name: {key: dict(section) for key, section in sections.items()}
                for name, sections in self.joints.items()
            }
        return content | {key: value for key, value in self.further.items() if key != "meta" or value}


@dataclass(frozen=True)
class Drive:
    """What drives a joint, disturbs it, or is followed by it.

    Attributes:
        time: Stamps, shape (n,) [s].
        values: Shape (n,), in SI.
        quantity: ``effort``, ``force``, ``voltage``, ``command``, ``angle`` or ``place``.
        hold: ``zero`` or ``linear``.
        own_clock: Whether it has stamps of its own.
        hold_assumed: Whether that is assumed, not stated for this file.
    """

    time: Array
    values: Array
    quantity: str
    hold: str
    own_clock: bool = False
    hold_assumed: bool = False


@dataclass(frozen=True)
class JointMotion:
    """One joint of a recording, in SI units.

    Attributes:
        name: Empty for a plant of one joint.
        position: Shape (n,) [rad or m].
        velocity: Shape (n,) [rad/s or m/s], None where it was not recorded.
        drive: Its input; None where nothing drives it.
        reference, disturbance: Where they were recorded.
        slides: Whether its position is a place.
    """

    name: str
    position: Array
    velocity: Array | None
    drive: Drive | None
    reference: Drive | None = None
    disturbance: Drive | None = None
    slides: bool = False


@dataclass(frozen=True)
class Motion:
    """A recording in SI units: stamps, strictly increasing, shape (n,) [s], and at least one joint.

    ``meta`` says what was done to it while it was read.
    """

    time: Array
    joints: Sequence[JointMotion]
    meta: Mapping[str, Any]


# -- reading a mapping -------------------------------------------------------------------------------------------


def load_rules(mapping: str | Path | Mapping[str, Any], recording: Path) -> Rules:
    """Return the mapping of a recording, from a file, a name in ``MAPPINGS`` or the mapping itself.

    A DataError if a key, or what it holds, is not one of a mapping.
    """
    if isinstance(mapping, Mapping):
        rules, origin = mapping, "mapping"
    elif str(mapping) in MAPPINGS:
        rules, origin = MAPPINGS[str(mapping)], f"built-in mapping {str(mapping)!r}"
    else:
        if not Path(mapping).exists():
            raise DataError(f"mapping {mapping} is neither a file nor one of {', '.join(MAPPINGS)}")
        rules, origin = load_yaml(Path(mapping)), str(mapping)
        if rules.get("format") not in _FORMATS:
            raise DataError(f"{origin}: format is {rules.get('format')!r}; expected {FORMAT!r}")
    if "recordings" in rules:
        each = rules["recordings"]
        if not isinstance(each, Mapping) or recording.name not in each:
            known = ", ".join(map(str, each)) if isinstance(each, Mapping) else repr(each)
            raise DataError(f"{origin} has no mapping for {recording.name}; it has those of {known}")
        rules, origin = each[recording.name], f"{origin}: recordings.{recording.name}"
        if not isinstance(rules, Mapping):
            raise DataError(f"{origin} is {rules!r}; expected a mapping")
    _reject_unknown(rules, _TOP_KEYS, origin)
    several = rules.get("joints")
    if "joints" in rules and (not isinstance(several, Mapping) or not several):
        raise DataError(f"{origin}: joints is {several!r}; expected names of joints, each with its position")
    if several is None:
        joints = {"": {key: rules[key] for key in _OF_JOINT if key in rules}}
    else:
        if outside := [key for key in _OF_JOINT if key in rules]:
            raise DataError(f"{origin}: {outside[0]} stands beside joints; expected it under the joint that it is of")
        joints = {str(name): _sections(sections, f"{origin}: joints.{name}") for name, sections in several.items()}
    if "time" not in rules:
        raise DataError(f"{origin} has no 'time'; expected e.g. time: {{column: time, unit: ...}}")
    for name, sections in joints.items():
        where = f"{origin}: joints.{name}" if name else origin
        if "position" not in sections:
            raise DataError(f"{where} has no 'position'; expected e.g. position: {{column: position, unit: ...}}")
        for key, section in {"time": rules["time"], **sections}.items():
            if not isinstance(section, Mapping):
                raise DataError(f"{where}: {key} is {section!r}; expected {{column: ..., unit: ...}}")
            _reject_unknown(section, _SECTION_KEYS[key], f"{where}: {key}")
    _check_distinct_columns(joints, origin)
    further = {key: rules[key] for key in ("delimiter", "skip", "rows", "drop_nan", "meta") if key in rules}
    return Rules(rules["time"], joints, origin, further)


def _sections(given: Any, where: str) -> dict[str, Any]:
    if not isinstance(given, Mapping):
        raise DataError(f"{where} is {given!r}; expected position, velocity and effort")
    _reject_unknown(given, {*_OF_JOINT, "effort"}, where)
    return {("input" if key == "effort" else str(key)): section for key, section in given.items()}


def _reject_unknown(given: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in given:
        if key not in known:
            raise DataError(f"{where} has an unknown key {key!r}; {suggestion(key, sorted(known))}")


def _check_distinct_columns(joints: Mapping[str, Any], origin: str) -> None:
    seen: dict[str, str] = {}
    for joint, sections in joints.items():
        column = sections["position"].get("column")
        if isinstance(column, str) and column in seen:
            raise DataError(f"{origin}: {seen[column]} and {joint} have the same column {column!r}; expected two")
        seen[str(column)] = joint


# -- applying it -------------------------------------------------------------------------------------------------


@dataclass
class _Track:
    """A column that was found, its stamps [s] and values as the file has them, and its section of the mapping.

    ``clock`` is empty for equal steps; ``apart``: it has rows, or a clock, of its own.
    """

    column: Column
    clock: str
    stamps: Array
    values: Array
    section: Mapping[str, Any]
    apart: bool = False

    @property
    def known(self) -> NDArray[np.bool_]:
        """Rows that hold a number and a stamp."""
        return np.isfinite(self.stamps) & np.isfinite(self.values)


def apply_rules(columns: Columns, rules: Rules) -> Motion:
    """Return a recording in SI units; a DataError names file, column, row and what was expected."""
    return _Reader(columns, rules).motion()


class _Reader:
    def __init__(self, columns: Columns, rules: Rules) -> None:
        self.columns, self.rules = columns, rules
        self.source, self.origin = columns.path, rules.origin
        given = rules.further.get("meta") or {}
        if not isinstance(given, Mapping):
            raise DataError(f"{self.origin}: meta is {given!r}; expected names and values")
        self.meta: dict[str, Any] = {"source": str(self.source), "mapping": self.origin, **columns.meta, **given}
        if columns.notes:
            self.meta["clock_notes"] = list(columns.notes)
        self.cut = self._row_range()
        self.stamps: dict[str, Array] = {}

    def _row_range(self) -> slice:
        if self.rules.further.get("rows") is None:
            return slice(0, None)
        count = max(column.size for column in self.columns.columns.values())
        rows = self.rules.further["rows"]
        valid = isinstance(rows, (list, tuple)) and len(rows) == 2 and all(type(row) is int for row in rows)
        if not valid or not 0 <= rows[0] < min(rows[1], count):
            raise DataError(
                f"{self.origin}: rows is {rows!r}; expected [first, stop] within the {count} rows of the file"
            )
        found = slice(rows[0], min(rows[1], count))
        if found != slice(0, count):
            self.meta["rows"] = [found.start, found.stop]
        return found

    def motion(self) -> Motion:
        if not {"period", "own"} & self.rules.time.keys():
            self._find("time", self.rules.time)
        tracks = {
            joint: {key: track for key, section in sections.items() if (track := self._track(key, section)) is not None}
            for joint, sections in self.rules.joints.items()
        }
        every = [(key, track) for found in tracks.values() for key, track in found.items()]
        base = next(track for key, track in every if key == "position")
        rows = self._rows(base, every)
        time, steps = self._time(base, rows)
        if steps:
            self.meta["clock_notes"] = [*self.meta.get("clock_notes", ()), *steps]
        first = first_of_each_stamp(time)
        if not first.all():
            self.meta["repeated_stamps"] = int(np.sum(~first))
        kept = _chosen(first)
        joints = []
        for name, found in tracks.items():
            position = self._state(found["position"], "position", rows, time)
            slides = quantity_of(str(found["position"].section.get("unit"))) == "place"
            if jumps := two_motions(position):
                raise DataError(f"{self.source} holds two motions ({jumps}); expected those of one plant")
            if not slides:
                _check_jumps(self.source, position)
            velocity = self._state(found["velocity"], "velocity", rows, time)[kept] if "velocity" in found else None
            drive, reference, disturbance = (
                self._drive(found[key], key, rows, time, kept) if key in found else None
                for key in ("input", "reference", "disturbance")
            )
            joints.append(JointMotion(name, position[kept], velocity, drive, reference, disturbance, slides))
        _check_step(self.source, time)
        return Motion(time[kept], joints, self.meta)

    def _track(self, key: str, section: Mapping[str, Any]) -> _Track | None:
        """Return the column of a section; None for an optional one that is not there, or has no number."""
        name = self._find(key, section)
        if name is None:
            return None
        column = self.columns.columns[name]
        self._check_stated(column, section.get("unit"))
        values = self.columns.values(name)
        if values.size and np.isnan(values).all():
            if section.get("optional"):
                return None
            way = self._free_swing(key) or "name another one"
            raise DataError(f"{self.source}: column {name!r} holds no number at all; expected those of {key}: {way}")
        clock, stamps = self._stamps(column)
        if values.size != stamps.size:
            raise DataError(
                f"{self.source}: column {name!r} has {values.size} values and its time {stamps.size}; "
                "expected as many: name another time in a mapping file"
            )
        return _Track(column, clock, stamps[self.cut], values[self.cut], section)

    def _find(self, key: str, section: Mapping[str, Any]) -> str | None:
        wanted = section.get("column")
        candidates = wanted if isinstance(wanted, (list, tuple)) else [wanted] if wanted else []
        if not all(isinstance(candidate, str) for candidate in candidates):
            raise DataError(f"{self.origin}: column of {key} is {wanted!r}; expected a name or a list of names")
        found = self.columns.find(candidates)
        if found is not None or section.get("optional"):
            return found
        way = self._free_swing(key)
        raise DataError(
            f"{self.source} has no column {' or '.join(map(repr, candidates)) or '(none given)'} for {key} "
            f"(asked for by {self.origin}); it has {', '.join(self.columns.columns)}" + f"; {way}" * bool(way)
        )

    def _free_swing(self, key: str) -> str:
        free = key == "input" and self.origin.startswith("built-in")
        return "`--mapping free_swing` reads a pendulum that nothing drives" if free else ""

    def _check_stated(self, column: Column, unit: Any) -> None:
        if column.unit and quantity_of(column.unit) and column.unit != unit:
            raise DataError(
                f"{self.source}: column {column.name!r} is in {column.unit} by what the file says; "
                f"{self.origin} says {unit!r}: write `unit: {column.unit}` in a mapping file"
            )

    def _stamps(self, column: Column) -> tuple[str, Array]:
        """Return the name of a column's clock, and its stamps [s]."""
        section = self.rules.time
        where = f"{self.origin}: unit of time"
        if "period" in section:
            period = _number("period", section, "time", self.origin) * factor(section.get("unit"), "time", where)
            if not (math.isfinite(period) and period > 0.0):
                raise DataError(f"{self.origin}: period of time is {section['period']!r}; expected > 0")
            return "", np.arange(column.size, dtype=np.float64) * period
        if section.get("own") is True:
            if not column.clock:
                raise DataError(f"{self.source}: column {column.name!r} has no stamps of its own; name a time column")
            clock = self.columns.columns[column.clock]
            unit = section.get("unit", clock.unit or "s")
        else:
            name = self._find("time", section)
            assert name is not None
            clock, unit = self.columns.columns[name], section.get("unit")
        self._check_stated(clock, unit)
        if clock.name not in self.stamps:
            start = _number("start", section, "time", self.origin)
            self.stamps[clock.name] = _scaled(self.columns.values(clock.name), -start, factor(unit, "time", where))
        return clock.name, self.stamps[clock.name]

    def _rows(self, base: _Track, tracks: Sequence[tuple[str, _Track]]) -> NDArray[np.bool_]:
        """Return the rows of the base clock that hold the motion, and mark what is apart from them."""
        whole = base.known
        for _, track in tracks:
            if track.clock != base.clock or track.values.size != base.values.size:
                track.apart = True
                continue
            # Topics that a logger writes apart may meet in some rows; holes leave most of them whole.
            track.apart = bool(2 * np.sum(whole & track.known) < min(np.sum(whole), np.sum(track.known)))
        own = [key for key, track in tracks if track.apart]
        if own:
            self.meta["rows_by_topic"] = sorted(set(own))
        sparse = any(track.apart and track.clock == base.clock for _, track in tracks)
        if not sparse and self.rules.further.get("drop_nan") is not True:
            return np.ones(whole.size, bool)
        for _, track in tracks:
            if not track.apart and (whole & track.known).any():
                whole &= track.known
        if not sparse:
            self.meta["nan_rows"] = int(np.sum(~whole))
        return whole

    def _time(self, track: _Track, rows: NDArray[np.bool_]) -> tuple[Array, list[str]]:
        self._refuse_holes(track.clock, track.stamps, rows)
        return continued(track.stamps[_chosen(rows)])

    def _refuse_holes(self, name: str, values: Array, rows: NDArray[np.bool_]) -> None:
        bad = np.flatnonzero(~np.isfinite(values) & rows)
        if bad.size:
            raise DataError(
                f"{self.source}: column {name!r} is {values[bad[0]]} in row {bad[0] + self.cut.start} ({bad.size} such "
                "rows); expected finite numbers: `drop_nan: true` in the mapping file leaves such rows out"
            )

    def _si(self, track: _Track, key: str, quantity: str, rows: NDArray[np.bool_]) -> Array:
        section = track.section
        size = factor(section.get("unit"), quantity, f"{self.origin}: unit of {key}")
        sign = section.get("sign", 1)
        if sign not in (1, -1):
            raise DataError(f"{self.origin}: sign of {key} is {sign!r}; expected 1 or -1")
        self._refuse_holes(track.column.name, track.values, rows)
        values = _scaled(track.values[_chosen(rows)], _number("offset", section, key, self.origin), sign * size)
        # Of a long recording the column and its copy are not held together for all quantities.
        self.columns.forget(track.column.name)
        track.values = values
        return values

    def _apart(self, track: _Track, key: str, quantity: str) -> tuple[Array, Array]:
        """Return stamps and values of what has rows of its own."""
        stamps, _ = self._time(track, track.known)
        values = self._si(track, key, quantity, track.known)
        kept = first_of_each_stamp(stamps)
        return stamps[kept], values[kept]

    def _state(self, track: _Track, key: str, rows: NDArray[np.bool_], time: Array) -> Array:
        """Return a position or a velocity at the stamps of the motion."""
        slides = quantity_of(str(track.section.get("unit"))) in {"place", "speed"}
        quantity = {"position": ("angle", "place"), "velocity": ("velocity", "speed")}[key][slides]
        if not track.apart:
            return self._si(track, key, quantity, rows)
        return np.interp(time, *self._apart(track, key, quantity))

    def _drive(self, track: _Track, key: str, rows: NDArray[np.bool_], time: Array, kept: _Rows) -> Drive:
        section = track.section
        quantity = input_quantity(section.get("unit"), self.origin, reference=key == "reference")
        if track.apart:
            stamps, values = self._apart(track, key, quantity)
        else:
            stamps, values = time[kept], self._si(track, key, quantity, rows)[kept]
        torque = quantity in {"effort", "force"}
        hold = section.get("hold", "linear" if torque and key == "input" and not track.apart else "zero")
        if hold not in ("zero", "linear"):
            raise DataError(f"{self.origin}: hold of {key} is {hold!r}; expected zero or linear")
        # A built-in mapping and a default are guesses.
        assumed = "hold" not in section or self.rules.guessed or self.origin.startswith("built-in")
        values = _detrended(values, section.get("detrend"), self.origin)
        return Drive(stamps, values, quantity, hold, track.apart, assumed)


def _scaled(values: Array, offset: float, size: float) -> Array:
    """Return size (values + offset) by one copy; the values themselves where it changes nothing."""
    if offset == 0.0 and size == 1.0:
        return values
    found = values + offset
    found *= size
    return found


def _chosen(rows: NDArray[np.bool_]) -> _Rows:
    """Return an index of rows that copies nothing where it chooses all."""
    return slice(None) if rows.all() else rows


def _detrended(values: Array, detrend: Any, origin: str) -> Array:
    if detrend is None:
        return values
    if detrend not in ("constant", "linear"):
        raise DataError(f"{origin}: detrend of input is {detrend!r}; expected constant or linear")
    return np.asarray(scipy.signal.detrend(values, type=detrend))


def _number(key: str, section: Mapping[str, Any], name: str, origin: str) -> float:
    value = section.get(key, 0.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise DataError(f"{origin}: {key} of {name} is {value!r}; expected a finite number")
    return float(value)


def _check_step(source: Path, time: Array) -> None:
    """Refuse stamps that can hardly be in the unit that the mapping claims."""
    if time.size < 2:
        return
    steps = np.diff(time)
    np.abs(steps, out=steps)
    if (step := float(np.median(steps, overwrite_input=True))) >= 1.0:
        raise DataError(f"{source}: the median time step is {step:.3g} s; expected < 1 s: is the unit ms, us or ns?")


def _check_jumps(source: Path, position: Array) -> None:
    steps = np.diff(position)
    largest = max(float(np.max(steps, initial=0.0)), -float(np.min(steps, initial=0.0)))
    if position.size > 10 and largest > 25.0:
        raise DataError(
            f"{source}: the angle jumps by {largest:.3g} rad between samples; expected rad: is the unit deg?"
        )
