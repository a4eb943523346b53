"""Spectra of two motions and how far one explains the other, frequency by frequency (Welch's method)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.runs.series import Series, shared_span, uniform_times

__all__ = ["Spectra", "spectra_of"]


@dataclass(frozen=True)
class Spectra:
    """Power spectral densities and coherence.

    Args:
        frequency: Shape (n,) [Hz].
        first, second: One-sided densities of the velocities, shape (n,) [(rad/s)^2/Hz].
        coherence: Magnitude squared coherence, shape (n,), 0 to 1.
        threshold: Coherence that independent signals exceed at a given frequency with 5 % probability.
        segments: Effective number of averaged segments.
    """

    frequency: Array
    first: Array
    second: Array
    coherence: Array
    threshold: float
    segments: float

    @property
    def coherent_up_to(self) -> float:
        """Frequency up to which the coherence stays above the threshold [Hz]; 0 where it starts below."""
        below = np.flatnonzero(self.coherence[1:] <= self.threshold)
        last = below[0] if below.size else self.frequency.size - 1
        return float(self.frequency[last])


def spectra_of(first: Series, second: Series, segment: float = 1.0) -> Spectra:
    """Compare the velocities of two motions in frequency, up to half the slower rate.

    Each density is estimated at (a multiple of) its own rate; for the coherence the faster motion is decimated behind
    an anti-alias filter. ``segment`` is the length of a segment, halves overlapping [s]; shortened for fewer than four.
    """
    start, stop = shared_span(first, second)
    period = max(first.period, second.period)
    times = uniform_times(start, stop, period)
    size = int(min(round(segment / period), 2 * times.size // 5))
    size = max(size, 8)
    rate = 1.0 / period
    densities, slow = [], []
    for one in (first, second):
        # A whole number of samples for one of the slower motion: the segments are of one length then.
        factor = max(1, round(period / one.period))
        fine = uniform_times(start, stop, period / factor)
        velocity = one.interpolated(fine).velocity
        frequency, density = scipy.signal.welch(velocity, factor * rate, nperseg=factor * size)
        densities.append(density[: size // 2 + 1])
        reduced = scipy.signal.resample_poly(velocity - velocity.mean(), 1, factor) if factor > 1 else velocity
        slow.append(reduced[: times.size])
    frequency = frequency[: size // 2 + 1]
    count = min(one.size for one in slow)
    _, coherence = scipy.signal.coherence(slow[0][:count], slow[1][:count], rate, nperseg=size)
    count = (times.size - size) // (size - size // 2) + 1
    # Half-overlapping Hann windows share 1/6 of their power: Welch 1967, Bendat and Piersol section 11.5.
    effective = count / (1.0 + 2.0 * (1.0 / 6.0) ** 2 * (count - 1) / count) if count > 1 else 1.0
    threshold = 1.0 - 0.05 ** (1.0 / max(effective - 1.0, 0.1))
    return Spectra(frequency, densities[0], densities[1], np.clip(coherence, 0.0, 1.0), threshold, effective)
