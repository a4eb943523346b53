"""Text files of columns: any delimiter, decimal commas, lines above the names, no names, holes, a torn last line."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.columns import Column, Columns
from pendulum_bags.recordings.units import known_unit
from pendulum_msgs_py.errors import DataError

__all__ = ["read_delimited"]

_DELIMITERS = (",", ";", "\t", " ")
_DECIMAL_COMMA, _DECIMAL_POINT = re.compile(r"\d,\d"), re.compile(r"(?<![\d.])\d+\.\d+(?![\d.])")
"""A date such as 27.11.2026 has no decimal point."""
_HOLES = frozenset({"", "na", "n/a", "nan", "null", "none", "-"})
_TRUTH = {"true": 1.0, "false": 0.0}
_MOST_LINES_ABOVE = 400
_SEEN = 50
"""Rows by which a column of words is recognised."""
_UNIT_IN_NAME = re.compile(r"[\[(]([^\[\]()]*)[\])]\s*$")
_UNIT_IN_COMMENT = re.compile(r"^[#%]\s*([^:]+?)\s*:\s*(\S.*?)\s*$")


@dataclass(frozen=True)
class _Layout:
    """Where the rows begin (index ``first`` among the lines), their cells, and the names and units above them."""

    delimiter: str
    first: int
    names: Sequence[str]
    units: Mapping[str, str]
    cells: int


def read_delimited(path: Path, *, delimiter: str = "", skip: int = 0) -> Columns:
    """Return the columns of a text file; the delimiter is by default the one by which most cells are numbers.

    A DataError if it is no text, has no row of numbers, or a row of another length.
    """
    text, notes = _text_of(path)
    lines = text.split("\n")
    if skip >= len(lines):
        raise DataError(f"{path} has {len(lines)} lines; expected a header after the {skip} lines to skip")
    layout = _layout(path, lines, delimiter, skip)
    names = list(layout.names) or [f"column{index}" for index in range(layout.cells)]
    last = len(lines)
    while last and not lines[last - 1].strip():
        last -= 1
    torn = lines[last - 1].strip()
    cells = _cells(torn, layout.delimiter)
    is_whole = len(cells) >= len(names) and (last < len(lines) or _value(cells[len(names) - 1]) is not None)
    if not (is_whole or last - 1 <= layout.first or torn.startswith("#")):
        notes.append(f"the last line, {torn!r}, is not whole and is left out")
        last -= 1
    table = _Table(path, names, layout, lines[layout.first : last])
    words = table.columns_of_words()
    columns = {
        name: Column(
            name, len(table.lines), partial(table.column, index), by_rows=True, unit=layout.units.get(name, "")
        )
        for index, name in enumerate(names)
        if index not in words
    }
    return Columns(path, "CSV file", columns, notes, is_table=True, named=bool(layout.names))


def _text_of(path: Path) -> tuple[str, list[str]]:
    """Return the text of a file, and what was assumed to read it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read as text: {error.strerror or error}") from error
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace"), []
    if b"\0" in data[:4096]:
        raise DataError(f"{path} has bytes that are 0; expected a text of columns")
    try:
        return data.decode("utf-8-sig"), []
    except UnicodeDecodeError as error:
        note = f"byte {error.start} is not UTF-8: the text is read as WINDOWS-1252, which Excel and LabVIEW write"
        return data.decode("cp1252", errors="replace"), [note]


def _cells(line: str, delimiter: str) -> list[str]:
    line = line.strip("\r\n")
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error:
        return []


def _value(cell: str) -> float | None:
    """Return the number in a cell, NaN for a hole; None for a word."""
    try:
        return float(cell)
    except ValueError:
        word = cell.strip().casefold()
        return float("nan") if word in _HOLES else _TRUTH.get(word)


def _is_number(cell: str, delimiter: str) -> bool:
    # A hole is no number: by it alone no row is recognised.
    value = _value(cell if delimiter == "," else cell.replace(",", "."))
    return value is not None and cell.strip().casefold() not in _HOLES


def _layout(path: Path, lines: Sequence[str], delimiter: str, skip: int) -> _Layout:
    best: tuple[tuple[float, int, int], str, int] | None = None
    for mark in [delimiter] if delimiter else _DELIMITERS:
        first = _first_row(lines, mark, skip)
        if first is not None:
            cells = _cells(lines[first], mark)
            share = sum(_is_number(cell, mark) or not cell for cell in cells) / len(cells)
            score = (round(share, 2), -first, len(cells))
            best = max(best, (score, mark, first)) if best else (score, mark, first)
    if best is None:
        head = next((line for line in lines[skip:] if line.strip()), "").strip()
        beyond = "" if delimiter == "" else f" between {delimiter!r}"
        if sum(bool(line.strip()) for line in lines[skip:]) == 1:
            raise DataError(f"{path} has no rows below its header, {head[:60]!r}; expected rows of numbers")
        raise DataError(f"{path} begins with {head[:60]!r} and has no row of numbers{beyond}; expected columns of them")
    _, mark, first = best
    count = len(_cells(lines[first], mark))
    above = [
        (index, cells)
        for index in range(first - 1, skip - 1, -1)
        if (cells := _cells(lines[index].strip().lstrip("#%").strip(), mark))
        and len(cells) in {count, count - 1}
        and not any(_is_number(cell, mark) for cell in cells)
        and sum(map(bool, cells)) * 2 >= len(cells)
    ]
    names: list[str] = []
    units: dict[str, str] = {}
    if above:
        row, names = above[0][0], above[0][1]
        if len(above) > 1 and sum(bool(known_unit(cell)) for cell in names) * 2 > len(names):
            units = dict(zip(above[1][1], (known_unit(cell) for cell in names), strict=False))
            row, names = above[1]
        units |= _units_above(lines[skip:row], names)
    names = list(names)
    if names and len(names) < count:
        if _cells(lines[first], mark)[-1]:
            halves = mark == "," and not _DECIMAL_POINT.search(lines[first])
            raise DataError(_other_count(path, count, len(names), halves=halves))
        count = len(names)  # each row ends with a delimiter
    elif not names and mark == "," and count % 2 == 0 and first > skip:
        # A title of half as many names, above decimal commas between commas.
        title = _cells(lines[first - 1].strip().lstrip("#"), mark)
        if 2 * len(title) == count and not any(_is_number(cell, mark) for cell in title):
            raise DataError(_other_count(path, count, len(title), halves=True))
    for name in names:
        inside = _UNIT_IN_NAME.search(name)
        if name not in units and inside and known_unit(inside[1]):
            units[name] = known_unit(inside[1])
    twice = next((name for index, name in enumerate(names) if name in names[:index]), None)
    if twice is not None:
        raise DataError(f"{path} has two columns {twice!r}; expected each name once")
    return _Layout(mark, first, names, units, count)


