"""Parquet files and LeRobot datasets as columns; only what is asked for is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.recordings.columns import Column, Columns, need
from pendulum_msgs_py.errors import DataError

__all__ = ["is_lerobot", "read_lerobot", "read_parquet"]

Pieces = Callable[[slice], Iterator[tuple[int, Any]]]
"""Returns pieces of a column, each with the number of its first row."""

_INFO = Path("meta", "info.json")
_MOST_ENTRIES = 256
_BATCH = 1 << 17
"""Rows that are decoded at once."""
_BOOKKEEPING = frozenset({"frame_index", "episode_index", "index", "task_index", "timestamp"})


def is_lerobot(folder: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (folder / _INFO).is_file()


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file, one for each entry of lists and structs; a DataError if that fails."""
    parquet = _pyarrow(path, "parquet")
    try:
        file = parquet.ParquetFile(path)
    except Exception as error:
        raise DataError(f"{path} is no Parquet file: {str(error).splitlines()[0]}") from error

    def read(name: str, rows: slice) -> Iterator[tuple[int, Any]]:
        start, stop, _ = rows.indices(count)
        first = 0
        for group in range(file.num_row_groups):
            size = file.metadata.row_group(group).num_rows
            if first < stop and start < first + size:
                for batch in file.iter_batches(_BATCH, row_groups=[group], columns=[name]):
                    yield first, batch.column(0)
                    first += batch.num_rows
            else:
                first += size

    count = file.metadata.num_rows
    columns = {
        column.name: column
        for entry in file.schema_arrow
        for column in _arrow_columns(entry.name, entry.type, count, partial(read, entry.name))
    }
    return Columns(path, "Parquet file", columns, is_table=True)


def read_lerobot(folder: Path, part: int = 0) -> Columns:
    """Return an episode of a LeRobot dataset of version 2 or 3, by its number from 1; 0 is the first, too.

    A DataError if it is damaged, has no such episode, or pyarrow is missing.
    """
    arrow = _pyarrow(folder, "dataset")
    try:
        info = json.loads((folder / _INFO).read_text(encoding="utf-8"))
        episodes, rate = int(info["total_episodes"]), float(info["fps"])
        features: Mapping[str, Mapping[str, Any]] = info["features"]
        data = arrow.dataset(sorted(map(str, (folder / "data").rglob("*.parquet"))), format="parquet")
        if not 0 <= part <= episodes:
            raise DataError(f"{folder}#{part}: episode is {part}; expected 1 to {episodes}")
        chosen = arrow.field("episode_index") == max(part - 1, 0)
        count = data.count_rows(filter=chosen)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{folder} is no LeRobot dataset that can be read: {type(error).__name__}: {error}") from error

    def read(name: str, _: slice) -> Iterator[tuple[int, Any]]:
        first = 0
        # Without these two pyarrow reads 16 batches of 4 files ahead.
        ahead = {"batch_readahead": 1, "fragment_readahead": 1}
        for batch in data.to_batches(columns={name: arrow.field(name)}, filter=chosen, **ahead):
            yield first, batch.column(0)
            first += batch.num_rows

    columns = {}
    for entry in data.schema:
        if entry.name in _BOOKKEEPING:
            continue
        labels = list(_labels((features.get(entry.name) or {}).get("names")))
        for index, column in enumerate(_arrow_columns(entry.name, entry.type, count, partial(read, entry.name))):
            name = f"{entry.name}.{labels[index]}" if index < len(labels) else column.name
            columns[name] = replace(column, name=name)
    notes = [f"episode 1 of {episodes} is read; {folder.name}#2 is the next"] if episodes > 1 and not part else []
    # Stamps are stored in 32 bits; the frames of an episode are equally spaced.
    return Columns(folder, "LeRobot dataset", columns, notes, 1.0 / rate, is_table=True)


def _labels(names: Any) -> Iterator[str]:
    """Yield the names of a vector's entries, which version 2 may nest under a heading."""
    if isinstance(names, Mapping):
        for value in names.values():
            yield from _labels(value)
    elif isinstance(names, Sequence) and not isinstance(names, str):
        yield from map(str, names)


def _arrow_columns(name: str, kind: Any, count: int, read: Pieces) -> Iterator[Column]:
    """Yield a column of Arrow's as columns of numbers; ``read`` yields the pieces that hold some rows."""
    import pyarrow as pa

    if pa.types.is_struct(kind):
        for index in range(kind.num_fields):
            entry = kind.field(index)
            yield from _arrow_columns(f"{name}.{entry.name}", entry.type, count, partial(_field, read, index))
    elif pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        if count and _is_number(kind.value_type):
            first = next(piece[0].as_py() for _, piece in read(slice(0, 1)) if len(piece)) or ()
            for index in range(min(kind.list_size if pa.types.is_fixed_size_list(kind) else len(first), _MOST_ENTRIES)):
                entries = partial(_numbers, count, read, partial(_entry, index=index))
                yield Column(f"{name}[{index}]", count, entries, by_rows=True)
    elif _is_number(kind) or pa.types.is_timestamp(kind):
        yield Column(name, count, partial(_numbers, count, read, None), unit=_unit(kind), by_rows=True)


def _numbers(count: int, read: Pieces, part: Callable[[Any], Any] | None, rows: slice) -> NDArray[Any]:
    """Return some rows as numbers, piece by piece: the table of Arrow, several times as large, is never in memory."""
    import pyarrow as pa

    start, stop, _ = rows.indices(count)
    values = np.full(stop - start, np.nan)
    for first, piece in read(rows):
        numbers = part(piece) if part else piece
        if pa.types.is_timestamp(numbers.type):
            numbers = numbers.cast(pa.int64())
        begin, end = max(start, first), min(stop, first + len(piece))
        if begin < end:
            found = numbers.cast(pa.float64()).to_numpy(zero_copy_only=False)
            values[begin - start : end - start] = found[begin - first : end - first]
    return values


def _entry(lists: Any, index: int) -> Any:
    """Return one entry of each list, null where a list is shorter."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_fixed_size_list(lists.type):
        return pc.list_element(lists, index)
    long = pc.fill_null(pc.greater(pc.list_value_length(lists), index), False)
    return pc.list_element(pc.if_else(long, lists, pa.scalar([None] * (index + 1), lists.type)), index)


def _field(read: Pieces, index: int, rows: slice) -> Iterator[tuple[int, Any]]:
    import pyarrow.compute as pc

    for first, piece in read(rows):
        yield first, pc.struct_field(piece, [index])


def _is_number(kind: Any) -> bool:
    import pyarrow as pa

    return bool(
        pa.types.is_floating(kind)
        or pa.types.is_integer(kind)
        or pa.types.is_boolean(kind)
        or pa.types.is_decimal(kind)
    )


def _unit(kind: Any) -> str:
    import pyarrow as pa

    return str(kind.unit) if pa.types.is_timestamp(kind) else ""


def _pyarrow(path: Path, module: str) -> Any:
    try:
        import pyarrow.dataset
        import pyarrow.parquet
    except ImportError as error:
        raise need(error, str(path)) from error
    return getattr(pyarrow, module)
