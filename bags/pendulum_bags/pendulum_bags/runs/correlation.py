"""How much independent information correlated samples hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pendulum_bags.arrays import Array

__all__ = ["autocorrelation", "effective_size"]


def autocorrelation(values: ArrayLike, mean: float | None = None) -> Array:
    """Return the biased, positive definite autocorrelation of values (n,), about ``mean`` if known, shape (n,)."""
    samples = np.asarray(values, dtype=float)
    centred = samples - (samples.mean() if mean is None else mean)
    size = samples.size
    spectrum = np.fft.rfft(centred, 2 * size)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, 2 * size)[:size]
    if covariance[0] <= 0.0:
        return np.concatenate(([1.0], np.zeros(size - 1)))
    result: Array = covariance / covariance[0]
    return result


def effective_size(values: ArrayLike, other: ArrayLike | None = None) -> float:
    """Return how many independent samples have the same variance of the mean: n / (1 + 2 sum of rho).

    With a second, independent series it is the variance of the sum of their products, as in a regression: rho is the
    product of both autocorrelations (Bayley, Hammersley, J. R. Stat. Soc. Suppl. 8, 1946). The sum ends where a pair of
    neighbouring autocorrelations is no longer positive (Geyer, Statistical Science 7, 1992, section 3.3).
    """
    # A regression without intercept has residuals about zero: their mean is an error like any other.
    rho = autocorrelation(values) if other is None else autocorrelation(values, 0.0) * autocorrelation(other, 0.0)
    size = rho.size
    pairs = rho[1 : 1 + 2 * ((size - 1) // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    total = pairs[: ends[0] if ends.size else pairs.size].sum()
    return float(np.clip(size / (1.0 + 2.0 * total), 1.0, size))
