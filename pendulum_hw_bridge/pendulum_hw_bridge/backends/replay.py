"""Backend that plays recorded feedback, to run everything above the port on real data.

Setpoints have no effect; they are checked and limited as by any other backend.
"""

from __future__ import annotations

import csv
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_hw_bridge.backends.bag_feedback import read_bag_feedback
from pendulum_hw_bridge.backends.hebi_log import read_hebilog
from pendulum_hw_bridge.port.actuator import (
    FEEDBACK_QUANTITIES,
    ActuatorError,
    ActuatorInfo,
    Applied,
    Command,
    Feedback,
    HardwareLimits,
    Strategy,
)
from pendulum_hw_bridge.port.clocks import Clock, WallClock
from pendulum_hw_bridge.port.command_check import check_command, check_lifetime
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError, ParameterError

__all__ = ["FeedbackRecording", "ReplayBackend", "load_feedback"]

_REQUIRED = ("time", "position", "velocity", "effort")
_LIMIT = 200_000_000
_DEFAULTS = {"voltage": 36.0}
_FLAGS = tuple(Feedback._field_defaults.values())


class FeedbackRecording:
    """Feedback over time, as arrays.

    Args:
        quantities: ``time`` [s], increasing, and quantities of :data:`FEEDBACK_QUANTITIES` in SI units, all of one
            length. ``position``, ``velocity`` and ``effort`` are required.
        where: Source, for messages.

    Raises:
        DataError: A quantity is missing or unknown, lengths differ, or time does not increase.
    """

    def __init__(self, quantities: Mapping[str, ArrayLike], *, where: str = "recording") -> None:
        known = {"time", *FEEDBACK_QUANTITIES}
        arrays: dict[str, NDArray[np.float64]] = {}
        for name, values in quantities.items():
            if name not in known:
                raise DataError(
                    f"{where}: unknown quantity {name!r}; expected time or one of {', '.join(FEEDBACK_QUANTITIES)}"
                )
            arrays[name] = np.asarray(values, dtype=np.float64)
        for name in _REQUIRED:
            if name not in arrays:
                raise DataError(f"{where}: {name} is missing; expected {', '.join(_REQUIRED)}")
        size = arrays["time"].size
        for name, values in arrays.items():
            if values.ndim != 1 or values.size != size:
                raise DataError(f"{where}: {name} has shape {values.shape}; expected ({size},) like time")
        if size == 0:
            raise DataError(f"{where}: 0 records; expected at least 1")
        time = arrays.pop("time")
        if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
            raise DataError(f"{where}: time does not increase from record to record; expected seconds in order")
        self.time_ns = np.rint((time - time[0]) * NANOSECONDS).astype(np.int64)
        self.columns = arrays
        self.size = size

    @property
    def rate(self) -> float:
        """Median rate of the records [Hz]."""
        if self.size < 2:
            return 100.0
        return float(NANOSECONDS / np.median(np.diff(self.time_ns)))

    def record(self, index: int, stamp_ns: int) -> Feedback:
        """Return one record, stamped with host time [ns]; missing quantities are NaN, the voltage nominal."""
        values = {name: _DEFAULTS.get(name, math.nan) for name in FEEDBACK_QUANTITIES}
        values.update({name: float(column[index]) for name, column in self.columns.items()})
        return Feedback._make((stamp_ns, stamp_ns, index + 1, *(values[name] for name in FEEDBACK_QUANTITIES), *_FLAGS))


def load_feedback(path: str | Path) -> FeedbackRecording:
    """Return the recording in an NPZ file (arrays by name), a CSV file (a header of names), a HEBI log or a bag folder.

    Raises:
        DataError: No such file, another format, or refused content; the message names file and place.
    """
    path = Path(path)
    try:
        if path.is_dir():
            return FeedbackRecording(read_bag_feedback(path), where=str(path))
        if path.stat().st_size > _LIMIT:
            raise DataError(f"{path} has {path.stat().st_size} bytes; expected at most {_LIMIT}")
        if path.suffix == ".npz":
            return FeedbackRecording(_read_npz(path), where=str(path))
        if path.suffix == ".hebilog":
            return FeedbackRecording(read_hebilog(path), where=str(path))
        if path.suffix == ".csv":
            return FeedbackRecording(_read_csv(path), where=str(path))
    except OSError as error:
        raise DataError(f"feedback file {path} cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"feedback file {path}: {error}") from error
    except csv.Error as error:
        raise DataError(f"feedback file {path} is no CSV file: {error}") from error
    raise DataError(f"feedback file {path} ends in {path.suffix!r}; expected .npz, .csv or .hebilog")


def _read_npz(path: Path) -> dict[str, NDArray[np.float64]]:
    try:
        with zipfile.ZipFile(path) as archive:
            # Zeros compress to a thousandth: bound the unpacked size.
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LIMIT:
            raise DataError(f"{path} holds {size} bytes when unpacked; expected at most {_LIMIT}")
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, KeyError, MemoryError) as error:
        raise DataError(f"feedback file {path} is no NPZ file: {error}") from error


