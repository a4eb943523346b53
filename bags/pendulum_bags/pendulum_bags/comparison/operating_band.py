"""The operating band of a machine, from repeated runs, and whether a simulation is in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.runs.series import Series, uniform_times

__all__ = ["Band"]

_LEVEL = 0.95


@dataclass(frozen=True)
class Band:
    """The band in which another run of a machine lies at each time with 95 % probability (Student's t of the runs).

    ``own`` is the mean share inside for each run of the machine, in the band of the others; NaN for fewer than three.
    """

    coverage: float
    own: float

    @classmethod
    def of(cls, simulation: Series, runs: Sequence[Series]) -> Band:
        """Return the band of some runs on one clock."""
        start = max(one.t[0] for one in (simulation, *runs))
        stop = min(one.t[-1] for one in (simulation, *runs))
        period = max(one.period for one in (simulation, *runs))
        t = uniform_times(float(start), float(stop), period)
        rows = np.stack([np.interp(t, one.t, one.position) for one in runs])
        low, high = _predicted(rows)
        simulated = np.interp(t, simulation.t, simulation.position)
        own = []
        for index in range(len(rows) if len(rows) > 2 else 0):
            a, b = _predicted(np.delete(rows, index, axis=0))
            own.append(np.mean((rows[index] >= a) & (rows[index] <= b)))
        coverage = float(np.mean((simulated >= low) & (simulated <= high)))
        return cls(coverage, float(np.mean(own)) if own else math.nan)

    @property
    def sentence(self) -> str:
        """The coverage as text."""
        own = "" if math.isnan(self.own) else f"; a run of the machine is in the band of its other runs {self.own:.0%}"
        return (
            f"The simulation's angle is inside the machine's 95 % operating band {self.coverage:.0%} of the time{own}."
        )


def _predicted(rows: Array) -> tuple[Array, Array]:
    count = len(rows)
    mean, spread = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    reach = float(student_quantile(0.5 + 0.5 * _LEVEL, count - 1)) * math.sqrt(1.0 + 1.0 / count) * spread
    return mean - reach, mean + reach
