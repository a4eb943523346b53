"""Long-run variances from a short window: the response to the known disturbance is separated from the rest.

The variance over a few seconds of motion is biased: it is taken about the window's own mean, and the disturbance in the
window was larger or smaller than usual where the loop amplifies. Resampling the window shows neither. Where the
disturbance was recorded and is white, both are known:

    y(t) = c + b' z(t) + e(t),    var y = b' G b + var e

with z the responses of simple modes to the disturbance, G their long-run covariance, which follows from the modes, and
e the residual. As e is orthogonal to z, the decomposition is exact for any modes and any plant; better modes only
reduce e (a control variate: Owen, Monte Carlo theory, 2013, chapter 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.band import SlowClock
from pendulum_bags.distributions import chi_square_tail
from pendulum_bags.runs.correlation import autocorrelation, effective_size
from pendulum_bags.runs.series import Signal

__all__ = ["Disturbance", "Moments", "covariance", "moments"]

_LEAST_CHANGES = 50
_CHANCE = 1e-3
"""Probability of taking white noise for coloured."""
_LAGS = 20
_SLOWEST = 0.35
"""Time constant of the slowest mode, as a share of the run."""
_SAMPLES_PER_BAND = 4.0
_ORDER = 4
"""Order of the model whose oscillating modes are taken."""


@dataclass(frozen=True)
class Disturbance:
    """White noise: new values at the times ``t``, shape (n,) [s], each held for ``hold`` [s]."""

    t: Array
    value: Array
    hold: float

    @classmethod
    def of(cls, signal: Signal | None, hold: float | None) -> Disturbance | None:
        """Return the recorded disturbance, held for ``hold`` [s]; None if missing, not white, or without ``hold``."""
        if signal is None or not hold:
            return None
        changes = np.concatenate(([0], 1 + np.flatnonzero(np.diff(signal.value))))
        t, value = signal.t[changes], signal.value[changes]
        if value.size < _LEAST_CHANGES:
            return None
        # Portmanteau test of Ljung and Box, Biometrika 65, 1978; the mean of the noise is known to be 0.
        size = value.size
        rho = autocorrelation(value, 0.0)[1 : 1 + _LAGS]
        statistic = size * (size + 2.0) * float((rho**2 / (size - np.arange(1, 1 + rho.size))).sum())
        return None if chi_square_tail(statistic, rho.size) < _CHANCE else cls(t, value, hold)

    def held_at(self, times: Array) -> Array:
        """Return the values at some times [s]."""
        return np.asarray(self.value[np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, None)])

    def mean_over(self, edges: Array) -> Array:
        """Return the mean over each interval between neighbouring edges, shape (len(edges) - 1,)."""
        t = np.append(self.t, max(self.t[-1] + self.hold, edges[-1]))
        area = np.concatenate(([0.0], np.cumsum(self.value * np.diff(t))))
        return np.asarray(np.diff(np.interp(edges, t, area)) / np.diff(edges))


@dataclass(frozen=True)
class Moments:
    """Sums of products over blocks of time: all that the statistics need.

    Args:
        products: Of the constant, the modes and the motions, shape (blocks, q, q).
        sizes: Samples of each block, shape (blocks,).
        gram: Long-run covariance of constant and modes under noise with a mean square of 1, shape (p, p).
        noise: Sums of squares of the noise over the blocks, shape (blocks,).
        known: Whether the disturbance explains the motion; else p is 1.
        short: Correction for the bias of the window's mean; 1 where the disturbance is known; shape (q - p,).
    """

    products: Array
    sizes: Array
    gram: Array
    noise: Array
    known: bool
    short: Array


def moments(clock: SlowClock, motions: Array, disturbance: Disturbance | None, blocks: int) -> Moments:
    """Return the sums of products of one run, from band-limited motions at the clock's even times, shape (n, m)."""
    size = len(motions)
    modes, gram, squares = np.empty((size, 0)), np.empty((0, 0)), np.zeros(size)
    short = np.ones(motions.shape[1])
    if disturbance is None:
        sizes = np.array([effective_size(column) for column in motions.T])
        short = np.sqrt(1.0 / np.maximum(1.0 - 1.0 / np.maximum(sizes, 2.0), 0.5))
    else:
        squares = disturbance.held_at(clock.even_times) ** 2
        modes, gram = _responses(clock, motions, disturbance)
    columns = np.concatenate((np.ones((size, 1)), modes, motions), axis=1)
    edges = np.linspace(0, size, blocks + 1).astype(int)
    parts = [columns[first:last] for first, last in pairwise(edges)]
    whole = np.zeros((1 + len(gram),) * 2)
    whole[1:, 1:] = gram
    return Moments(
        np.stack([part.T @ part for part in parts]),
        np.diff(edges).astype(float),
        whole,
        np.array([float(part.sum()) for part in np.split(squares, edges[1:-1])]),
        disturbance is not None,
        short,
    )


