"""A recording as named columns, whatever its format; a column is read when it is asked for."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = ["Column", "Columns", "columns_of_array", "grouped_parts", "need", "part_of"]

_PART = re.compile(r"^(.+)#(\d+)$")
_MOST_COLUMNS = 64
"""Columns of one array of two dimensions; what has more on both sides is no recording."""


@dataclass(frozen=True)
class Column:
    """One quantity of a recording.

    Attributes:
        name: Where it is in the file: the name of a column, or a path such as ``data.theta.values``.
        size: Number of values.
        read: Returns the values of some rows as the file stores them, shape (rows,).
        clock: Name of the column with its stamps, where the file says which; empty otherwise.
        unit: As the file gives it; empty otherwise.
        by_rows: Whether some rows are read in less time and memory than all.
    """

    name: str
    size: int
    read: Callable[[slice], NDArray[Any]]
    clock: str = ""
    unit: str = ""
    by_rows: bool = False


@dataclass
class Columns:
    """A recording: ``columns`` by name, in the order of the file, and ``notes`` of reading it, one sentence each.

    Attributes:
        kind: Its format, for messages.
        period: Sampling period that the file states [s].
        is_table: Whether the values in one row were measured together.
        named: Whether the columns have names that an author gave.
    """

    path: Path
    kind: str
    columns: Mapping[str, Column]
    notes: list[str] = field(default_factory=list)
    period: float | None = None
    is_table: bool = False
    named: bool = True
    meta: Mapping[str, Any] = field(default_factory=dict)
    _values: dict[str, Array] = field(default_factory=dict)

    def values(self, name: str) -> Array:
        """Return a column as floating-point numbers, shape (size,)."""
        if name not in self._values:
            # Not one operation in the type of the file: MATLAB stores 200.0 in eight bits, and 3 * 200 is 88 there.
            self._values[name] = np.ascontiguousarray(self.columns[name].read(slice(None)), dtype=float).reshape(-1)
        return self._values[name]

    def forget(self, name: str = "") -> None:
        """Release the memory of a column, or of all; they are read again when they are asked for."""
        if name:
            self._values.pop(name, None)
        else:
            self._values.clear()

    def stretch(self, rows: int) -> Columns:
        """Return the middle of a long recording: so many rows of its longest column, the others in proportion."""
        share = rows / max(column.size for column in self.columns.values())
        if share >= 1.0:
            return self

        def middle(column: Column) -> Column:
            count = math.ceil(share * column.size)
            first = (column.size - count) // 2

            def read(wanted: slice) -> NDArray[Any]:
                whole = slice(first, first + count)
                return (column.read(whole) if column.by_rows else self.values(column.name)[whole])[wanted]

            return replace(column, size=count, read=read)

        return replace(self, columns={name: middle(column) for name, column in self.columns.items()}, _values={})

    def find(self, candidates: Iterable[str]) -> str | None:
        """Return the first column of some names; capital letters do not matter where only one can be meant."""
        wanted = [str(one) for one in candidates]
        found = next((one for one in wanted if one in self.columns), None)
        if found is None:
            folded = {one.casefold() for one in wanted}
            alike = [name for name in self.columns if name.casefold() in folded]
            found = alike[0] if len(alike) == 1 else None
        return found


def part_of(path: str | Path) -> tuple[Path, int]:
    """Return a path without the ``#N`` behind it that chooses a part, and the part, 0 for none."""
    source = Path(path)
    found = _PART.match(source.name)
    if found is None or source.exists():
        return source, 0
    return source.with_name(found[1]), int(found[2])


def columns_of_array(
    name: str, shape: Sequence[int], read: Callable[[tuple[int | slice, ...]], Any], *, by_rows: bool = False
) -> list[Column]:
    """Return an array of one or two dimensions as columns; the longer side is time, sides of length 1 do not count.

    ``read`` returns what an index of NumPy chooses; without ``by_rows`` it reads the whole array each time.
    """
    sides = [axis for axis, size in enumerate(shape) if size != 1]
    if len(sides) not in {1, 2}:
        return []
    time = sides[0] if shape[sides[0]] > shape[sides[-1]] else sides[-1]
    count = shape[sum(sides) - time] if len(sides) == 2 else 1
    if count > _MOST_COLUMNS:
        return []

    def column(entry: int, rows: slice) -> NDArray[Any]:
        key = (rows if axis == time else entry if axis in sides else 0 for axis in range(len(shape)))
        return np.asarray(read(tuple(key))).reshape(-1)

    return [
        Column(f"{name}[{entry}]" if len(sides) == 2 else name, shape[time], partial(column, entry), by_rows=by_rows)
        for entry in range(count)
    ]


def grouped_parts(
    arrays: Mapping[str, Sequence[Sequence[Column]]],
) -> list[tuple[str, list[Column]]]:
    """Return the recordings of a file whose arrays are lists (name -> columns of each entry), an entry a recording.

    Lists belong together where they have as many entries, of the same lengths.
    """
    groups: dict[tuple[int, ...], list[str]] = {}
    for name, entries in arrays.items():
        lengths = tuple(max((column.size for column in entry), default=0) for entry in entries)
        groups.setdefault(lengths, []).append(name)
    parts = []
    for lengths, names in groups.items():
        for index in range(len(lengths)):
            what = ", ".join(f"{name}{{{index + 1}}}" for name in names)
            parts.append((what, [column for name in names for column in arrays[name][index]]))
    return parts


def need(error: ImportError, what: str) -> DataError:
    """Return the error of a file (``what``) whose library is missing."""
    reason = how_to_install(error) or f"{error.name or 'a library'} cannot be imported: {str(error).splitlines()[0]}"
    return DataError(f"{what} cannot be read: {reason}")
