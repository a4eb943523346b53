"""CSV files of any column order, unit and sign, by a small mapping file.

Example::

    format: pendulum_columns/1
    time: {column: time, unit: ms}          # or {period: 0.025, unit: s} where there is no time column
    position: {column: alpha, unit: deg, sign: -1, offset: 180.0}
    velocity: {column: alpha_dot, unit: deg/s}
    input: {column: u, unit: V, hold: zero}

``offset`` has the column's unit and is added before sign and unit are applied: value = sign * (raw + offset).
The unit of ``input`` says what drives the joint: a torque, a voltage, or an angle (set point of a servo). Without
``input`` the pendulum swings freely. ``hold`` says what the input does between two samples: ``zero`` stays (a
command), ``linear`` goes straight to the next (a measurement; the default for a torque). ``detrend: constant`` or
``linear`` takes a mean or a drift from the input of a bad torque sensor. ``skip`` lines before the header, if any,
are left out, as are lines that begin with ``#``; ``drop_nan: true`` leaves out rows with a NaN or an empty cell. Where
each row has the columns of one topic, each quantity is taken from its own rows, a velocity by interpolation. A row of
units below the header is compared with the mapping. An angle that jumps by whole turns is unwrapped; where the time
steps back, the recording is cut.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.runs.datasets import Recording, continued, first_of_each_stamp
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import load_yaml, suggestion
from pendulum_rosbag.reader.joint_state import two_motions

__all__ = ["MAPPINGS", "UNITS", "read_csv"]

FORMAT = "pendulum_columns/1"

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "velocity": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180.0,
        "rev/s": 2.0 * math.pi,
        "rpm": math.pi / 30.0,
    },
    "effort": {"N m": 1.0, "Nm": 1.0, "mN m": 1e-3, "kg cm": 0.0980665},
    "voltage": {"V": 1.0, "mV": 1e-3},
}
"""Factor from each accepted unit to SI, by quantity."""

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
}
"""Built-in mappings: ``pendulum`` (the default), ``voltage_40hz`` (a motor-driven disc, no time column), and
``free_swing`` (no input)."""

_DELIMITERS = (",", ";", "\t")
_DECIMAL_COMMA, _DECIMAL_POINT = re.compile(r"\d,\d"), re.compile(r"(?<![\d.])\d+\.\d+(?![\d.])")
"""A date such as 27.11.2026 has no decimal point."""

_SECTION_KEYS = {
    "time": {"column", "unit", "period", "start"},
    "position": {"column", "unit", "sign", "offset"},
    "velocity": {"column", "unit", "sign", "offset", "optional"},
    "input": {"column", "unit", "sign", "offset", "hold", "detrend"},
}
_TOP_KEYS = {"format", "delimiter", "skip", "rows", "drop_nan", "meta", *_SECTION_KEYS}


def read_csv(
    path: str | Path,
    mapping: str | Path | Mapping[str, Any] | None = None,
    *,
    hold: str | None = None,
    also: Iterable[Mapping[str, Any]] = (),
) -> Recording:
    """Read a CSV file into a recording.

    Args:
        path: The file; its first line names the columns, with or without a leading ``#``.
        mapping: Mapping file, name of one of ``MAPPINGS``, or the mapping itself.
        hold: ``zero`` or ``linear``, in place of what the mapping says of the input.
        also: Mappings of what is read from the same rows besides; a hole there is one for ``drop_nan``, too.

    Raises:
        DataError: naming file, column, row and what was expected.
    """
    source = Path(path)
    rules, origin = _load_mapping(mapping)
    delimiter = rules.get("delimiter", "")
    if "delimiter" in rules and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter in '\r\n"'):
        raise DataError(f"{origin}: delimiter is {delimiter!r}; expected one character")
    skip = rules.get("skip", 0)
    if type(skip) is not int or skip < 0:
        raise DataError(f"{origin}: skip is {skip!r}; expected a number of lines before the header, >= 0")
    wanted = set().union(*(_wanted_columns(one) for one in (rules, *also)))
    names, table, units, torn = _read_table(source, delimiter, skip, wanted)
    for section in (rules[key] for key in _SECTION_KEYS if key in rules):
        stated = units.get(_found_column(section, names) or "", section.get("unit"))
        if stated != section.get("unit") and any(stated in known for known in UNITS.values()):
            raise DataError(
                f"{source}: column {_found_column(section, names)!r} is in {stated} by the row below the header; "
                f"{origin} says {section.get('unit')!r}: write `unit: {stated}` in a mapping file"
            )
    first, last = _row_range(rules, len(table), origin)
    table = table[first:last]
    given = rules.get("meta") or {}
    if not isinstance(given, Mapping):
        raise DataError(f"{origin}: meta is {given!r}; expected names and values")
    meta = {"source": str(source), "mapping": origin, **given}
    if torn:
        meta["clock_notes"] = [f"the last line, {torn!r}, is not whole and is left out"]
    if first or last < len(table) + first:
        meta["rows"] = [first, last]
    by_topic = {} if also else _rows_by_topic(rules, names, table)
    if by_topic:
        table = by_topic.pop("position")
        meta["rows_by_topic"] = sorted(by_topic)
    elif rules.get("drop_nan") is True:
        known = np.isfinite(table[:, [name.casefold() in wanted for name in names]])
        whole = known[:, known.any(axis=0)].all(axis=1)
        meta["nan_rows"] = int(np.sum(~whole))
        table = table[whole]
    time, steps = continued(_time(rules["time"], names, table, source, origin, first))
    if steps:
        meta["clock_notes"] = [*meta.get("clock_notes", ()), *steps]

    def own_rows(key: str, quantity: str) -> tuple[Array | None, Array | None]:
        """Return a quantity and its stamps, if it has rows of its own."""
        rows = by_topic.get(key, table)
        column = _column(key, rules[key], quantity, names, rows, source, origin, first)
        if key not in by_topic or column is None:
            return column, None
        stamps, _ = continued(_time(rules["time"], names, rows, source, origin, first))
        kept = first_of_each_stamp(stamps)
        return column[kept], stamps[kept]

    position = _column("position", rules["position"], "angle", names, table, source, origin, first)
    assert position is not None
    velocity = None
    if "velocity" in rules:
        velocity, stamps = own_rows("velocity", "velocity")
        velocity = velocity if velocity is None or stamps is None else np.interp(time, stamps, velocity)
    drive, kind, between, stamps = np.zeros_like(time), "none", "linear", None
    if "input" in rules:
        section = rules["input"]
        quantity = _quantity_of(section.get("unit"), origin)
        column, stamps = own_rows("input", quantity)
        assert column is not None
        drive = _detrended(column, section.get("detrend"), origin)
        kind = {"effort": "effort", "voltage": "voltage", "angle": "position_goal"}[quantity]
        between = hold or str(section.get("hold", "linear" if kind == "effort" and stamps is None else "zero"))
        # Nobody said so of this file: a built-in mapping and a default are guesses.
        if hold is None and ("hold" not in section or origin.startswith("built-in")):
            meta["hold_assumed"] = True
    if jumps := two_motions(position):
        raise DataError(f"{source} holds two motions ({jumps}); expected those of one plant")
    _check_magnitudes(source, time, position)
    kept = first_of_each_stamp(time)
    if not kept.all():
        meta["repeated_stamps"] = int(np.sum(~kept))
        time, position = time[kept], position[kept]
        drive = drive[kept] if stamps is None else drive
        velocity = None if velocity is None else velocity[kept]
    return Recording(time, position, velocity, drive, input_kind=kind, hold=between, input_time=stamps, meta=meta)


def _rows_by_topic(rules: Mapping[str, Any], names: list[str], table: Array) -> dict[str, Array]:
    """Return the rows of position, and of velocity and input where these are in other rows; nothing where none is."""
    has = {key: _finite(rules[key], names, table) for key in ("time", "position", "velocity", "input") if key in rules}
    states = has["time"] & has["position"]
    own = {key: has["time"] & has[key] for key in ("velocity", "input") if key in has}
    # Topics that a logger writes apart may meet in some rows; holes leave most of them whole.
    apart = {key for key, rows in own.items() if 2 * np.sum(states & rows) < min(np.sum(states), np.sum(rows))}
    if not apart:
        return {}
    for key in own.keys() - apart:
        states &= own[key] if (states & own[key]).any() else True
    return {"position": table[states], **{key: table[own[key]] for key in apart}}


def _finite(section: Mapping[str, Any], names: list[str], table: Array) -> NDArray[np.bool_]:
    """Return which rows have a number in the column of a section; all where it names none that is there."""
    found = _found_column(section, names)
    return np.ones(len(table), bool) if found is None else np.isfinite(table[:, names.index(found)])


def _load_mapping(mapping: str | Path | Mapping[str, Any] | None) -> tuple[Mapping[str, Any], str]:
    if mapping is None:
        rules, origin = MAPPINGS["pendulum"], "built-in mapping 'pendulum'"
    elif isinstance(mapping, Mapping):
        rules, origin = mapping, "mapping"
    elif str(mapping) in MAPPINGS:
        rules, origin = MAPPINGS[str(mapping)], f"built-in mapping {str(mapping)!r}"
    else:
        if not Path(mapping).exists():
            raise DataError(f"mapping {mapping} is neither a file nor one of {', '.join(MAPPINGS)}")
        rules, origin = load_yaml(Path(mapping)), str(mapping)
        if rules.get("format") != FORMAT:
            raise DataError(f"{origin}: format is {rules.get('format')!r}; expected {FORMAT!r}")
    _reject_unknown(rules, _TOP_KEYS, origin)
    for name in ("time", "position"):
        if name not in rules:
            raise DataError(f"{origin} has no {name!r}; expected e.g. {name}: {{column: {name}, unit: ...}}")
    for name, keys in _SECTION_KEYS.items():
        if name in rules:
            if not isinstance(rules[name], Mapping):
                raise DataError(f"{origin}: {name} is {rules[name]!r}; expected {{column: ..., unit: ...}}")
            _reject_unknown(rules[name], keys, f"{origin}: {name}")
    return rules, origin


def _reject_unknown(given: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in given:
        if key not in known:
            raise DataError(f"{where} has an unknown key {key!r}; {suggestion(key, sorted(known))}")


def _detrended(values: Array, detrend: Any, origin: str) -> Array:
    if detrend is None:
        return values
    if detrend not in ("constant", "linear"):
        raise DataError(f"{origin}: detrend of input is {detrend!r}; expected constant or linear")
    return np.asarray(scipy.signal.detrend(values, type=detrend))


def _wanted_columns(rules: Mapping[str, Any]) -> set[str]:
    """Return the columns that a mapping may take, in small letters: what stands in others is not its business."""
    columns: list[Any] = []
    for key in _SECTION_KEYS:
        section = rules.get(key)
        named = section.get("column") if isinstance(section, Mapping) else None
        columns += named if isinstance(named, (list, tuple)) else [named]
    return {column.casefold() for column in columns if isinstance(column, str)}


def _read_table(
    source: Path, delimiter: str, skip: int, wanted: set[str]
) -> tuple[list[str], Array, dict[str, str], str]:
    """Return names and numbers of all columns, their units by a row of units, and a last line that was torn off.

    Words in columns that are not wanted are NaN.
    """
    try:
        text = source.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{source} is no text in UTF-8 ({error.reason} at byte {error.start}); expected such: of one that Excel or "
            "LabVIEW wrote, `iconv -f WINDOWS-1252 -t UTF-8 FILE` makes it"
        ) from error
    except OSError as error:
        raise DataError(f"{source} cannot be read as text: {error}") from error
    lines = text.split("\n", skip)
    if len(lines) <= skip:
        raise DataError(f"{source} has {len(lines)} lines; expected a header after the {skip} lines to skip")
    head, body, line = _head_and_body(lines[skip], wanted)
    delimiter = delimiter or max(_DELIMITERS, key=head.count)
    try:
        cells = next(csv.reader([head.lstrip("# ").strip()], delimiter=delimiter), [])
    except (csv.Error, TypeError) as error:
        raise DataError(f"{source} begins with a line that is no CSV: {error}") from error
    names = [name.strip() for name in cells]
    others = [mark for mark in _DELIMITERS if mark != delimiter and mark in head]
    others += [" "] * (" " in head.strip("# ") and len(body.lstrip().split("\n", 1)[0].split()) > 1)
    if len(names) == 1 and others:
        raise DataError(
            f"{source} has one column, {names[0][:60]!r}, between {delimiter!r}; expected several: a mapping file with "
            f"`delimiter: {others[0]!r}` reads it otherwise"
        )
    if not names or all(_is_number(name) for name in names):
        later = any(re.search("[A-Za-z]{2}", row) for row in body.splitlines())
        way = "a mapping file with `skip: N` leaves out N lines before it" if later else "it has none: write one above"
        raise DataError(
            f"{source} begins with {head[:60]!r}; expected a first line with the names of the columns ({way})"
        )
    if not body.strip():
        raise DataError(f"{source} has no rows below its header")
    if delimiter != "," and _DECIMAL_COMMA.search(body) and not _DECIMAL_POINT.search(body):
        body = body.replace(",", ".")
    used = [index for index, name in enumerate(names) if name.casefold() in wanted]
    units: dict[str, str] = {}
    row, _, rest = body.partition("\n")
    cells = next(csv.reader([row], delimiter=delimiter), [])
    if rest.strip() and len(cells) == len(names) and not any(_is_number(cell or "0") for cell in cells):
        units = {name: cell.strip(" []()") for name, cell in zip(names, cells, strict=True)}
        body, line = rest, line + 1
    start = body.rstrip().rfind("\n") + 1
    torn = body[start:].strip()
    cells = next(csv.reader([torn], delimiter=delimiter), [])
    whole = len(cells) >= len(names) and (body.endswith("\n") or _is_number(cells[-1].strip() or "0"))
    body, torn = (body, "") if whole or not start or torn.startswith("#") else (body[:start], torn)
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=delimiter, ndmin=2)
    except ValueError as error:
        if bad := _first_bad_cell(body, names, delimiter, skip + line, used):
            raise DataError(f"{source}: {bad}") from error
        rows = [row for row in csv.reader(io.StringIO(body), delimiter=delimiter) if _is_row(row)]
        table = np.full((len(rows), len(names)), np.nan)
        table[:, used] = [[float(row[index].strip() or "nan") for index in used] for row in rows]
    if table.size == 0:
        raise DataError(f"{source} has no rows below its header")
    if table.shape[1] != len(names):
        halves = delimiter == "," and table.shape[1] == 2 * len(names) and not _DECIMAL_POINT.search(body)
        hint = "; decimal commas cannot be told from those between columns: write points, or `;` between columns"
        raise DataError(
            f"{source} has {table.shape[1]} columns of numbers but {len(names)} names in its header{hint * halves}"
        )
    return names, table, units, torn


def _head_and_body(text: str, wanted: Collection[str]) -> tuple[str, str, int]:
    """Return the line that names the columns, what is below it, and the number of lines before it.

    Lines that begin with ``#`` are comments; where numbers follow, the last of them that names a wanted column is the
    header, else the last: one of units may stand below.
    """
    lines = text.split("\n")
    first = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    comments = [i for i in range(first) if lines[i].strip()]
    if comments and (first == len(lines) or _is_number(re.split(r"[,;\t ]", lines[first].strip())[0] or "0")):
        named = [i for i in comments if {c.strip("# \r").casefold() for c in re.split(r"[,;\t]", lines[i])} & {*wanted}]
        first = named[-1] if named else comments[-1]
    head = min(first, len(lines) - 1)
    return lines[head], "\n".join(lines[head + 1 :]), head


def _is_row(row: Sequence[str]) -> bool:
    return bool(row) and not row[0].startswith("#")


def _first_bad_cell(body: str, names: list[str], delimiter: str, skip: int, used: Sequence[int]) -> str | None:
    for number, line in enumerate(io.StringIO(body), start=2 + skip):
        try:
            row = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error as error:
            return f"line {number} is no CSV: {error}"
        if not _is_row(row):
            continue
        if len(row) != len(names):
            way = "; `skip: N` in a mapping file leaves out N lines before the names of the columns" if not used else ""
            return f"line {number} has {len(row)} cells; expected {len(names)} ({', '.join(names)}){way}"
        for index in used:
            if row[index].strip() and not _is_number(row[index]):
                return f"line {number}, column {names[index]!r} holds {row[index].strip()!r}; expected a number"
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row_range(rules: Mapping[str, Any], count: int, origin: str) -> tuple[int, int]:
    rows = rules.get("rows", [0, count])
    valid = isinstance(rows, (list, tuple)) and len(rows) == 2 and all(type(r) is int for r in rows)
    if not valid or not 0 <= rows[0] < min(rows[1], count):
        raise DataError(f"{origin}: rows is {rows!r}; expected [first, stop] within the {count} rows of the file")
    return int(rows[0]), min(int(rows[1]), count)


def _factor(name: str, section: Mapping[str, Any], quantity: str, origin: str) -> float:
    unit = section.get("unit")
    if not isinstance(unit, str) or unit not in UNITS[quantity]:
        raise DataError(f"{origin}: unit of {name} is {unit!r}; expected one of {', '.join(UNITS[quantity])}")
    return UNITS[quantity][unit]


def _quantity_of(unit: Any, origin: str) -> str:
    for quantity in ("effort", "voltage", "angle"):
        if isinstance(unit, str) and unit in UNITS[quantity]:
            return quantity
    expected = ", ".join(u for quantity in ("effort", "voltage", "angle") for u in UNITS[quantity])
    raise DataError(f"{origin}: unit of input is {unit!r}; expected one of {expected}")


def _column(
    name: str,
    section: Mapping[str, Any],
    quantity: str,
    names: list[str],
    table: Array,
    source: Path,
    origin: str,
    first_row: int,
) -> Array | None:
    candidates = _candidates(section)
    if not all(isinstance(candidate, str) for candidate in candidates):
        raise DataError(f"{origin}: column of {name} is {section['column']!r}; expected a name or a list of names")
    found = _found_column(section, names)
    if found is None:
        if section.get("optional"):
            return None
        raise DataError(
            f"{source} has no column {' or '.join(map(repr, candidates)) or '(none given)'} for {name} "
            f"(asked for by {origin}); it has {', '.join(names)}"
            + ("; `--mapping FILE` names yours" if origin.startswith("built-in") else "")
            + ("; `--mapping free_swing` reads a pendulum that nothing drives" if name == "input" else "")
        )
    factor = _factor(name, section, quantity, origin)
    sign = section.get("sign", 1)
    if sign not in (1, -1):
        raise DataError(f"{origin}: sign of {name} is {sign!r}; expected 1 or -1")
    raw = table[:, names.index(found)]
    if raw.size and np.isnan(raw).all():
        if section.get("optional"):
            return None
        free = name == "input" and origin.startswith("built-in")
        way = "`--mapping free_swing` reads a pendulum that nothing drives" if free else "name another one"
        raise DataError(f"{source}: column {found!r} holds no number at all; expected those of {name}: {way}")
    bad = np.flatnonzero(~np.isfinite(raw))
    if bad.size:
        raise DataError(
            f"{source}: column {found!r} is {raw[bad[0]]} in row {bad[0] + first_row} ({bad.size} such rows); "
            "expected finite numbers: `drop_nan: true` in the mapping file leaves such rows out"
        )
    return np.asarray(sign * (raw + _number("offset", section, name, origin)) * factor)


def _candidates(section: Mapping[str, Any]) -> Sequence[Any]:
    wanted = section.get("column")
    return wanted if isinstance(wanted, (list, tuple)) else [wanted] if wanted else []


def _found_column(section: Mapping[str, Any], names: list[str]) -> str | None:
    """Return the first column of a table that a section names."""
    candidates = _candidates(section)
    found = next((column for column in candidates if column in names), None)
    if found is None:
        # Capital letters are no other quantity, as long as only one column can be meant.
        wanted_names = {str(candidate).casefold() for candidate in candidates}
        alike = [column for column in names if column.casefold() in wanted_names]
        found = alike[0] if len(alike) == 1 else None
    return found


def _time(
    section: Mapping[str, Any], names: list[str], table: Array, source: Path, origin: str, first_row: int
) -> Array:
    if "period" in section:
        period = _number("period", section, "time", origin) * _factor("time", section, "time", origin)
        if not (math.isfinite(period) and period > 0.0):
            raise DataError(f"{origin}: period of time is {section['period']!r}; expected > 0")
        return (np.arange(len(table)) + first_row) * period
    column = _column("time", section, "time", names, table, source, origin, first_row)
    assert column is not None
    return column - _number("start", section, "time", origin)


def _number(key: str, section: Mapping[str, Any], name: str, origin: str) -> float:
    value = section.get(key, 0.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise DataError(f"{origin}: {key} of {name} is {value!r}; expected a finite number")
    return float(value)


def _check_magnitudes(source: Path, time: Array, position: Array) -> None:
    """Refuse time stamps and angles that can hardly be in the unit that the mapping claims."""
    if time.size > 1:
        step = float(np.median(np.abs(np.diff(time))))
        if step >= 1.0:
            raise DataError(
                f"{source}: the median time step is {step:.3g} s; expected < 1 s: is the unit ms, us or ns?"
            )
    if time.size > 10 and np.max(np.abs(np.diff(position))) > 25.0:
        largest = float(np.max(np.abs(np.diff(position))))
        raise DataError(
            f"{source}: the angle jumps by {largest:.3g} rad between samples; expected rad: is the unit deg?"
        )