def _responses(clock: SlowClock, motions: Array, disturbance: Disturbance) -> tuple[Array, Array]:
    """Return the responses of the modes at the even times, shape (n, p), and their long-run covariance."""
    times = clock.even_times
    period = clock.period
    before = max(0, math.floor((times[0] - disturbance.t[0]) / period))
    edges = np.concatenate((times[0] - period * np.arange(before + 1, 0, -1), times))
    inputs = disturbance.mean_over(edges)
    span = period * len(times)
    poles = _poles(clock, motions, inputs[before:], _SLOWEST * span)
    responses = clock.filtered_even(_modal(inputs, poles)[before:])
    # One value of the noise alone: the energy of its response is what every value adds to the variance.
    count = math.ceil((8.0 * _SLOWEST * span + 1.0) / period)
    ratio = disturbance.hold / period
    phases = 1 if abs(ratio - round(ratio)) < 1e-3 else 8
    grid = period * np.arange(count + 1)
    gram = np.zeros((responses.shape[1],) * 2)
    # Where in a period the noise changes; far enough from the start for the filter to settle.
    phase = float(np.median((disturbance.t - times[0] + 0.5 * period) % period)) - 0.5 * period
    start = phase + period * math.ceil(0.5 / period)
    for k in range(phases):
        first = start + k * disturbance.hold
        pulse = np.clip(grid[1:] - first, 0.0, disturbance.hold) - np.clip(grid[:-1] - first, 0.0, disturbance.hold)
        one = clock.filtered_even(_modal(pulse / period, poles))
        gram += one.T @ one
    return responses, gram / (ratio * phases)


def _modal(inputs: Array, poles: Array) -> Array:
    """Return the input, the input one sample late, and the responses of modes with these poles, shape (n, p)."""
    columns = [inputs, np.concatenate(([0.0], inputs[:-1]))]
    for pole in poles:
        response = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], inputs.astype(complex))
        columns += [response.real] if pole.imag == 0.0 else [response.real, response.imag]
    return np.stack(columns, axis=1)


def _poles(clock: SlowClock, motions: Array, inputs: Array, slowest: float) -> Array:
    """Return real poles, an octave apart, and from a model of low order the oscillating ones that the motions show."""
    period = clock.period
    octaves = np.arange(1 + math.floor(math.log2(max(2.0, 2.0 * slowest / period))))
    real = np.exp(-2.0 * 0.5**octaves)
    skip = max(1, round(1.0 / (period * _SAMPLES_PER_BAND * clock.band)))
    u = clock.filtered_even(inputs[:, None])[::skip, 0]
    found: list[complex] = []
    for column in motions[::skip].T:
        power = float(np.std(column))
        if power <= 0.0 or column.size < 10 * _ORDER:
            continue
        y = (column - column.mean()) / power
        past = [y[_ORDER - k : -k] for k in range(1, _ORDER + 1)]
        past += [u[_ORDER - k : u.size - k] for k in range(_ORDER + 1)]
        weights = np.linalg.lstsq(np.stack(past, axis=1), y[_ORDER:], rcond=None)[0]
        roots = np.roots(np.concatenate(([1.0], -weights[:_ORDER])))
        found += [root for root in roots if root.imag > 1e-3 and 0.3 < abs(root) < 1.0]
    distinct: list[complex] = []
    for root in sorted(found, key=abs, reverse=True):
        # Nearly coincident modes are redundant.
        if all(abs(root - other) > 0.2 * (1.0 - abs(other)) + 0.02 for other in distinct) and len(distinct) < 3:
            distinct.append(root)
    return np.concatenate((real.astype(complex), np.array(distinct, dtype=complex) ** (1.0 / skip)))


def covariance(products: Array, sizes: Array, noise: Array, moment: Moments) -> tuple[Array, Array]:
    """Return the long-run covariance of the motions, shape (..., m, m), and their means, shape (..., m).

    Args:
        products: Sums of products over samples, shape (..., q, q).
        sizes: Number of samples, shape (...).
        noise: Sums of squares of the noise over them, shape (...).
    """
    p = len(moment.gram)
    means = products / sizes[..., None, None]
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", means[..., :p, :p]), 1e-300))
    scaled = means[..., :p, :p] * scale[..., :, None] * scale[..., None, :]
    inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) * scale[..., :, None] * scale[..., None, :]
    weights = inverse @ means[..., :p, p:]
    transposed = np.swapaxes(weights, -1, -2)
    rest = means[..., p:, p:] - transposed @ means[..., :p, p:]
    if not moment.known:
        # About the window's own mean, which is estimated from these samples only.
        rest = rest * moment.short[:, None] * moment.short[None, :]
    gram = moment.gram * (noise / sizes)[..., None, None]
    return transposed @ gram @ weights + rest, weights[..., 0, :]
