"""States and commands of several joints as arrays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.cdr import decode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.joint_state import FIELDS

__all__ = ["JointTable", "joint_table"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointTable:
    """The k messages of one topic of n joints (columns) by log time.

    Times [ns] have shape (k,), the others (k, n): position [rad or m] (NaN if absent), velocity [rad/s or m/s], effort
    [N m or N].
    """

    names: tuple[str, ...]
    log_time_ns: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array

    def of(self, joint: str) -> NDArray[Any]:
        """Return one joint's messages with the columns of :meth:`Bag.array`; a DataError for other joints."""
        if joint not in self.names:
            raise DataError(f"joint is {joint!r}; expected one of {', '.join(self.names)}")
        column = self.names.index(joint)
        rows = np.empty(self.stamp_ns.size, FIELDS)
        rows["log_time_ns"], rows["stamp_ns"] = self.log_time_ns, self.stamp_ns
        for name in ("position", "velocity", "effort"):
            rows[name] = getattr(self, name)[:, column]
        return rows


def joint_table(messages: Iterable[tuple[int, bytes]], where: str) -> JointTable:
    """Return JointStates (log time [ns], bytes) as a table; each message may order the joints differently.

    Raises:
        DataError: There is none, one is no JointState with a value per name, or the joints differ (names ``where``).
    """
    times: list[int] = []
    stamps: list[int] = []
    rows: list[list[tuple[float, ...]]] = [[], [], []]
    expected: tuple[str, ...] | None = None
    for log_time_ns, data in messages:
        fields = decode_joint_state(data)
        if fields is None:
            raise DataError(f"{where}: message {len(times)} is no JointState with one value for each of its names")
        expected = fields.joints if expected is None else expected
        columns = tuple(fields[3:])
        if fields.joints != expected:
            if sorted(fields.joints) != sorted(expected):
                raise DataError(
                    f"{where}: message {len(times)} is of {', '.join(fields.joints)}; expected {', '.join(expected)}"
                )
            order = [fields.joints.index(joint) for joint in expected]
            columns = tuple(tuple(values[place] for place in order) if values else () for values in columns)
        times.append(log_time_ns)
        stamps.append(fields.stamp_ns)
        for column, values in zip(rows, columns, strict=True):
            column.append(values or (np.nan,) * len(expected))
    if expected is None:
        raise DataError(f"{where}: no messages; expected at least one")
    position, velocity, effort = (np.array(column, float).reshape(-1, len(expected)) for column in rows)
    return JointTable(expected, np.array(times, np.int64), np.array(stamps, np.int64), position, velocity, effort)
