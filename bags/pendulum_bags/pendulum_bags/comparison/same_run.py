"""Tests of the first layer: do simulation and hardware move alike under one controller and one disturbance?

Estimands, each over a run without end under the same noise, both motions at the slower plant's sampling times and
below one band: the difference of the means; the ratio of the standard deviations; the delay at which the simulation's
velocity is nearest to the hardware's; the rms distance per standard deviation of the hardware, as it is and less that
delay.

The long-run variances are estimated by :mod:`pendulum_bags.comparison.long_run`, all intervals by a jackknife
over blocks of time. "Equivalent" needs each test's interval inside its margin, which errs with alpha at most whatever
the number of tests (Berger, Technometrics 24, 1982); one test suffices for "not equivalent", so each has its share of
alpha (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.band import SlowClock, common_band
from pendulum_bags.comparison.equivalence import EquivalenceTest, Outcome, equivalence_test
from pendulum_bags.comparison.long_run import Disturbance, covariance, moments
from pendulum_bags.comparison.margins import Margin, Margins
from pendulum_bags.comparison.statistics import Interval, Jackknife
from pendulum_bags.runs.series import Series, uniform_times
from pendulum_msgs_py.errors import ParameterError

__all__ = ["Looks", "paired_tests", "unpaired_tests"]

LONGEST_DELAY = 0.1
"""Largest delay of the search [s]."""
LEAST_LIKENESS = 0.5
"""Correlation of the velocities from which a peak is a delay: 0.92 with 1 N m of dry friction, 0.13 by chance."""
LAG_STEP = 0.001
"""Resolution of the lags near the delay; between two of them the slope of the distance is interpolated [s]."""
_AHEAD = LAG_STEP * np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0])
_LAGS = np.concatenate((-_AHEAD[::-1], [0.0], _AHEAD))
_QUANTITIES = ("angle", "velocity", "torque")
_TESTS = 9
"""Tests that may each result in "not equivalent"."""
_BLOCKS = (6, 20)
"""Fewest and most blocks of a run: fewer make wide intervals, and those of short blocks are not independent."""
_BLOCK_TIME = 2.0
"""Length of a block between those bounds [s]."""

Statistic = Callable[[Array, Array], Array]
"""Maps the long-run covariance of the motions, shape (..., m, m), and their means, shape (..., m), to values."""


@dataclass(frozen=True)
class Looks:
    """The number of interim analyses, and the share of the error that is left for this one.

    The k-th analysis may err with probability alpha 2^-k on each side of a margin: over all analyses, for any number of
    them and any stopping rule, that is at most alpha (union bound). Each should have about twice the data of the one
    before, so that the wider intervals cost little: Student's quantile grows with the root of k, the error halves with
    every second analysis.

    Args:
        number: 1 for the first analysis; 0 where data are analysed once, and never added to.
        alpha: Probability of an error on one side of a margin over all analyses.
    """

    number: int = 0
    alpha: float = 0.05

    @property
    def level(self) -> float:
        """Probability of the interval of this analysis, which is two one-sided tests."""
        return 1.0 - 2.0 * self.alpha * 0.5**self.number

    def level_of_each(self, tests: int) -> float:
        """Return the probability of the interval that shows a difference, where any of all tests may."""
        return 1.0 - (1.0 - self.level) / tests


@dataclass(frozen=True)
class _Kind:
    """What all tests of some motions have in common.

    Args:
        looks: Number of interim analyses.
        runs: Runs that the intervals rest on.
        slides: Whether the motions are those of a joint that slides.
        driven: Whether any of them had a controller's torque: 0 and 0 are no test.
        runs_differ: Whether runs may differ by more than their seeds.
    """

    looks: Looks
    runs: int
    slides: bool
    driven: bool
    runs_differ: bool

    @classmethod
    def of(
        cls,
        motions: Sequence[Series],
        margins: Margins,
        looks: Looks,
        runs: int,
        runs_differ: bool,
    ) -> _Kind:
        slides = any(one.slides for one in motions)
        if slides:
            _refuse_angles(margins)
        return cls(looks, runs, slides, any(np.ptp(one.effort) > 0.0 for one in motions), runs_differ)

    def name(self, quantity: str) -> str:
        """Return the field's word for a quantity: what slides has a position, and a force instead of a torque."""
        return (
            {"angle": "position", "angles": "positions", "torque": "force"}.get(quantity, quantity)
            if self.slides
            else quantity
        )


