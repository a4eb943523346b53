"""Bags as tables: pandas, Parquet, CSV and MATLAB."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.contract.names import (
    APPLIED_EFFORT,
    APPLIED_VOLTAGE,
    DISTURBANCE,
    JOINT_STATES,
    VOLTAGE_DISTURBANCE,
    VOLTAGE_TOPICS,
)
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_msgs_py.json_values import without_nan
from pendulum_msgs_py.programs.extras import how_to_install
from pendulum_rosbag.reader.bag import Bag
from pendulum_rosbag.reader.decode import store_for
from pendulum_rosbag.reader.joint_table import joint_table
from pendulum_rosbag.reader.topic_info import TopicInfo

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray
    from rosbags.typesys.store import Typestore

    from pendulum_rosbag.reader.topic_info import StoredMessage


__all__ = ["FORMATS", "LEROBOT", "export_bag", "require_pyarrow", "to_pandas"]

FORMATS = ("parquet", "csv", "mat")
LEROBOT = "lerobot"
"""Format of :mod:`pendulum_rosbag.reader.lerobot`."""
_JOINT_STATE = "sensor_msgs/msg/JointState"
_ARROW_NAMES = {"bool": "bool_", "byte": "uint8", "char": "uint8", "octet": "uint8", "wstring": "string"}
"""Arrow's names of ROS types, if they differ."""


def to_pandas(bag: Bag, topic: str) -> pd.DataFrame:
    """Return a topic as a table by log time, one row per message; a DataError if it cannot be read.

    JointStates of one joint have the array's columns and units, those of several joints a column per quantity and
    joint, such as ``elbow.position``, if all messages name the same joints. Other types have a column per field, nested
    fields joined by dots, arrays as lists.
    """
    import pandas as pd

    values = bag[topic]
    if isinstance(values, np.ndarray):
        return pd.DataFrame({name: values[name] for name in values.dtype.names or ()})
    if not values:
        return pd.DataFrame({"log_time_ns": np.empty(0, np.int64)})
    if bag.topics[topic].type == _JOINT_STATE and (columns := _joint_columns(bag, topic, values)):
        return pd.DataFrame(columns)
    return pd.DataFrame([{"log_time_ns": stored.log_time_ns, **_flat(stored.message)} for stored in values])


def _joint_columns(bag: Bag, topic: str, messages: Sequence[StoredMessage]) -> dict[str, Any]:
    """Return the columns of states of several joints; none if the messages' joints differ."""
    try:
        table = joint_table(bag.raw(topic), topic)
    except DataError:
        return {}
    if len(set(table.names)) < max(2, len(table.names)):
        return {}
    columns: dict[str, Any] = {"log_time_ns": table.log_time_ns, "stamp_ns": table.stamp_ns}
    for quantity in ("position", "velocity", "effort"):
        values = getattr(table, quantity)
        columns |= {f"{name}.{quantity}": values[:, index] for index, name in enumerate(table.names)}
    return {**columns, "frame_id": [stored.message.header.frame_id for stored in messages]}


def export_bag(
    bag: Bag, folder: Path, format: str = "parquet", *, on_left_out: Callable[[str], None] = lambda sentence: None
) -> list[Path]:
    """Write each topic to a file and the run metadata to ``metadata.json``, all or nothing; return the files.

    ``format`` is ``parquet``, ``csv`` or ``mat`` (MATLAB's version 5); ``on_left_out`` gets a sentence for each
    unreadable topic.

    Raises:
        ParameterError: Unknown format, or pyarrow is missing.
        BagError: The folder exists or cannot be written.
        DataError: No topic can be read.
    """
    if format not in FORMATS:
        raise ParameterError(f"format is {format!r}; expected one of {', '.join((*FORMATS, LEROBOT))}")
    if format == "parquet":
        require_pyarrow(format)
    if folder.exists():
        raise BagError(f"{folder} exists already; expected a new folder")
    files: list[Path] = []
    failed: DataError | None = None
    with writing(f"folder {folder}", BagError):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            # The folder gets its name only when it is complete.
            place = Path(scratch, folder.name)
            place.mkdir()
            for topic in bag.topics:
                try:
                    table = _with_inputs(bag, topic, to_pandas(bag, topic))
                except DataError as error:
                    failed = error
                    on_left_out(str(error))
                    continue
                files.append(_free_path(place, topic, format, files))
                _write_table(files[-1], table, bag.topics[topic], format, bag.start_ns)
            if failed and not files:
                raise failed
            files.append(place / "metadata.json")
            text = json.dumps(without_nan(bag.metadata), indent=2, sort_keys=True, allow_nan=False)
            files[-1].write_text(text + "\n", encoding="utf-8")
            os.rename(place, folder)
    return [folder / path.name for path in files]


_INPUTS = {
    DISTURBANCE: "disturbance_effort",
    APPLIED_EFFORT: "applied_effort",
    VOLTAGE_DISTURBANCE: "disturbance_voltage",
    APPLIED_VOLTAGE: "applied_voltage",
}
"""Columns that states get from other topics."""


