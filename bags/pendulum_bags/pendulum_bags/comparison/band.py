"""Motions limited to a band that both plants can see, so that sampling at another rate is no difference."""

from __future__ import annotations

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.runs.series import Series, uniform_times
from pendulum_msgs_py.errors import DataError

__all__ = ["BandLimited", "SlowClock", "common_band"]

HIGHEST_SHARE = 0.4
"""Share of the slower rate above which a filter could not keep aliases out."""
_ORDER = 4


def common_band(band: float, *series: Series) -> float:
    """Return the band [Hz] in which all series can be compared: the one asked for, or less where one is too slow."""
    return min(band, HIGHEST_SHARE / max(one.period for one in series))


class SlowClock:
    """The stamps of the slower of two motions, at which the faster one is looked at too.

    A plant that is sampled at 100 Hz under noise that changes every 10 ms is seen at one phase of that noise only; its
    velocity at that phase spreads by up to a quarter more or less than over all phases. No filter undoes that, for
    what was not sampled is lost. So the faster motion is taken at the very same phases, where it has the same images,
    and both are filtered alike after that.

    Args:
        stamps: Of the slower motion, strictly increasing, shape (n,) [s].
        band: Band to keep [Hz].

    Raises:
        DataError: The motion is sampled too slowly for the band, or too short.
    """

    def __init__(self, stamps: Array, band: float) -> None:
        if stamps.size < 10:
            raise DataError(f"two motions share {stamps.size} samples; expected at least 10")
        period = float(np.median(np.diff(stamps)))
        self.times = stamps
        steps = np.maximum(np.round(np.diff(stamps) / period), 1.0)
        # States that are missing leave a gap, which the filter must not take for one step.
        self._index = np.concatenate(([0.0], np.cumsum(steps)))
        self._even = np.arange(self._index[-1] + 1.0)
        self._sections = _sections(band, 1.0 / period, "motion")
        self._reach = min(self._even.size - 1, int(np.ceil(3.0 / (period * band))))

    def filtered(self, values: Array) -> Array:
        """Return values at the stamps, shape (n, ...), without what lies above the band; gaps are filled linearly."""
        if self._even.size != self._index.size:
            left = np.clip(np.searchsorted(self._index, self._even, side="right") - 1, 0, self._index.size - 2)
            share = (self._even - self._index[left]) / (self._index[left + 1] - self._index[left])
            share = share.reshape(-1, *(1,) * (values.ndim - 1))
            values = (1.0 - share) * values[left] + share * values[left + 1]
        return np.asarray(scipy.signal.sosfiltfilt(self._sections, values, axis=0, padlen=self._reach))


class BandLimited:
    """A motion without what lies above a band, at any time of its span.

    Butterworth of order 4, forwards and backwards, so without delay; the half-power frequency of one pass is the band.

    Args:
        series: The motion.
        band: Band [Hz], below half its rate.

    Raises:
        DataError: The motion is sampled too slowly for the band, or too short.
    """

    def __init__(self, series: Series, band: float) -> None:
        rate = 1.0 / series.period
        # A plant in real time stamps with jitter and leaves states out: filters need steps of one length.
        times = uniform_times(float(series.t[0]), float(series.t[-1]), series.period)
        sections = _sections(band, rate, series.name)
        reach = min(times.size - 1, int(np.ceil(3.0 * rate / band)))
        even = series.interpolated(times)
        columns = np.stack([even.position, even.velocity, even.effort], axis=1)
        filtered = scipy.signal.sosfiltfilt(sections, columns, axis=0, padlen=reach)
        self._curve = scipy.interpolate.CubicSpline(times, filtered, axis=0)
        self._ends = float(times[0]), float(times[-1])

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return angle, velocity and torque at some times inside the span, each of shape (n,)."""
        values = self._curve(np.clip(times, *self._ends))
        return values[:, 0], values[:, 1], values[:, 2]


def _sections(band: float, rate: float, name: str) -> Array:
    if not 0.0 < band < 0.5 * rate:
        raise DataError(f"{name} has {rate:.4g} Hz; expected more than {2.0 * band:g} Hz for its band")
    return np.asarray(scipy.signal.butter(_ORDER, band, fs=rate, output="sos"))
