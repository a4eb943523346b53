"""Delay of one recording relative to another by normalised cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.runs.series import Series, Signal, uniform_times
from pendulum_msgs_py.errors import DataError

__all__ = ["Alignment", "align_motion", "align_signals", "cross_correlation"]

LONGEST_LAG = 0.25
"""Lags beyond this are no delay of a loop [s]."""


@dataclass(frozen=True)
class Alignment:
    """Delay of the second signal [s], negative where it leads; ``curve`` is the correlation at each of ``lags`` [s]."""

    delay: float
    correlation: float
    correlation_at_zero: float
    lags: Array
    curve: Array
    of: str

    def as_dict(self) -> dict[str, float | str]:
        """Return the figures for JSON, without the curve."""
        return {
            "of": self.of,
            "delay_s": self.delay,
            "correlation": self.correlation,
            "correlation_at_zero": self.correlation_at_zero,
        }


def cross_correlation(first: Array, second: Array, reach: int) -> Array:
    """Return the correlation of first[k] and second[k + lag] at lags -reach to reach, over the overlap at each lag."""
    curve = np.zeros(2 * reach + 1)
    size = first.size
    for i, lag in enumerate(range(-reach, reach + 1)):
        a = first[max(0, -lag) : size - max(0, lag)]
        b = second[max(0, lag) : size - max(0, -lag)]
        a = a - a.mean()
        b = b - b.mean()
        power = float(np.sqrt((a @ a) * (b @ b)))
        curve[i] = float(a @ b) / power if power > 0.0 else 0.0
    return curve


def _peak(first: Array, second: Array, period: float, of: str) -> Alignment:
    reach = round(LONGEST_LAG / period)
    if first.size < 2 * reach + 8:
        reach = max(1, (first.size - 8) // 2)
    if reach < 1 or first.size < 10:
        raise DataError(f"{of} overlap in {first.size} samples; expected at least 10 to align them")
    curve = cross_correlation(first, second, reach)
    top = int(np.argmax(curve))
    offset = 0.0
    if 0 < top < curve.size - 1:
        left, middle, right = curve[top - 1 : top + 2]
        bend = left - 2.0 * middle + right
        # The top of the parabola through the three highest points: a fraction of a sample.
        offset = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    lags = period * np.arange(-reach, reach + 1, dtype=np.float64)
    return Alignment(period * (top - reach + offset), float(curve[top]), float(curve[reach]), lags, curve, of)


def align_motion(first: Series, second: Series) -> Alignment:
    """Estimate the second motion's delay from the velocities: the correlation of regulated angles has a flat top."""
    period = min(first.period, second.period)
    start, stop = max(first.t[0], second.t[0]), min(first.t[-1], second.t[-1])
    times = uniform_times(float(start), float(stop), period)
    a, b = (np.interp(times, one.t, one.velocity) for one in (first, second))
    return _peak(a, b, period, "velocity")


def align_signals(first: Signal, second: Signal, period: float) -> Alignment:
    """Estimate the delay of the second signal at lags of ``period`` [s]; both are held from sample to sample."""
    start, stop = max(first.t[0], second.t[0]), min(first.t[-1], second.t[-1])
    if not stop > start:
        raise DataError(f"{first.name} and {second.name} share no time; expected signals that overlap")
    # In the middle of each period, so that rounding of stamps does not pick the neighbouring sample.
    times = uniform_times(float(start), float(stop), period) + 0.5 * period
    return _peak(first.held_at(times), second.held_at(times), period, first.name)