def _refuse_angles(margins: Margins) -> None:
    for name in ("spread_angle", "spread_velocity", "spread_torque", "path_angle", "path_velocity"):
        margin: Margin = getattr(margins, name)
        if not margin.is_share:
            raise ParameterError(
                f"margin {name} is {margin}, and this joint slides; expected a share of its spread, such as 15 %"
            )


def paired_tests(
    pairs: Sequence[tuple[Series, Series]],
    margins: Margins,
    *,
    noises: Sequence[Disturbance | None] = (),
    looks: Looks = Looks(),
    runs_differ: bool = True,
) -> list[EquivalenceTest]:
    """Test all pairs together.

    Args:
        pairs: Simulation and hardware of each run under one disturbance, on one clock.
        margins: The margins.
        noises: The disturbance of each run on that clock, where it is white and known.
        looks: Number of interim analyses of these data.
        runs_differ: Whether runs may differ by more than their seeds.
    """
    band = min(common_band(margins.band.si, *pair) for pair in pairs)
    seen = [_Seen(*pair, band) for pair in pairs]
    # The delay is where the distance is smallest: to first order, its error does not change the distances that are
    # left, so they may be counted as if it were known.
    centre = _find_delay(seen)
    noises = noises or (None,) * len(pairs)
    runs = [_Run.of(one.clock, one.motions(centre or 0.0), noise) for one, noise in zip(seen, noises, strict=True)]
    kind = _Kind.of([one for pair in pairs for one in pair], margins, looks, len(pairs), runs_differ)
    later = len(_QUANTITIES)
    tests = [_mean_test([runs], _LATE, _LATE + later, margins, kind)]
    tests += _spread_tests([runs], _LATE, _LATE + later, margins, kind)
    tests.append(_no_delay(margins, kind) if centre is None else _delay_test(seen, centre, margins, kind))
    for first, note in ((0, ""), (_LATE, " less the delay")):
        if centre is None and first:
            continue  # nothing was taken out
        step = 2 if first == 0 else later
        for index, (what, margin) in enumerate((("angle", margins.path_angle), ("velocity", margins.path_velocity))):
            tests.append(_path_test(runs, (first + index, first + index + step), f"{what}{note}", margin, kind))
    return tests


def unpaired_tests(
    simulations: Sequence[Series],
    hardware: Sequence[Series],
    margins: Margins,
    *,
    noises: tuple[Sequence[Disturbance | None], Sequence[Disturbance | None]] = ((), ()),
    looks: Looks = Looks(),
    runs_differ: bool = True,
) -> list[EquivalenceTest]:
    """Test means and spreads of runs that share no disturbance, simulation and hardware each by itself.

    Args:
        simulations: Motions of the simulation.
        hardware: Motions of the hardware.
        margins: The margins.
        noises: The disturbances of both, each on its motion's clock, where they are white and known.
        looks: Number of interim analyses of these data.
        runs_differ: Whether runs may differ by more than their seeds.
    """
    band = common_band(margins.band.si, *simulations, *hardware)
    period = max(one.period for one in (*simulations, *hardware))
    sides = []
    for series, known in zip((simulations, hardware), noises, strict=True):
        runs = []
        for one, noise in zip(series, known or (None,) * len(series), strict=True):
            clock = SlowClock(uniform_times(float(one.t[0]), float(one.t[-1]), period), band)
            runs.append(_Run.of(clock, clock.filtered(_values(one.interpolated(clock.times))), noise))
        sides.append(runs)
    kind = _Kind.of([*simulations, *hardware], margins, looks, min(map(len, sides)), runs_differ)
    return [_mean_test(sides, 0, 0, margins, kind), *_spread_tests(sides, 0, 0, margins, kind)]


# -- motions -----------------------------------------------------------------------------------------------------

_LATE = 4
"""First column of the motions with the delay taken out; before it, angles and velocities as they are."""


def _values(motion: Series) -> Array:
    # Around upright, so that squares do not drown the variance.
    return np.stack([motion.position - np.pi, motion.velocity, motion.effort], axis=1)