def _read_csv(path: Path) -> dict[str, list[float]]:
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        columns: dict[str, list[float]] = {name: [] for name in header}
        if len(columns) != len(header):
            raise DataError(f"{path}:1: a column name is given twice in {', '.join(header)}")
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise DataError(f"{path}:{reader.line_num}: {len(row)} values; expected {len(header)}")
            for name, text in zip(header, row, strict=True):
                try:
                    columns[name].append(float(text))
                except ValueError as error:
                    raise DataError(f"{path}:{reader.line_num}: {name} is {text!r}; expected a number") from error
    return columns


class ReplayBackend:
    """Actuator port of a recording, which starts when it is connected."""

    name = "replay"

    def __init__(self, recording: FeedbackRecording, clock: Clock | None = None) -> None:
        self.recording = recording
        self._clock = clock or WallClock()
        self._start_ns: int | None = None
        self._index = 0
        self._strategy = Strategy.OFF
        self._limits = HardwareLimits()
        self._lifetime = 0.25
        self._rate = recording.rate
        self._gains: GainSet | None = None

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any], clock: Clock, **_: Any) -> ReplayBackend:
        """Return the port of the recording named by the bridge's parameters."""
        if not values["replay_file"]:
            raise ParameterError(
                "replay_file is empty; expected a bag folder, NPZ or CSV file of feedback for backend 'replay'"
            )
        return cls(load_feedback(values["replay_file"]), clock)

    @property
    def strategy(self) -> Strategy:
        """Last requested strategy."""
        return self._strategy

    @property
    def finished(self) -> bool:
        """Whether all records were played."""
        return self._index >= self.recording.size

    def connect(self) -> ActuatorInfo:
        """Start to play."""
        if self._start_ns is None:
            self._start_ns = self._clock.now_ns()
        return ActuatorInfo(
            backend=self.name,
            family="recorded",
            name="recording",
            serial="",
            firmware="",
            strategy=self._strategy,
            feedback_rate=self._rate,
            command_lifetime=self._lifetime,
            limits=self._limits,
            gains=self._gains,
        )

    def now_ns(self) -> int:
        """Return the host clock [ns]."""
        return self._clock.now_ns()

    def read(self, timeout: float) -> Feedback | None:
        """Return the newest record that is due, waiting for one at most ``timeout`` [s]."""
        start_ns = self._require_start()
        deadline = self._clock.now_ns() + round(timeout * NANOSECONDS)
        if self.finished:
            self._clock.wait_until(deadline)
            return None
        due = start_ns + int(self.recording.time_ns[self._index])
        if due > deadline:
            self._clock.wait_until(deadline)
            return None
        self._clock.wait_until(due)
        # A late reader gets the newest due record; earlier ones are lost, as on a network.
        elapsed = self._clock.now_ns() - start_ns
        newest = int(np.searchsorted(self.recording.time_ns, elapsed, side="right")) - 1
        index = max(self._index, newest)
        self._index = index + 1
        stamp_ns = start_ns + int(self.recording.time_ns[index])
        return self.recording.record(index, stamp_ns)

    def write(self, command: Command) -> Applied:
        """Check and limit setpoints; they have no effect."""
        self._require_start()
        limited, changed = check_command(command, self._strategy, self._limits)
        return Applied(limited, self._strategy, changed, self._clock.now_ns())

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        """Store a strategy."""
        self._require_start()
        check_command(command or Command(), strategy, self._limits)
        self._strategy = strategy
        return strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        """Store gains."""
        self._require_start()
        self._gains = gains
        return gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        """Store limits, which then apply to setpoints."""
        self._require_start()
        self._limits = limits
        return limits

    def set_command_lifetime(self, lifetime: float) -> float:
        """Store a lifetime [s]."""
        self._require_start()
        self._lifetime = check_lifetime(lifetime)
        return self._lifetime

    def set_feedback_rate(self, rate: float) -> float:
        """Store a rate [Hz]; the recording has its own."""
        self._require_start()
        self._rate = rate
        return rate

    def stop(self) -> None:
        """Set the strategy off."""
        self._strategy = Strategy.OFF

    def close(self) -> None:
        """Stop playing."""
        self.stop()
        self._start_ns = None

    def _require_start(self) -> int:
        if self._start_ns is None:
            raise ActuatorError("not_connected", "replay is not connected; call connect() first")
        return self._start_ns
