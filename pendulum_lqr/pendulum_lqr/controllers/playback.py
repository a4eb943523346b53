"""Playback of a recorded torque."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pendulum_lqr.controller_interface.controller import BaseController
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import ParameterSpec, read_text
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Playback"]

_LARGEST_FILE = 200_000_000


class Playback(BaseController):
    """Open loop: holds each recorded torque until the time of the next; zero before the first and after the last.

    Args:
        times: Times since the start, increasing, shape (n,) [s].
        efforts: Torques, shape (n,) [N m].
        effort_limit: Largest torque [N m].

    Raises:
        DataError: Shapes differ, values are not finite, or times do not increase.
    """

    FEEDBACK = False
    TIME_INVARIANT = False
    SAMPLED = False
    SUMMARY = "open loop: plays a recorded torque"
    PARAMETERS = (
        ParameterSpec("file", "", "", "CSV file with a header line and the columns time [s] and effort [N m]."),
    )

    def __init__(self, times: ArrayLike, efforts: ArrayLike, effort_limit: float) -> None:
        super().__init__(effort_limit)
        t = np.asarray(times, dtype=np.float64)
        u = np.asarray(efforts, dtype=np.float64)
        if t.ndim != 1 or t.shape != u.shape or t.size < 2:
            raise DataError(f"playback has times {t.shape} and torques {u.shape}; expected equal (n,) with n >= 2")
        if not (np.all(np.isfinite(t)) and np.all(np.isfinite(u))):
            raise DataError("playback holds a time or a torque that is not finite")
        if np.any(np.diff(t) <= 0.0):
            index = int(np.argmax(np.diff(t) <= 0.0))
            raise DataError(f"playback time {t[index + 1]} s follows {t[index]} s; expected increasing times")
        self._times: list[float] = t.tolist()
        self._efforts: list[float] = u.tolist()
        self._end = float(t[-1] + (t[-1] - t[-2]))

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> Playback:
        """Return the playback of the parameter ``file``."""
        if p["set_point"] != 0.0:
            raise DataError(f"set_point is {p['set_point']:g} rad; expected 0: a recorded torque aims at no angle")
        if not p["file"]:
            raise DataError("file is empty; expected the path of a CSV with the columns time [s] and effort [N m]")
        path = Path(p["file"]).expanduser()
        rows = read_text(path, "playback file", limit=_LARGEST_FILE).splitlines()[1:]
        values: list[tuple[float, float]] = []
        for number, row in enumerate(rows, start=2):
            if not row.strip():
                continue
            cells = row.split(",")
            try:
                values.append((float(cells[0]), float(cells[1])))
            except (ValueError, IndexError) as error:
                raise DataError(f"{path}:{number}: {row!r}; expected time [s], effort [N m]") from error
        if len(values) < 2:
            raise DataError(f"playback file {path} has {len(values)} samples; expected at least 2")
        times, efforts = zip(*values, strict=True)
        return cls(times, efforts, p["effort_limit"])

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the recorded torque of this time, within the limit [N m]."""
        # Stamps equal the recorded times up to rounding, which must not cost a sample.
        index = bisect_right(self._times, t + 1e-9) - 1
        if index < 0 or t >= self._end:
            return 0.0
        return self.clamp(self._efforts[index])

    def describe(self) -> str:
        """Return the number of torques and their duration."""
        return f"{len(self._times)} torques over {self._end - self._times[0]:.3f} s"
