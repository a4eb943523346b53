"""Filters motions to a band that both plants resolve, so that different sampling rates make no difference."""

from __future__ import annotations

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.runs.series import Series
from pendulum_msgs_py.errors import DataError

__all__ = ["SlowClock", "common_band"]

HIGHEST_SHARE = 0.4
"""Share of the slower rate above which a filter could not keep aliases out."""
_ORDER = 4


def common_band(band: float, *series: Series) -> float:
    """Return the band [Hz] in which all series can be compared: the requested one, or less where one is too slow."""
    return min(band, HIGHEST_SHARE / max(one.period for one in series))


class SlowClock:
    """The stamps of the slower of two motions, at which the faster one is evaluated too.

    A plant sampled at 100 Hz under noise that changes every 10 ms is seen at one phase of the noise only, where its
    velocity spreads by up to a quarter more or less. No filter restores that, so the faster motion is resampled at the
    same phases before both are filtered.

    Args:
        stamps: Of the slower motion, strictly increasing, shape (n,) [s].
        band: Upper edge of the band [Hz]; a DataError if the motion is sampled too slowly for it, or too short.
    """

    def __init__(self, stamps: Array, band: float) -> None:
        if stamps.size < 10:
            raise DataError(f"two motions share {stamps.size} samples; expected at least 10")
        self.period = period = float(np.median(np.diff(stamps)))
        self.band = band
        self.times = stamps
        steps = np.maximum(np.round(np.diff(stamps) / period), 1.0)
        # Missing states leave a gap.
        self._index = np.concatenate(([0.0], np.cumsum(steps)))
        self._even = np.arange(self._index[-1] + 1.0)
        self._sections = _sections(band, 1.0 / period, "motion")
        self._reach = min(self._even.size - 1, int(np.ceil(3.0 / (period * band))))

    @property
    def even_times(self) -> Array:
        """The stamps with those that are missing, shape (m,) [s]."""
        return np.interp(self._even, self._index, self.times)

    def filtered(self, values: Array) -> Array:
        """Return values at the stamps, shape (n, ...), low-passed, at the even times; gaps are filled linearly."""
        if self._even.size != self._index.size:
            left = np.clip(np.searchsorted(self._index, self._even, side="right") - 1, 0, self._index.size - 2)
            share = (self._even - self._index[left]) / (self._index[left + 1] - self._index[left])
            share = share.reshape(-1, *(1,) * (values.ndim - 1))
            values = (1.0 - share) * values[left] + share * values[left + 1]
        return self.filtered_even(values)

    def filtered_even(self, values: Array) -> Array:
        """Return values at even times, shape (n, ...), low-passed."""
        reach = min(self._reach, len(values) - 1)
        return np.asarray(scipy.signal.sosfiltfilt(self._sections, values, axis=0, padlen=reach))


def _sections(band: float, rate: float, name: str) -> Array:
    if not 0.0 < band < 0.5 * rate:
        raise DataError(f"{name} has {rate:.4g} Hz; expected more than {2.0 * band:g} Hz for its band")
    return np.asarray(scipy.signal.butter(_ORDER, band, fs=rate, output="sos"))