def _with_inputs(bag: Bag, topic: str, table: pd.DataFrame) -> pd.DataFrame:
    """Return states with disturbance and applied torque, held at each, so that one file has input and output.

    Voltages, which a JointState carries as efforts, get their name.
    """
    if topic.endswith(VOLTAGE_TOPICS):
        names = {name: f"{name[:-6]}voltage" for name in map(str, table) if name.rpartition(".")[2] == "effort"}
        return table.rename(columns=names)
    if not topic.endswith(JOINT_STATES) or "stamp_ns" not in table:
        return table
    for signal, column in _INPUTS.items():
        other = f"{topic.removesuffix(JOINT_STATES)}{signal}"
        if other not in bag.topics:
            continue
        values = bag[other]
        if isinstance(values, np.ndarray):
            stamps, efforts = values["stamp_ns"], {column: values["effort"]}
        else:
            found = joint_table(bag.raw(other), other)
            stamps = found.stamp_ns
            efforts = {f"{name}.{column}": found.effort[:, index] for index, name in enumerate(found.names)}
        order = np.argsort(stamps, kind="stable")
        held = np.searchsorted(stamps[order], table["stamp_ns"], side="right")
        table = table.assign(**{name: np.concatenate(([0.0], one[order]))[held] for name, one in efforts.items()})
    return table


def _free_path(folder: Path, topic: str, format: str, taken: Sequence[Path]) -> Path:
    """Return a file for a topic; names that differ only in slashes are numbered."""
    stem = topic.strip("/").replace("/", "__")
    names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
    return next(path for name in names if (path := folder / f"{name}.{format}") not in taken)


def _write_table(path: Path, table: pd.DataFrame, info: TopicInfo, format: str, start_ns: int) -> None:
    if format == "parquet":
        _write_parquet(path, table, info)
        return
    if format == "mat":
        _write_mat(path, table, start_ns)
        return
    for name in table.columns:
        if table[name].map(lambda value: isinstance(value, list)).any():
            table[name] = table[name].map(_json)
    table.to_csv(path, index=False)


def _json(value: Any) -> str:
    return json.dumps(without_nan(value), allow_nan=False)


def _write_parquet(path: Path, table: pd.DataFrame, info: TopicInfo) -> None:
    """Write a table; lists get their field's type even if all are empty."""
    import pyarrow as pa
    import pyarrow.parquet

    arrow = pa.Table.from_pandas(table, preserve_index=False)
    if any(_is_untyped(column.type) for column in arrow.schema):
        types = dict(_arrow_fields(info.type, store_for(info)))
        for index, column in enumerate(arrow.schema):
            if _is_untyped(column.type):
                values = pa.array(table[column.name].tolist(), types[column.name])
                arrow = arrow.set_column(index, column.name, values)
    pyarrow.parquet.write_table(arrow, path)


def _write_mat(path: Path, table: pd.DataFrame, start_ns: int) -> None:
    """Write columns as MATLAB variables (matrix, else cell array), and ``time`` [s] from the bag's start."""
    from scipy.io import savemat

    clock = table["stamp_ns" if "stamp_ns" in table else "log_time_ns"].to_numpy()
    variables: dict[str, NDArray[Any]] = {"time": (clock - start_ns) * 1e-9}
    for column in table.columns:
        # MATLAB's names are letters, digits and underscores, begin with a letter, and have at most 63 characters.
        stem = re.sub(r"\W", "_", str(column), flags=re.ASCII)[:58]
        stem = stem if stem[:1].isalpha() else f"x{stem}"
        names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
        variables[next(name for name in names if name not in variables)] = _matlab(table[column])
    savemat(path, variables, oned_as="column", do_compression=True)


def _matlab(column: pd.Series[Any]) -> NDArray[Any]:
    values = column.to_numpy()
    if values.dtype.kind in "biuf":
        return values
    if all(isinstance(value, list) for value in values) and len({len(value) for value in values}) == 1:
        matrix = np.array(values.tolist())
        if matrix.ndim == 2 and matrix.dtype.kind in "biuf":
            return matrix
    cells = np.empty(len(values), object)
    for index, value in enumerate(values):
        numbers = isinstance(value, list) and all(isinstance(item, (bool, int, float)) for item in value)
        cells[index] = np.array(value, float) if numbers else value if isinstance(value, str) else _json(value)
    return cells


def _is_untyped(kind: Any) -> bool:
    import pyarrow as pa

    if pa.types.is_list(kind):
        return _is_untyped(kind.value_type)
    if pa.types.is_struct(kind):
        return any(_is_untyped(kind.field(index).type) for index in range(kind.num_fields))
    return bool(pa.types.is_null(kind))


def _arrow_fields(kind: str, store: Typestore, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a message type's columns and Arrow types, nested fields joined by dots as in the tables."""
    import pyarrow as pa
    from rosbags.interfaces import Nodetype

    def item(node: Any, detail: Any) -> Any:
        if node == Nodetype.NAME:
            return pa.struct(list(_arrow_fields(detail, store)))
        name = _ARROW_NAMES.get(detail[0], detail[0])
        return getattr(pa, name)()

    fields: list[tuple[str, tuple[Any, Any]]] = [*store.fielddefs[kind][1]]
    for name, (node, detail) in fields:
        if node == Nodetype.NAME:
            yield from _arrow_fields(detail, store, f"{prefix}{name}.")
        elif node in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
            yield f"{prefix}{name}", pa.list_(item(*detail[0]))
        else:
            yield f"{prefix}{name}", item(node, detail)


def require_pyarrow(format: str) -> None:
    """Raise a ParameterError with installation instructions if pyarrow is missing."""
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        reason = str(error).splitlines()[0]
        text = how_to_install(error) or f"format {format} needs pyarrow, which cannot be imported: {reason}"
        raise ParameterError(text) from error


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    row: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        if str(field.type).startswith("ClassVar"):
            continue  # constants, and what rosbags adds, such as the type's name
        item = getattr(value, field.name)
        name = f"{prefix}{field.name}"
        if dataclasses.is_dataclass(item):
            row.update(_flat(item, f"{name}."))
        else:
            row[name] = _plain(item)
    return row


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return _flat(value) if dataclasses.is_dataclass(value) else value
