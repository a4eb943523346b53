"""Statistics of correlated samples: moments, block jackknife, Kolmogorov-Smirnov. Intervals count blocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import kolmogorov_tail, student_quantile
from pendulum_bags.runs.correlation import autocorrelation, effective_size
from pendulum_msgs_py.errors import DataError

__all__ = [
    "Interval",
    "Jackknife",
    "KolmogorovSmirnov",
    "describe",
    "exponential",
    "kolmogorov_smirnov",
    "quantile_pairs",
    "rms",
]


def describe(values: ArrayLike) -> dict[str, float]:
    """Return count, mean, std, min, quartiles and max of values (n,), n >= 2, defined as in ``pandas`` ``describe``."""
    samples = np.asarray(values, dtype=float)
    if samples.size < 2:
        raise DataError(f"statistics of {samples.size} samples; expected at least 2")
    low, first, median, third, high = np.percentile(samples, (0.0, 25.0, 50.0, 75.0, 100.0))
    return {
        "count": int(samples.size),
        "mean": float(samples.mean()),
        "std": float(samples.std(ddof=1)),
        "min": float(low),
        "25%": float(first),
        "50%": float(median),
        "75%": float(third),
        "max": float(high),
    }


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


class Interval(NamedTuple):
    """An estimate with its interval."""

    estimate: float
    low: float
    high: float
    level: float
    error: float
    blocks: int

    @property
    def title(self) -> str:
        """What it is, as text."""
        return f"{100.0 * self.level:.4g} % interval"

    def as_dict(self) -> dict[str, float]:
        """Return the attributes for JSON."""
        return dict(self._asdict())


@dataclass(frozen=True)
class Jackknife:
    """An estimate with its standard error, from estimates that each lack one part of the data.

    ``between`` is the same estimate with the error between runs; None where they differ by chance alone.
    """

    estimate: float
    error: float
    freedom: float
    blocks: int
    between: Jackknife | None = None

    @classmethod
    def of(cls, estimate: float, without: Array) -> Jackknife:
        """Return the delete-one-block jackknife (Quenouille, Biometrika 43, 1956; Tukey, Ann. Math. Stat. 29, 1958).

        Similar neighbouring blocks add their correlation, as in the variance of a mean; the correlation rho of few
        blocks is estimated too low by (1 + 4 rho) / g (Marriott, Pope, Biometrika 41, 1954), here for rho = 1/4.

        Args:
            without: Estimates that each lack one block, in the order of time, shape (g,), g >= 2.
        """
        blocks = len(without)
        rho = float(autocorrelation(without)[1]) + 2.0 / blocks
        variance = (blocks - 1) * float(np.var(without)) * (1.0 + 2.0 * max(rho, 0.0))
        return cls(estimate, math.sqrt(variance), blocks - 1.0, blocks)

    def of_runs(self, runs: Array, sizes: ArrayLike) -> Jackknife:
        """Return the mean over runs from their estimates and samples (n,), no narrower than Student's t of the runs."""
        if len(runs) < 2:
            return self
        weights = np.asarray(sizes, dtype=float) / np.sum(sizes)
        mean, together = float(weights @ runs), float(weights @ weights)
        error = math.sqrt(float(weights @ (runs - mean) ** 2) * together / (1.0 - together))
        between = Jackknife(mean, error, len(runs) - 1.0, self.blocks)
        return Jackknife(mean, self.error, self.freedom, self.blocks, between)

    def less(self, other: Jackknife) -> Jackknife:
        """Return the difference to an independent one."""
        between = (self.between or self).less(other.between or other) if self.between or other.between else None
        ones, others = self.error**2, other.error**2
        total = max(ones + others, 1e-300)
        # Of a sum of two variances (Satterthwaite, Biometrics Bulletin 2, 1946).
        freedom = total**2 / max(ones**2 / self.freedom + others**2 / other.freedom, 1e-300)
        blocks = min(self.blocks, other.blocks)
        return Jackknife(self.estimate - other.estimate, math.sqrt(total), freedom, blocks, between)

    def interval(self, level: float, scale: Callable[[float], float] = float, *, systematic: float = 0.0) -> Interval:
        """Return the interval by Student's t; ``scale`` maps estimate and ends to what is reported."""
        reach = float(student_quantile(0.5 + 0.5 * level, self.freedom)) * self.error
        if self.between:
            # Phases are uniform and their effects skewed, of which Student's t misses up to four times what it states.
            runs, tail = self.between, 0.5 * (1.0 - level)
            reach = max(reach, float(student_quantile(1.0 - 0.25 * tail, runs.freedom)) * runs.error)
        estimate, low, high = (scale(self.estimate + side * (reach + systematic)) for side in (0.0, -1.0, 1.0))
        return Interval(estimate, low, high, level, self.error, self.blocks)


def exponential(value: float) -> float:
    """Return e**value, infinity where that is too large for a number."""
    return math.exp(value) if value < 709.0 else math.inf


class KolmogorovSmirnov(NamedTuple):
    """Largest distance between two empirical distribution functions.

    Attributes:
        distance: D, between 0 and 1.
        at: Value where it is reached.
        sizes: Effective sample sizes of the two.
        p_value: Asymptotic probability of a distance at least as large if both came from one distribution.
    """

    distance: float
    at: float
    sizes: tuple[float, float]
    p_value: float


def kolmogorov_smirnov(first: ArrayLike, second: ArrayLike) -> KolmogorovSmirnov:
    """Compare two samples of correlated values; the p-value uses effective sample sizes."""
    a, b = np.sort(np.asarray(first, dtype=float)), np.sort(np.asarray(second, dtype=float))
    values = np.concatenate((a, b))
    difference = np.searchsorted(a, values, side="right") / a.size - np.searchsorted(b, values, side="right") / b.size
    index = int(np.argmax(np.abs(difference)))
    distance = float(abs(difference[index]))
    sizes = effective_size(first), effective_size(second)
    root = math.sqrt(sizes[0] * sizes[1] / (sizes[0] + sizes[1]))
    # Stephens, JRSS B 32, 1970: this argument makes the asymptotic law good for small samples too.
    p_value = kolmogorov_tail((root + 0.12 + 0.11 / root) * distance)
    return KolmogorovSmirnov(distance, float(values[index]), sizes, p_value)


def quantile_pairs(first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    """Return 99 equal quantiles of two samples, for a quantile plot; each of shape (99,)."""
    levels = (np.arange(99) + 0.5) / 99
    return np.quantile(np.asarray(first), levels), np.quantile(np.asarray(second), levels)
