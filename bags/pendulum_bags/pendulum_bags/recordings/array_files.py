"""Files of arrays: NumPy's, and MATLAB's of versions 5 and 7.3 with structs, cells, timeseries, tables and datasets.

Names are paths as one would write them in MATLAB: ``data.theta.values``; ``x[0]`` is a row or column of an array of two
dimensions. A cell or an array of structs with one entry for each run is one recording for each entry.
"""

from __future__ import annotations

import math
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.recordings.columns import Column, Columns, columns_of_array, grouped_parts, need
from pendulum_msgs_py.errors import DataError

__all__ = ["read_matlab", "read_numpy"]

_PERIODS = frozenset({"dt", "ts", "delta_t", "sampletime", "sample_time", "samplingtime", "period", "tsample"})
"""Names of a single number that is a sampling period."""
_RATES = frozenset({"fs", "rate", "sample_rate", "samplerate", "fps", "frequency"})
_DEEPEST = 6
_NUMBERS = frozenset(
    {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
)
"""Classes of MATLAB that are numbers."""
_OPAQUE = "objects of MATLAB, which the library mat-io reads (CPython 3.11 to 3.13: python -m pip install mat-io)"
_HOW = (
    "or make structs of them in MATLAB: theta = struct('time', theta.Time, 'data', theta.Data) of a timeseries, "
    "T = table2struct(T, 'ToScalar', true) of a table; then save('run.mat', 'theta', 'T')"
)
_SECONDS = {"nanoseconds": 1e-9, "microseconds": 1e-6, "milliseconds": 1e-3, "minutes": 60.0, "hours": 3600.0}
"""Units of the time of a timeseries, other than seconds [s]."""


def read_numpy(path: Path, part: int = 0) -> Columns:
    """Return the arrays of an ``.npz`` or ``.npy`` file, or of all ``.npy`` files of a folder, as columns.

    Arrays in files of their own beside the named one belong to it if they are as long. A DataError if there is none.
    """
    files = {path: ""} if path.suffix == ".npz" else {}
    if not files:
        folder = path if path.is_dir() else path.parent
        files = {path: path.stem} if path.is_file() else {}
        files |= {file: file.stem for file in sorted(folder.glob("*.npy")) if file != path}
    found: list[Column] = []
    numbers: dict[str, float] = {}
    for file, stem in files.items():
        try:
            if stem:
                array = np.load(file, mmap_mode="r", allow_pickle=False)
                _take(stem, array.shape, array.dtype, array.__getitem__, found, numbers, by_rows=True)
                continue
            for name, shape, kind in _members(file):
                load = partial(_read_member, file, name)
                _take(name, shape, kind, _shared(load) if len(shape) > 1 or kind.names else load, found, numbers)
        except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
            if file == path or path.is_dir():
                raise DataError(f"{file} cannot be read as arrays: {str(error).splitlines()[0]}") from error
    if path.suffix == ".npy" and path.is_file():
        own = {column.size for column in found if column.name.partition("[")[0] == path.stem}
        found = [column for column in found if column.size in own]
    return _columns(path, "file of arrays", found, numbers, {}, part, named=path.suffix == ".npz")


def _members(path: Path) -> Iterator[tuple[str, tuple[int, ...], np.dtype[Any]]]:
    """Yield name, shape and type of each array of an ``.npz`` file, by its header alone."""
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with zipfile.ZipFile(path) as archive:
        for place in archive.namelist():
            with archive.open(place) as member:
                header = headers.get(np.lib.format.read_magic(member))
                if header is not None:  # version 3.0 is for names of fields beyond Latin-1
                    shape, _, kind = header(member)
                    yield place.removesuffix(".npy"), shape, kind


def _read_member(path: Path, name: str, key: Any) -> Any:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return arrays[name][key]
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: array {name!r} cannot be read: {str(error).splitlines()[0]}") from error


def _take(
    name: str,
    shape: tuple[int, ...],
    kind: np.dtype[Any],
    read: Callable[[Any], Any],
    found: list[Column],
    numbers: dict[str, float],
    *,
    by_rows: bool = False,
) -> None:
    for field in kind.names or ():
        part = kind[field]

        def read_field(key: Any, field: str = field) -> Any:
            return read(...)[field][key]

        _take(f"{name}.{field}", shape + part.shape, part.base, read_field, found, numbers, by_rows=by_rows)
    if kind.kind in "biuf":
        if math.prod(shape) == 1:
            numbers[name] = float(np.asarray(read(...)).reshape(()))
        else:
            found += columns_of_array(name, shape, read, by_rows=by_rows)


def read_matlab(path: Path, part: int = 0) -> Columns:
    """Return the variables of a MATLAB file as columns; a DataError if it is none or has no array of numbers."""
    try:
        with path.open("rb") as file:
            head = file.read(128)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    # A header of versions 5 and 7.3 has the place of its objects, the version and the order of bytes at its end.
    has_header = head[126:] in {b"IM", b"MI"}
    is_hdf = head.startswith(b"\x89HDF") or (has_header and b"\x02" in head[124:126])
    has_objects = has_header and head[116:124].strip(b"\0 ") != b""
    found: list[Column] = []
    numbers: dict[str, float] = {}
    lists: dict[str, list[list[Column]]] = {}
    opaque: list[str] = []
    for name, node in _hdf_variables(path) if is_hdf else _variables(path, has_objects):
        entries = _entries(node)
        if entries is None:
            _gather(name, node, found, numbers, opaque)
            continue
        parts: list[list[Column]] = []
        for entry in entries:
            parts.append([])
            _gather(name, entry, parts[-1], {}, opaque)
        if any(parts):
            lists[name] = parts
    kind = "MATLAB file"
    if not found and not lists and opaque:
        raise DataError(f"{path}: {', '.join(opaque)} holds {_OPAQUE}; {_HOW}")
    result = _columns(path, kind, found, numbers, lists, part)
    if opaque:
        result.notes.append(f"left out: {', '.join(opaque)}, {_OPAQUE}; {_HOW}")
    return result


class _Node:
    """A value of a MATLAB file: numbers (``shape``, ``read`` by an index), a struct, a list, or an object.

    ``by_rows``: ``read`` does not read the rest of the array.
    """

    def __init__(
        self,
        *,
        shape: Sequence[int] = (),
        read: Callable[[Any], Any] | None = None,
        by_rows: bool = False,
        fields: Mapping[str, Callable[[], _Node]] | None = None,
        entries: Sequence[Callable[[], _Node]] | None = None,
        opaque: bool = False,
    ) -> None:
        self.shape, self.read, self.by_rows = shape, read, by_rows
        self.fields, self.entries, self.opaque = fields, entries, opaque


def _entries(node: _Node) -> list[_Node] | None:
    """Return what a list of runs holds; None for anything else. A cell of one entry is that entry."""
    if node.entries is None or len(node.entries) < 2:
        return None
    return [entry() for entry in node.entries]


def _gather(
    name: str, node: _Node, found: list[Column], numbers: dict[str, float], opaque: list[str], depth: int = 0
) -> None:
    if depth > _DEEPEST:
        return
    if node.opaque:
        opaque.append(name)
    elif node.fields is not None:
        for field, get in node.fields.items():
            _gather(f"{name}.{field}", get(), found, numbers, opaque, depth + 1)
    elif node.entries is not None:
        several = len(node.entries) > 1
        for index, entry in enumerate(node.entries):
            _gather(f"{name}{{{index + 1}}}" if several else name, entry(), found, numbers, opaque, depth + 1)
    elif node.read is not None:
        size = int(np.prod(node.shape))
        if size == 1:
            numbers[name] = float(np.asarray(node.read(...), dtype=float).reshape(()))
        elif size > 1:
            found += columns_of_array(name, node.shape, node.read, by_rows=node.by_rows)


def _columns(
    path: Path,
    kind: str,
    found: list[Column],
    numbers: Mapping[str, float],
    lists: Mapping[str, list[list[Column]]],
    part: int,
    *,
    named: bool = True,
) -> Columns:
    notes = []
    parts = grouped_parts(lists)
    if parts:
        if not 0 <= part <= len(parts):
            raise DataError(f"{path}#{part}: part is {part}; expected 1 to {len(parts)} ({parts[0][0]}, ...)")
        what, chosen = parts[max(part - 1, 0)]
        found = [*chosen, *found]
        if not part:
            notes.append(f"part 1 of {len(parts)} is read, {what}; {path.name}#2 is the next")
    elif part > 1:
        raise DataError(f"{path}#{part}: part is {part}, and the file holds one recording")
    if not found:
        raise DataError(f"{path} holds no array of numbers; expected those of a recording")
    period = None
    for name, value in numbers.items():
        last = name.rpartition(".")[2].casefold()
        if value > 0.0 and (last in _PERIODS or last in _RATES):
            period = value if last in _PERIODS else 1.0 / value
    clocks = {column.name.rpartition(".")[0]: column for column in found if _is_clock(column.name)}
    columns = {}
    for column in found:
        # A struct with a time holds signals with that time: `Scope.time` and `Scope.signals.values`.
        own = next((clocks[name] for name in _places(column.name) if name in clocks), None)
        belongs = own is not None and own is not column and own.size == column.size
        columns[column.name] = replace(column, clock=own.name) if own is not None and belongs else column
    return Columns(path, kind, columns, notes, period, named=named)


def _is_clock(name: str) -> bool:
    place, _, last = name.rpartition(".")
    return bool(place) and last.casefold() in {"time", "t", "tout"}


def _places(name: str) -> Iterator[str]:
    """Yield the structs that a column stands in, the nearest first."""
    while "." in name:
        name = name.rpartition(".")[0]
        yield name


# -- version 5 ---------------------------------------------------------------------------------------------------


def _variables(path: Path, has_objects: bool) -> Iterator[tuple[str, _Node]]:
    """Yield the variables of a file of version 5; arrays of numbers are read when they are asked for."""
    import scipy.io

    library: Any = scipy.io
    if has_objects:
        try:
            import matio

            library = matio
        except ImportError:
            yield path.stem, _Node(opaque=True)
            return
    try:
        listed = library.whosmat(str(path))
    except Exception as error:  # both libraries raise what a damaged file makes them stumble over
        raise DataError(f"{path} is no MATLAB file: {str(error).splitlines()[0]}") from error
    if has_objects:
        listed = [(name, *entry) for name, entry in listed.items()]
    for name, shape, kind in listed:
        load = partial(_loaded, path, name, has_objects)
        if kind in _NUMBERS:
            # All columns of a table are taken from it once it is read; a vector is kept by what reads it.
            yield name, _Node(shape=shape, read=load if 1 in shape else _shared(load))
        elif kind not in {"char", "sparse", "function", "function_handle", "string"}:
            yield name, _node(load(...))


def _shared(load: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a reader that reads its array once."""
    whole = cache(partial(load, ...))
    return lambda key: whole()[key]


def _loaded(path: Path, name: str, has_objects: bool, key: Any) -> Any:
    """Return what an index chooses of one variable."""
    import scipy.io

    try:
        if not has_objects:
            return scipy.io.loadmat(str(path), variable_names=[name], mat_dtype=True)[name][key]
        import matio
        from matio.utils.matclass import MatConvertWarning, MatReadWarning

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MatConvertWarning)  # of the formats in which times are displayed
            warnings.simplefilter("error", MatReadWarning)
            value = matio.load_from_mat(str(path), variable_names=[name])[name]
        return value[key] if isinstance(value, np.ndarray) else value
    except Exception as error:  # both libraries raise what a damaged file makes them stumble over
        raise DataError(f"{path}: variable {name!r} cannot be read: {type(error).__name__}: {error}") from error


def _node(value: Any) -> _Node:
    """Return a value of scipy's or of matio's as a node."""
    if hasattr(value, "properties"):
        return _object(value)
    if hasattr(value, "columns"):
        # A table, or a timetable, whose row times are the index.
        times = np.asarray(value.index)
        columns = {"Time": times} if times.dtype.kind in "mM" else {}
        return _node_of(columns | {str(name): np.asarray(value[name]) for name in value.columns})
    if not isinstance(value, np.ndarray) or type(value).__name__ in {"MatlabOpaque", "MatlabFunction"}:
        return _Node(opaque=type(value).__name__ == "MatlabOpaque")
    if value.dtype.names:
        rows = [{field: partial(_node, row[field]) for field in value.dtype.names} for row in value.flat]
        return _Node(fields=rows[0]) if len(rows) == 1 else _Node(entries=[partial(_Node, fields=row) for row in rows])
    if value.dtype == object:
        return _Node(entries=[partial(_node, entry) for entry in value.flat])
    if value.dtype.kind in "mM" and value.size and np.datetime_data(value.dtype)[0] not in "YM":
        start = value.flat[0] if value.dtype.kind == "M" else np.timedelta64(0, "s")
        value = (value - start) / np.timedelta64(1, "s")
    if value.dtype.kind in "biuf":
        return _Node(shape=value.shape, read=value.__getitem__, by_rows=True)
    return _Node()


def _object(value: Any) -> _Node:
    """Return an object: a timeseries has ``Time`` and ``Data``, a dataset of Simulink its signals by name."""
    held = _properties(value)
    if not (str(value.classname).endswith(".Dataset") and "Storage" in held):
        return _node_of(_timeseries(value) or held)
    signals: dict[str, Any] = {}
    for index, element in enumerate(np.reshape(_properties(held["Storage"])["Elements"], -1), start=1):
        signal = _properties(element)
        name = "".join(np.reshape(signal.get("Name", ""), -1)) or f"signal{index}"
        signals[f"{name}_{index}" if name in signals else name] = signal.get("Values", element)
    series = [_timeseries(signal) for signal in signals.values()]
    times = [one["Time"] for one in series if one]
    if len(times) != len(signals) or any(
        time.size != times[0].size or not np.allclose(time, times[0], 1e-9, 1e-9) for time in times
    ):
        return _node_of(signals)
    # All were logged at the same times: they make a table.
    data = {name: one["Data"] for name, one in zip(signals, series, strict=True)}
    return _node_of({"Time": times[0], **data})


def _timeseries(value: Any) -> dict[str, Any]:
    """Return time [s] and data of a timeseries; nothing of another object."""
    held = _properties(value)
    if not {"TimeInfo", "Data_"} <= held.keys():
        return {}
    times = _properties(held["TimeInfo"])
    time = next((np.reshape(one, -1) for one in (held.get("Time_", ()), times.get("Time_", ())) if np.size(one)), None)
    if time is None:
        start, step, count = (float(np.reshape(times[key], -1)[0]) for key in ("Start_", "Increment_", "Length"))
        time = start + step * np.arange(count)
    unit = "".join(np.reshape(times.get("Units", ""), -1))
    return {"Time": time * _SECONDS.get(unit, 1.0), "Data": held["Data_"]}


def _node_of(values: Mapping[str, Any]) -> _Node:
    return _Node(fields={name: partial(_node, value) for name, value in values.items()})


def _properties(value: Any) -> dict[str, Any]:
    """Return the properties of an object; those that its class stored in a form of its own stand under ``any``."""
    held = dict(getattr(value, "properties", {}))
    stored = held.pop("any", None)
    if isinstance(stored, np.ndarray) and stored.dtype.names and stored.size == 1:
        held |= {name: stored.flat[0][name] for name in stored.dtype.names}
    return held


# -- version 7.3 -------------------------------------------------------------------------------------------------


def _hdf_variables(path: Path) -> Iterator[tuple[str, _Node]]:
    """Yield the variables of a file of version 7.3, which is HDF5, or of any file of HDF5."""
    try:
        import h5py
    except ImportError as error:
        raise need(error, f"{path}, a MATLAB file of version 7.3 (HDF5),") from error
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DataError(f"{path} is no file of HDF5: {str(error).splitlines()[0]}") from error

    def node(item: Any) -> _Node:
        kind = item.attrs.get("MATLAB_class", b"")
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if isinstance(item, h5py.Group):
            return _Node(fields={field: partial(node, item[field]) for field in item})
        if "MATLAB_object_decode" in item.attrs:
            return _Node(opaque=True)
        if item.attrs.get("MATLAB_empty", 0) or kind == "char":
            return _Node()
        if h5py.check_ref_dtype(item.dtype):
            # A cell, or a field of an array of structs: one reference for each entry.
            return _Node(entries=[partial(follow, ref) for ref in item[()].T.flat])
        if item.dtype.kind not in "biuf":
            return _Node()
        # MATLAB's arrays lie in the file transposed.
        return _Node(shape=item.shape[::-1], read=lambda key: item[key if key is ... else key[::-1]], by_rows=True)

    def follow(reference: Any) -> _Node:
        return node(file[reference])

    def has_object(item: Any) -> bool:
        return "MATLAB_object_decode" in item.attrs or (
            h5py.check_ref_dtype(item.dtype) and any(has_object(file[one]) for one in item[()].flat)
            if isinstance(item, h5py.Dataset)
            else any(has_object(item[field]) for field in item)
        )

    readable = "#subsystem#" in file and find_spec("matio") is not None
    for name in file:
        if name.startswith("#"):
            continue
        if readable and has_object(file[name]):
            yield name, _node(_loaded(path, name, True, ...))
            continue
        found = node(file[name])
        yield name, _struct_array(found) or found


def _struct_array(node: _Node) -> _Node | None:
    """Return an array of structs, which the file holds as one struct of lists, as a list of structs."""
    if not node.fields:
        return None
    fields = {name: get() for name, get in node.fields.items()}
    counts = {len(field.entries) for field in fields.values() if field.entries is not None}
    if len(counts) != 1 or any(field.entries is None for field in fields.values()) or min(counts) < 2:
        return None

    def entry(index: int) -> _Node:
        return _Node(fields={name: field.entries[index] for name, field in fields.items() if field.entries})

    return _Node(entries=[partial(entry, index) for index in range(counts.pop())])