class _Seen:
    """Two motions at the stamps of the slower one, the simulation earlier by any delay."""

    def __init__(self, simulation: Series, hardware: Series, band: float) -> None:
        start = max(simulation.t[0], hardware.t[0]) + LONGEST_DELAY
        stop = min(simulation.t[-1], hardware.t[-1]) - LONGEST_DELAY
        self.simulation, self.hardware = simulation, hardware
        self.is_slower = simulation.period > 1.01 * hardware.period
        stamps = (simulation if self.is_slower else hardware).t
        self.clock = SlowClock(stamps[(stamps >= start) & (stamps <= stop)], band)

    def _both(self, delay: float) -> tuple[Array, Array]:
        """Return simulation and hardware, each with angle, velocity and torque, shape (n, 3), band-limited."""
        times = self.clock.times
        shifts = (0.0, delay) if self.is_slower else (-delay, 0.0)
        first, second = (
            self.clock.filtered(_values(one.interpolated(times + shift)))
            for one, shift in zip((self.simulation, self.hardware), shifts, strict=True)
        )
        return first, second

    def motions(self, delay: float) -> Array:
        """Return angle and velocity of both sides, then all three with the delay taken out, shape (n, 10)."""
        now, late = self._both(0.0), self._both(delay)
        return np.concatenate((now[0][:, :2], now[1][:, :2], *late), axis=1)

    def lagged(self, lags: Array) -> tuple[Array, Array, Array]:
        """Return the simulation's velocity earlier by each lag and its slope, shape (n, len(lags)), and the hardware's.

        Where the simulation is the slower one, it is the hardware's that moves, the other way; the sides are exchanged.
        The slope is that to the sample before: at the times at which the noise changes, the two sides of it differ.
        """
        times = self.clock.times
        moving, still = (self.hardware, self.simulation) if self.is_slower else (self.simulation, self.hardware)
        curve = scipy.interpolate.CubicSpline(moving.t, moving.velocity)
        grid = times[:, None] + (1.0 if self.is_slower else -1.0) * lags[None, :]
        values, before = (
            self.clock.filtered(curve(np.clip(at, moving.t[0], moving.t[-1]))) for at in (grid, grid - moving.period)
        )
        own = scipy.interpolate.CubicSpline(still.t, still.velocity)(times)[:, None]
        return values, values - before, self.clock.filtered(own)


class _Run(NamedTuple):
    """The statistics of one run.

    Args:
        spread: Long-run covariance of the motions; of all samples, then without each block, shape (1 + g, m, m).
        mean: Means of the motions, shape (1 + g, m).
        sizes: Samples of each of these, shape (1 + g,).
    """

    spread: Array
    mean: Array
    sizes: Array

    @classmethod
    def of(cls, clock: SlowClock, motions: Array, noise: Disturbance | None) -> _Run:
        found = moments(clock, motions, noise, _blocks(clock))
        products = np.concatenate((np.zeros_like(found.products[:1]), found.products))
        sizes = np.concatenate(([0.0], found.sizes))
        left = sizes.sum() - sizes
        spread, mean = covariance(found.products.sum(axis=0) - products, left, found)
        return cls(spread, mean, left)


def _blocks(clock: SlowClock) -> int:
    duration = float(clock.times[-1] - clock.times[0])
    return int(np.clip(duration / _BLOCK_TIME, *_BLOCKS))


def _jackknife(runs: Sequence[_Run], statistic: Statistic, kind: _Kind) -> Jackknife:
    """Return a statistic of all runs together; a run counts by its samples."""
    sizes = [run.sizes[0] for run in runs]
    whole = [sum(size * run[i][0] for size, run in zip(sizes, runs, strict=True)) for i in range(2)]
    without: list[list[Array]] = [[], []]
    total = []
    for size, run in zip(sizes, runs, strict=True):
        left = run.sizes[1:]
        total.append(sum(sizes) - size + left)
        for i in range(2):
            shape = (-1, *(1,) * (run[i].ndim - 1))
            without[i].append(whole[i] - size * run[i][0] + left.reshape(shape) * run[i][1:])
    counts = np.concatenate(total)
    parts = [np.concatenate(one) / counts.reshape((-1, *(1,) * (one[0].ndim - 1))) for one in without]
    alone = None
    if kind.runs_differ:
        alone = np.array([float(statistic(run.spread[0], run.mean[0])) for run in runs])
    return Jackknife.of(float(statistic(whole[0] / sum(sizes), whole[1] / sum(sizes))), statistic(*parts), alone)


