"""Bags as tables: pandas, Parquet and CSV."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_rosbag.reader.bag import Bag

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FORMATS", "export_bag", "to_pandas"]

FORMATS = ("parquet", "csv")


def to_pandas(bag: Bag, topic: str) -> pd.DataFrame:
    """Return a topic as a table, one row a message, ordered by log time.

    One-joint JointStates have the columns of the array (units as there). Messages of other types have a column for
    each field, nested fields joined by dots, arrays as lists.

    Raises:
        DataError: The topic is missing or its messages cannot be read.
    """
    import pandas as pd

    values = bag[topic]
    if isinstance(values, np.ndarray):
        return pd.DataFrame({name: values[name] for name in values.dtype.names or ()})
    if not values:
        return pd.DataFrame({"log_time_ns": np.empty(0, np.int64)})
    return pd.DataFrame([{"log_time_ns": stored.log_time_ns, **_flat(stored.message)} for stored in values])


def export_bag(bag: Bag, folder: Path, format: str = "parquet") -> list[Path]:
    """Write each topic to a file of its own, and the run metadata to ``metadata.json``.

    Args:
        bag: The bag.
        folder: Folder to create.
        format: ``parquet`` or ``csv``.

    Returns:
        The files that were written.

    Raises:
        ParameterError: Unknown format, or pyarrow is missing.
        BagError: The folder exists or cannot be written.
        DataError: A topic cannot be read.
    """
    if format not in FORMATS:
        raise ParameterError(f"format is {format!r}; expected one of {', '.join(FORMATS)}")
    if format == "parquet":
        _require_pyarrow()
    if folder.exists():
        raise BagError(f"{folder} exists already; expected a new folder")
    files = []
    try:
        folder.mkdir(parents=True)
        for topic in bag.topics:
            table = to_pandas(bag, topic)
            path = folder / f"{topic.strip('/').replace('/', '__')}.{format}"
            if format == "csv":
                for name in table.columns:
                    if table[name].map(lambda value: isinstance(value, list)).any():
                        table[name] = table[name].map(json.dumps)
                table.to_csv(path, index=False)
            else:
                table.to_parquet(path, index=False)
            files.append(path)
        path = folder / "metadata.json"
        path.write_text(json.dumps(bag.metadata, indent=2, sort_keys=True) + "\n", encoding="utf-8")
        files.append(path)
    except OSError as error:
        raise BagError(f"{folder} cannot be written: {error.strerror or error}") from error
    return files


def _require_pyarrow() -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        reason = str(error).splitlines()[0]
        raise ParameterError(f"format parquet needs pyarrow, which cannot be imported: {reason}") from error


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    row: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        if str(field.type).startswith("ClassVar"):
            continue  # constants of the type, and what rosbags adds, such as the type's name
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