def _other_count(path: Path, count: int, names: int, *, halves: bool) -> str:
    hint = "; decimal commas cannot be told from those between columns: write points, or `;` between columns"
    return f"{path} has {count} columns of numbers but {names} names in its header{hint * halves}"


def _first_row(lines: Sequence[str], mark: str, skip: int) -> int | None:
    """Return the first line that, as the one below it, has numbers in as many cells."""
    for index in range(skip, min(len(lines), skip + _MOST_LINES_ABOVE)):
        count = _row_cells(lines[index], mark)
        below = next((line for line in lines[index + 1 : index + 3] if line.strip()), None)
        if count and (below is None or _row_cells(below, mark) == count or below.startswith("#")):
            return index
        above = next((line for line in lines[max(skip, index - 1) : index] if line.strip()), "")
        names = _cells(above.strip().lstrip("#%").strip(), mark)
        if count and len(names) == count and not any(_is_number(name, mark) for name in names):
            return index  # the row below is the one that is torn
    return None


def _row_cells(line: str, mark: str) -> int:
    """Return the number of cells of a row; 0 for a line that is none."""
    if line.lstrip().startswith(("#", "%")):
        return 0
    cells = _cells(line, mark)
    numbers = sum(_is_number(cell, mark) for cell in cells)
    holes = sum(not cell for cell in cells)
    return len(cells) if numbers and 2 * (numbers + holes) >= len(cells) else 0


def _units_above(lines: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the units that comments state as ``# name: unit``."""
    found = {}
    for line in lines:
        stated = _UNIT_IN_COMMENT.match(line.strip())
        if stated and stated[1] in names and known_unit(stated[2]):
            found[stated[1]] = known_unit(stated[2])
    return found


class _Table:
    """The rows of a text file, read when a column is asked for."""

    def __init__(self, path: Path, names: Sequence[str], layout: _Layout, lines: Sequence[str]) -> None:
        self._path, self._names, self._mark = path, names, layout.delimiter
        self._above = layout.first + 1
        text = "\n".join(lines)
        if self._mark != "," and _DECIMAL_COMMA.search(text) and not _DECIMAL_POINT.search(text):
            text = text.replace(",", ".")
        self.lines = [line for line in text.split("\n") if line.strip() and not line.startswith("#")]
        self._text = text
        self._table: Array | None = None
        self._bad: dict[int, str] = {}

    def columns_of_words(self) -> set[int]:
        """Return the columns that have words, and no number, in all of the first rows."""
        rows = [_cells(line, self._mark) for line in self.lines[:_SEEN]]
        found = set()
        for index in range(len(self._names)):
            cells = [row[index] for row in rows if index < len(row) and row[index]]
            if cells and all(_value(cell) is None for cell in cells):
                found.add(index)
        return found

    def column(self, index: int, rows: slice) -> Array:
        if self._table is None:
            self._table = self._read()
        if index in self._bad:
            raise DataError(f"{self._path}: {self._bad[index]}")
        return self._table[rows, index]

    def _read(self) -> Array:
        delimiter = None if self._mark == " " else self._mark
        try:
            table = np.loadtxt(io.StringIO(self._text), delimiter=delimiter, ndmin=2)
            if table.shape[1] == len(self._names):
                return table
        except ValueError:
            pass  # words, holes or rows of another length
        table = np.full((len(self.lines), len(self._names)), np.nan)
        count = 0
        for number, row in self._rows():
            if len(row) < len(self._names) or any(row[len(self._names) :]):
                raise DataError(
                    f"{self._path}: line {number} has {len(row)} cells; expected {len(self._names)} "
                    f"({', '.join(self._names)})"
                )
            for index, cell in enumerate(row[: len(self._names)]):
                value = _value(cell)
                if value is None:
                    sentence = f"line {number}, column {self._names[index]!r} holds {cell!r}; expected a number"
                    self._bad.setdefault(index, sentence)
                else:
                    table[count, index] = value
            count += 1
        return table[:count]

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        for number, line in enumerate(self._text.split("\n"), start=self._above):
            if line.strip() and not line.startswith("#"):
                yield number, _cells(line, self._mark)