# -- the delay ---------------------------------------------------------------------------------------------------


def _find_delay(seen: Sequence[_Seen]) -> float | None:
    """Return the delay at which the velocities are most alike, over all runs, to a whole ``LAG_STEP`` [s].

    Returns:
        The delay; None where they are most alike at an end of the searched range, which is no peak, or where they are
        hardly alike even there: for a delay beyond the range, the noise has small peaks.
    """
    reach = LONGEST_DELAY - float(_LAGS[-1])
    lags = np.arange(-reach, reach + 0.5 * LAG_STEP, LAG_STEP)
    products = squares = np.zeros(lags.size)
    power = 0.0
    for one in seen:
        moving, _, still = one.lagged(lags)
        products = products + (moving * still).sum(axis=0)
        squares = squares + (moving**2).sum(axis=0)
        power += float((still**2).sum())
    likeness = _likeness(products, squares)
    best = int(np.argmax(likeness))
    alike = float(likeness[best]) >= LEAST_LIKENESS * math.sqrt(power)
    return float(lags[best]) if alike and 0 < best < lags.size - 1 else None


def _likeness(products: Array, squares: Array) -> Array:
    """Return the correlation of two velocities at each lag, but for a factor that is the same at all."""
    return np.asarray(products / np.sqrt(np.maximum(squares, 1e-300)))


def _lag(sums: Array) -> Array:
    """Return the lag, from the middle one of ``_LAGS``, at which the distance of the velocities is smallest.

    There, what the scaled velocity leaves of the other is orthogonal to its slope. The distance itself would mislead:
    where the slower plant samples as the noise changes, it rises faster on one side than on the other.

    Args:
        sums: Of products, squares, slopes times the other velocity and slopes times the own, shape (..., 4, lags).

    Returns:
        Shape (...).
    """
    products, squares, crossed, own = (sums[..., i, :] for i in range(4))
    best = np.clip(np.argmax(_likeness(products, squares), axis=-1), 1, _LAGS.size - 2)
    rise = crossed - products / np.maximum(squares, 1e-300) * own
    x = [_LAGS[best + i] for i in (-1, 0, 1)]
    y = [np.take_along_axis(rise, (best + i)[..., None], axis=-1)[..., 0] for i in (-1, 0, 1)]
    # A later copy of the moving velocity has a slope of the other sign; the zero lies on the side where it changes.
    ahead = np.asarray(y[1] * y[2] <= 0.0)
    left, right = np.where(ahead, x[1], x[0]), np.where(ahead, x[2], x[1])
    low, high = np.where(ahead, y[1], y[0]), np.where(ahead, y[2], y[1])
    share = np.where(low * high <= 0.0, low / np.where(low == high, 1.0, low - high), np.where(ahead, 0.0, 1.0))
    return np.asarray(left + np.clip(share, 0.0, 1.0) * (right - left))


def _delay_test(seen: Sequence[_Seen], centre: float, margins: Margins, kind: _Kind) -> EquivalenceTest:
    parts, alone = [], []
    for one in seen:
        moving, slope, still = one.lagged(centre + _LAGS)
        columns = np.stack((moving * still, moving**2, slope * still, slope * moving), axis=1)
        edges = np.linspace(0, len(columns), _blocks(one.clock) + 1).astype(int)
        blocks = np.add.reduceat(columns, edges[:-1], axis=0)
        parts.append(blocks)
        alone.append(float(_lag(blocks.sum(axis=0))))
    blocks = np.concatenate(parts)
    whole = blocks.sum(axis=0)
    found = Jackknife.of(
        centre + float(_lag(whole)),
        centre + _lag(whole - blocks),
        centre + np.array(alone) if kind.runs_differ else None,
    )
    return _within(found, "delay", margins.delay, kind)


