"""Typed arrays that every analysis takes: the motion of one plant, and one signal over time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from pendulum_bags.arrays import Array
from pendulum_msgs_py.errors import DataError

__all__ = ["Series", "Signal", "shared_span", "uniform_times", "unwrap_near_upright"]


def _as_columns(name: str, t: ArrayLike, columns: dict[str, ArrayLike], least: int) -> dict[str, Array]:
    arrays = {key: np.ascontiguousarray(value, dtype=float) for key, value in {"t": t, **columns}.items()}
    size = arrays["t"].size
    if size < least:
        raise DataError(f"{name} has {size} samples; expected at least {least}")
    for key, values in arrays.items():
        if values.shape != (size,):
            raise DataError(f"{name}: {key} has shape {values.shape}; expected ({size},)")
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{name}: {key} is {values[bad[0]]} in sample {bad[0]} ({bad.size} such samples); "
                "expected finite numbers"
            )
    steps = np.diff(arrays["t"])
    if np.any(steps <= 0.0):
        i = int(np.argmax(steps <= 0.0))
        raise DataError(
            f"{name}: time goes from {arrays['t'][i]:.6f} s to {arrays['t'][i + 1]:.6f} s; "
            "expected strictly increasing stamps"
        )
    return arrays


@dataclass(frozen=True)
class Signal:
    """A scalar over time that is held from sample to sample, such as a torque [N m], shape (n,).

    Args:
        t: Stamps, strictly increasing, shape (n,) [s].
    """

    t: Array
    value: Array
    name: str = "signal"

    def __post_init__(self) -> None:
        """Convert and check."""
        for key, values in _as_columns(self.name, self.t, {"value": self.value}, 1).items():
            object.__setattr__(self, key, values)

    def between(self, start: float, stop: float) -> Signal:
        """Return the samples with ``start <= t < stop`` [s]."""
        first, last = np.searchsorted(self.t, (start, stop), side="left")
        if first == last:
            raise DataError(f"{self.name} has no sample between {start:.3f} s and {stop:.3f} s; expected at least 1")
        return Signal(self.t[first:last], self.value[first:last], self.name)

    def held_at(self, times: ArrayLike) -> Array:
        """Return the value in force at each time: that of the newest sample, 0 before the first."""
        index = np.searchsorted(self.t, np.asarray(times, dtype=float), side="right") - 1
        return np.where(index >= 0, self.value[np.maximum(index, 0)], 0.0)


@dataclass(frozen=True)
class Series:
    """The motion of one plant.

    Args:
        t: Stamps, strictly increasing, shape (n,) [s].
        position: Angle, continuous (not wrapped) [rad], or position of a sliding joint [m], shape (n,).
        velocity: Shape (n,) [rad/s or m/s].
        effort: Torque of the controller for each state, shape (n,) [N m or N]; 0 for a joint without a motor.
        unit: Of the position, ``rad`` or ``m``.
        drive_unit: Of the effort, if it is no torque or force; else empty.
    """

    t: Array
    position: Array
    velocity: Array
    effort: Array
    name: str = "series"
    unit: str = "rad"
    drive_unit: str = ""

    def __post_init__(self) -> None:
        """Convert and check."""
        columns: dict[str, ArrayLike] = {
            "position": self.position,
            "velocity": self.velocity,
            "effort": self.effort,
        }
        for key, values in _as_columns(self.name, self.t, columns, 4).items():
            object.__setattr__(self, key, values)

    @property
    def slides(self) -> bool:
        """Whether it is the motion of a joint that slides, in metres."""
        return self.unit == "m"

    @property
    def effort_unit(self) -> str:
        """Unit of the effort: of a force where the joint slides; of a file, that of its input."""
        return self.drive_unit or ("N" if self.slides else "N m")

    @property
    def effort_word(self) -> str:
        """The field's word for the effort."""
        return "voltage" if self.effort_unit == "V" else "force" if self.slides else "torque"

    @property
    def period(self) -> float:
        """Median time between two samples [s]."""
        return float(np.median(np.diff(self.t)))

    @property
    def rate(self) -> float:
        """Mean sampling rate [Hz]."""
        return float((self.t.size - 1) / (self.t[-1] - self.t[0]))

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    def between(self, start: float, stop: float) -> Series:
        """Return the samples with ``start <= t < stop`` [s]; a DataError for fewer than four."""
        first, last = np.searchsorted(self.t, (start, stop), side="left")
        if last - first < 4:
            raise DataError(
                f"{self.name} has {last - first} samples between {start:.3f} s and {stop:.3f} s; expected at least 4"
            )
        return self.at(slice(first, last))

    def at(self, rows: slice) -> Series:
        """Return some of the samples."""
        return replace(
            self, t=self.t[rows], position=self.position[rows], velocity=self.velocity[rows], effort=self.effort[rows]
        )

    def shifted(self, delay: float) -> Series:
        """Return the same motion with all stamps earlier by ``delay`` [s]."""
        return replace(self, t=self.t - delay)

    def interpolated(self, times: Array) -> Series:
        """Return the motion at other times within it, shape (m,) [s]: cubic splines, effort held; or a DataError."""
        if times[0] < self.t[0] or times[-1] > self.t[-1]:
            raise DataError(
                f"{self.name} spans {self.t[0]:.6f} s to {self.t[-1]:.6f} s and is asked for "
                f"{times[0]:.6f} s to {times[-1]:.6f} s; expected times inside its span"
            )
        position = scipy.interpolate.CubicSpline(self.t, self.position)(times)
        velocity = scipy.interpolate.CubicSpline(self.t, self.velocity)(times)
        effort = Signal(self.t, self.effort, self.name).held_at(times)
        return replace(self, t=times, position=position, velocity=velocity, effort=effort)


def shared_span(*series: Series) -> tuple[float, float]:
    """Return the first and last time [s] at which all series have data; a DataError if there is none."""
    start = max(float(one.t[0]) for one in series)
    stop = min(float(one.t[-1]) for one in series)
    if not stop > start:
        spans = ", ".join(f"{one.name} {one.t[0]:.3f} s to {one.t[-1]:.3f} s" for one in series)
        raise DataError(f"the series share no time ({spans}); expected spans that overlap")
    return start, stop


def uniform_times(start: float, stop: float, period: float) -> Array:
    """Return times from ``start`` to at most ``stop`` at a fixed period [s]."""
    count = int(np.floor((stop - start) / period + 1e-6)) + 1
    return np.minimum(start + period * np.arange(count, dtype=float), stop)


def unwrap_near_upright(position: ArrayLike) -> Array:
    """Return continuous angles, moved by whole turns so that their median lies in [-pi/2, 3 pi/2) [rad]."""
    angles = np.unwrap(np.asarray(position, dtype=float))
    turn = 2.0 * np.pi
    return angles - turn * np.floor((np.median(angles) + 0.25 * turn) / turn)
