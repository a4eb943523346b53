"""Whether two plants had one disturbance: the same course in time, and the same size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pendulum_bags.comparison.alignment import LONGEST_LAG, Alignment, align_signals
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.distributions import student_quantile
from pendulum_bags.runs.series import Signal

__all__ = ["SharedSignal", "compare_signals"]

LEAST_CORRELATION = 0.6
"""Least correlation of one signal where late loops skip and repeat samples of it."""
CHANCE = 1e-3
"""Probability with which independent signals may be taken for one."""
AMPLITUDE = 1.1
"""Factor between the sizes of what still counts as one signal: skipped samples change it by some per cent."""


@dataclass(frozen=True)
class SharedSignal:
    """Two recorded disturbances; independent ones exceed ``threshold`` at any lag with a probability of ``CHANCE``."""

    alignment: Alignment
    amplitude: float
    threshold: float
    changes: int

    @property
    def is_one(self) -> bool:
        """Whether they count as one signal."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why they do not, as text; empty where they do."""
        found = self.alignment.correlation
        if found <= self.threshold:
            return (
                f"the recorded disturbances differ: their correlation is {found:.2f} at best, "
                f"expected above {self.threshold:.2f} for signals with {self.changes} changes"
            )
        if not 1.0 / AMPLITUDE <= self.amplitude <= AMPLITUDE:
            return (
                f"the recorded disturbances differ in size: the hardware's is {self.amplitude:.2f} "
                "times the simulation's, "
                f"expected {1.0 / AMPLITUDE:.2f} to {AMPLITUDE:.2f}"
            )
        return ""

    def as_dict(self) -> dict[str, float | str]:
        """Return the figures for JSON."""
        return {**self.alignment.as_dict(), "amplitude": self.amplitude, "threshold": self.threshold}


def compare_signals(first: Signal | None, second: Signal | None, period: float) -> SharedSignal | None:
    """Compare two recorded disturbances over time since their start, at lags of ``period`` [s], or return None."""
    if first is None or second is None or min(first.t.size, second.t.size) < 12:
        return None
    alignment = align_signals(first, second, period)
    size = rms(first.value)
    amplitude = rms(second.value) / size if size > 0.0 else float("inf")
    changes = min(_changes(first), _changes(second))
    return SharedSignal(alignment, amplitude, _threshold(changes, float(np.ptp(first.t))), changes)


def _changes(held: Signal) -> int:
    return 1 + int(np.count_nonzero(np.diff(held.value)))


def _threshold(changes: int, duration: float) -> float:
    if changes < 4:
        return 0.999
    # Lags within one hold are nearly one and the same trial.
    trials = 1.0 + 2.0 * LONGEST_LAG * changes / max(duration, 1e-9)
    t = -float(student_quantile(CHANCE / trials, changes - 2))
    return max(LEAST_CORRELATION, t / math.sqrt(changes - 2 + t * t))
