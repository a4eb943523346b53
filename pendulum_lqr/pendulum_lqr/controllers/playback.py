"""Playback of recorded efforts."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_lqr.controller_interface.law import clamped
from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import ParameterSpec, read_text
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Playback"]

_LARGEST_FILE = 200_000_000


class Playback(BaseController):
    """Open loop: holds recorded efforts until the time of the next; zero before the first and after the last.

    Args:
        times: Times since the start, increasing, shape (n,) [s].
        efforts: Of m driven joints, shape (n,) or (n, m) [N m or N, or V].
        effort_limits: Largest efforts, shape (m,), in the same unit.

    Raises:
        DataError: Shapes differ, values are not finite, or times do not increase.
    """

    FEEDBACK = False
    TIME_INVARIANT = False
    SAMPLED = False
    IN_VOLTS = True
    SUMMARY = "open loop: plays recorded efforts"
    PARAMETERS = (
        ParameterSpec(
            "file",
            "",
            "",
            "CSV file with a header line, and the columns time [s] and the effort of each driven joint [N m or N]. For "
            "a plant in volts these are voltages [V], and the header says so.",
        ),
    )

    def __init__(self, times: ArrayLike, efforts: ArrayLike, effort_limits: float | Vector) -> None:
        limits = effort_limits if isinstance(effort_limits, tuple) else (effort_limits,)
        super().__init__(limits[0])
        self.effort_limits = limits
        t = np.asarray(times, dtype=np.float64)
        u = np.asarray(efforts, dtype=np.float64)
        if t.ndim != 1 or t.shape != u.shape[:1] or t.size < 2:
            raise DataError(f"playback has times {t.shape} and torques {u.shape}; expected equal (n,) with n >= 2")
        if not (np.all(np.isfinite(t)) and np.all(np.isfinite(u))):
            raise DataError("playback holds a time or a torque that is not finite")
        if np.any(np.diff(t) <= 0.0):
            index = int(np.argmax(np.diff(t) <= 0.0))
            raise DataError(f"playback time {t[index + 1]} s follows {t[index]} s; expected increasing times")
        self._times: list[float] = t.tolist()
        self._efforts: list[list[float]] = u.reshape(t.size, -1).tolist()
        self._end = float(t[-1] + (t[-1] - t[-2]))

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Playback:
        """Return the playback of the parameter ``file``."""
        if p.get("set_point", 0.0) != 0.0:
            raise DataError(f"set_point is {p['set_point']:g} rad; expected 0: a recorded torque aims at no angle")
        limits = (p["effort_limit"],) if plant.is_pendulum else plant.command_limits
        volts = plant.coordinates.volts
        what = "voltages" if volts else "efforts"
        columns = "time [s], effort [N m]" if plant.is_pendulum else f"time [s] and {len(limits)} {what}"
        if not p["file"]:
            raise DataError(f"file is empty; expected the path of a CSV with the columns {columns}")
        path = Path(p["file"]).expanduser()
        header, *rows = read_text(path, "playback file", limit=_LARGEST_FILE).splitlines() or [""]
        if ("volt" in header.lower() or "[V]" in header) != volts:
            raise DataError(
                f"playback file {path} has the header {header!r}, and plant {plant.name!r} is driven in "
                f"{plant.coordinates.drive_unit}; expected a header with{'' if volts else 'out'} voltage"
            )
        values: list[list[float]] = []
        for number, row in enumerate(rows, start=2):
            if not row.strip():
                continue
            cells = row.split(",")
            try:
                values.append([float(cells[column]) for column in range(1 + len(limits))])
            except (ValueError, IndexError) as error:
                raise DataError(f"{path}:{number}: {row!r}; expected {columns}") from error
        if len(values) < 2:
            raise DataError(f"playback file {path} has {len(values)} samples; expected at least 2")
        table = np.array(values)
        return cls(table[:, 0], table[:, 1:], limits)

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the recorded efforts of this time, within the limits [N m or N]."""
        # Stamps equal the recorded times up to rounding, which must not cost a sample.
        index = bisect_right(self._times, t + 1e-9) - 1
        if index < 0 or t >= self._end:
            return (0.0,) * len(self.effort_limits)
        return tuple(clamped(u, limit) for u, limit in zip(self._efforts[index], self.effort_limits, strict=True))

    def describe(self) -> str:
        """Return the number of efforts and their duration."""
        return f"{len(self._times)} efforts over {self._end - self._times[0]:.3f} s"