def _no_delay(margins: Margins, kind: _Kind) -> EquivalenceTest:
    """Return the test of a delay that the motions do not show: anything in the searched range may be it."""
    margin, scale = margins.delay, margins.delay.per_si
    end = scale * LONGEST_DELAY
    interval = Interval(math.nan, -end, end, kind.looks.level, math.nan, 1)
    test = equivalence_test("delay", margin.unit, interval, -margin.value, margin.value, runs=kind.runs)
    # However wide the margin, the delay may lie beyond the searched range.
    return replace(test, outcome=Outcome.UNDECIDED, more_runs=None, smallest_margin=math.nan)


# -- tests -------------------------------------------------------------------------------------------------------


def _mean_test(
    sides: Sequence[Sequence[_Run]], below: int, above: int, margins: Margins, kind: _Kind
) -> EquivalenceTest:
    margin = margins.mean_position if kind.slides else margins.mean_angle
    found = _difference(sides, lambda _, mean: mean[..., below], lambda _, mean: mean[..., above], kind)
    return _within(found, f"mean {kind.name('angle')} difference", margin, kind)


def _difference(sides: Sequence[Sequence[_Run]], below: Statistic, above: Statistic, kind: _Kind) -> Jackknife:
    """Return what the hardware has more than the simulation: of pairs together, of two sides each by itself."""
    if len(sides) == 1:
        return _jackknife(sides[0], lambda spread, mean: above(spread, mean) - below(spread, mean), kind)
    first, second = (_jackknife(runs, one, kind) for runs, one in zip(sides, (below, above), strict=True))
    return second.less(first)


def _within(found: Jackknife, name: str, margin: Margin, kind: _Kind) -> EquivalenceTest:
    """Test a statistic in SI units against a margin on both sides."""
    return _test(found, name, margin.unit, (-margin.value, margin.value), kind, lambda value: margin.per_si * value)


def _test(
    found: Jackknife,
    name: str,
    unit: str,
    ends: tuple[float, float],
    kind: _Kind,
    scale: Callable[[float], float],
    *,
    ratio: bool = False,
) -> EquivalenceTest:
    inside, outside = (found.interval(level, scale) for level in (kind.looks.level, kind.looks.level_of_each(_TESTS)))
    return equivalence_test(name, unit, inside, *ends, outside=outside, runs=kind.runs, ratio=ratio)


def _log_spread(column: int) -> Statistic:
    return lambda spread, _: 0.5 * np.log(np.maximum(spread[..., column, column], 1e-300))


def _spread(column: int) -> Statistic:
    return lambda spread, _: np.sqrt(np.maximum(spread[..., column, column], 0.0))


def _spread_tests(
    sides: Sequence[Sequence[_Run]], simulation: int, hardware: int, margins: Margins, kind: _Kind
) -> list[EquivalenceTest]:
    """Test the spreads; angle, velocity and torque of the two sides begin at the columns given."""
    tests = []
    for index, what in enumerate(_QUANTITIES):
        if what == "torque" and not kind.driven:
            continue
        margin: Margin = getattr(margins, f"spread_{what}")
        size = _log_spread if margin.is_share else _spread
        found = _difference(sides, size(simulation + index), size(hardware + index), kind)
        if margin.is_share:
            top = 1.0 + margin.si
            name = f"spread of {kind.name(what)} (ratio)"
            tests.append(_test(found, name, "-", (1.0 / top, top), kind, math.exp, ratio=True))
        else:
            tests.append(_within(found, f"spread of {kind.name(what)} difference", margin, kind))
    return tests


def _path_test(
    runs: Sequence[_Run], columns: tuple[int, int], what: str, margin: Margin, kind: _Kind
) -> EquivalenceTest:
    """Test the distance of two motions, the simulation's and the hardware's."""
    a, b = columns

    def distance(spread: Array, mean: Array) -> Array:
        square = spread[..., a, a] + spread[..., b, b] - 2.0 * spread[..., a, b] + (mean[..., b] - mean[..., a]) ** 2
        per = np.maximum(spread[..., b, b], 1e-300) if margin.is_share else 1.0
        return np.asarray(np.sqrt(np.maximum(square, 0.0) / per))

    quantity, _, note = what.partition(" ")
    name = f"distance of {'velocities' if quantity == 'velocity' else kind.name('angles')} {note}".rstrip()
    factor = 100.0 if margin.is_share else margin.per_si
    found = _jackknife(runs, distance, kind)
    return _test(found, name, margin.unit, (-math.inf, margin.value), kind, lambda value: factor * max(value, 0.0))
