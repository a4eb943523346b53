"""Fewer runs on hardware: simulated runs under the same seeds, and more under others, narrow its intervals.

A run on hardware and the simulated run under its seed share their disturbance, so their costs vary together. With n
such pairs (s_i, h_i), and N more simulated runs, the mean cost on the hardware is that of a regression in two phases:

    h = mean h_i + b (mean of all n + N simulated costs - mean s_i),    b from the n pairs

The simulation need not be right: its bias cancels, and an uncorrelated one has b = 0 in the mean. The variance is
that of the regression's residuals, at n - 2 degrees of freedom, and what N leaves uncertain of the simulation's mean.

Source: Cochran, Sampling Techniques, 3rd ed., 1977, section 12.6 (double sampling with regression); Angelopoulos et
al., Prediction-powered inference, Science 382, 2023; Satterthwaite, Biometrics Bulletin 2, 1946.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console

from pendulum_bags.distributions import Interval, mean_interval, student_quantile
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.ranking.contender import Contender
from pendulum_msgs_py.errors import DataError

__all__ = ["Narrowed", "narrow", "narrow_all", "print_narrowed"]

LEAST_PAIRS = 5
"""Pairs that are needed: with 4, intervals of 95 % held the truth of skewed costs in 92 % of 4000 trials."""


@dataclass(frozen=True)
class Narrowed:
    """A mean cost on hardware from n pairs alone (Student's t), and together with N further simulated runs.

    ``correlation`` is that of the pairs.
    """

    alone: Interval
    together: Interval
    pairs: int
    further: int
    correlation: float

    @property
    def worth(self) -> float:
        """How many hardware runs alone would give an interval as narrow, by its width's inverse square."""
        widths = [one.high - one.low for one in (self.alone, self.together)]
        return self.pairs * (widths[0] / widths[1]) ** 2 if widths[1] > 0.0 else math.inf

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {**asdict(self), "worth": self.worth if math.isfinite(self.worth) else None}


def narrow(hardware: ArrayLike, simulation: ArrayLike, further: ArrayLike) -> Narrowed:
    """Return the mean cost on hardware with its 95 % interval, without and with simulated runs.

    ``hardware`` and ``simulation`` are costs under the same seeds, shape (n,), ``further`` under others, shape (N,). A
    DataError if there are too few pairs, or no further runs.
    """
    h, s, more = (np.asarray(one, dtype=np.float64) for one in (hardware, simulation, further))
    n = h.size
    if n < LEAST_PAIRS or s.size != n or not more.size:
        raise DataError(
            f"got {n} hardware and {s.size} simulated runs under their seeds, and {more.size} under others; expected "
            f"at least {LEAST_PAIRS} pairs and 1 more simulated run"
        )
    alone = Interval(*mean_interval(h))
    mean = alone.value
    every = np.concatenate([s, more])
    around = s - s.mean()
    squares = float(around @ around)
    if squares <= 0.0 or alone.low == alone.high:
        return Narrowed(alone, alone, n, more.size, 0.0)
    slope = float(around @ h) / squares
    shift = float(every.mean() - s.mean())
    residuals = h - mean - slope * around
    noise = float(residuals @ residuals) / (n - 2) * (1.0 / n + shift**2 / squares)
    rest = slope**2 * float(every.var(ddof=1)) / every.size
    variance = noise + rest
    freedom = variance**2 / (noise**2 / (n - 2) + rest**2 / (every.size - 1))
    value = mean + slope * shift
    half = float(student_quantile(0.975, freedom)) * math.sqrt(variance)
    together = Interval(value, value - half, value + half)
    return Narrowed(alone, together, n, more.size, float(np.corrcoef(h, s)[0, 1]))


def narrow_all(contenders: Sequence[Contender]) -> dict[str, Narrowed]:
    """Return the costs on the hardware by name, of those whose seeds give pairs enough and that never failed."""
    found = {}
    for one in contenders:
        if one.sim_failed or one.hw_failed or not (one.sim_seeds and one.hw_seeds):
            continue
        sim, hw = one.by_seed("sim"), one.by_seed("hw")
        both = sorted(sim.keys() & hw.keys())
        more = sorted(sim.keys() - hw.keys())
        if len(both) >= LEAST_PAIRS and more:
            on_hw, on_sim = ([side[seed] for seed in both] for side in (hw, sim))
            found[one.name] = narrow(on_hw, on_sim, [sim[seed] for seed in more])
    return found


def print_narrowed(console: Console, found: dict[str, Narrowed]) -> None:
    """Print a row for each controller, or why there is none."""
    if not found:
        console.print(
            f"The simulated runs narrow no interval: that takes {LEAST_PAIRS} hardware runs of a controller, simulated "
            "runs under the same seeds, and simulated runs under other seeds.",
            style="yellow",
        )
        return
    headings = ("controller", "hardware alone", "with simulated runs", "pairs + more", "worth runs")
    table = number_table("Cost on hardware with 95 % intervals, narrowed by simulated runs", *headings)
    for name, one in found.items():
        cells = [f"{part.value:.4g} ({part.low:.4g} to {part.high:.4g})" for part in (one.alone, one.together)]
        table.add_row(name, *cells, f"{one.pairs} + {one.further}", f"{one.worth:.3g}")
    console.print(table)
