"""Tests of the first layer: do simulation and hardware move alike under one controller and one disturbance?

Both motions are looked at at the same phases of the disturbance and limited to one band. Every statistic is a function
of means of columns of those samples, so that one block bootstrap, which draws the same times from both, gives all
intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.band import BandLimited, SlowClock, common_band
from pendulum_bags.comparison.equivalence import EquivalenceTest, Outcome, equivalence_test
from pendulum_bags.comparison.margins import Margin, Margins
from pendulum_bags.comparison.statistics import Interval, Resampled, bootstrap_interval, resample
from pendulum_bags.runs.series import Series
from pendulum_msgs_py.errors import ParameterError

__all__ = ["Looks", "paired_tests", "unpaired_tests"]

LONGEST_DELAY = 0.1
"""Delays beyond this are not looked for [s]."""
LEAST_LIKENESS = 0.5
"""Correlation of the velocities from which a peak is a delay: 0.92 beside 1 N m of dry friction, 0.13 by chance."""
LAG_STEP = 0.001
"""Resolution of the lags near the delay; a parabola through three distances tells a fraction of it [s]."""
_AHEAD = LAG_STEP * np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0])
_LAGS = np.concatenate((-_AHEAD[::-1], [0.0], _AHEAD))
_QUANTITIES = ("angle", "velocity", "torque")
_SIMULATION, _HARDWARE, _LIKENESS = 5, 11, 17
"""First columns of the moments of either side, and of the products and squares of velocities at each lag."""

Statistic = Callable[[Array], Array]


@dataclass(frozen=True)
class Looks:
    """How often data have been looked at, and what that leaves for the error of this look.

    The k-th look may err with probability alpha 2^-k on each side of a margin: over all looks, however many there will
    be and whenever one stops, that is at most alpha (union bound). Each look should have about twice the data of the
    one before, so that the wider intervals cost little: Student's quantile grows with the root of k, the error halves
    with every second look.

    Args:
        number: 1 for the first look; 0 where data are looked at once, and never added to.
        alpha: Probability of an error on one side of a margin over all looks.
    """

    number: int = 0
    alpha: float = 0.05

    @property
    def level(self) -> float:
        """Probability of the interval of this look, which is two one-sided tests."""
        return 1.0 - 2.0 * self.alpha * 0.5**self.number


@dataclass(frozen=True)
class _Kind:
    """What all tests of some motions have in common.

    Args:
        looks: How often the data have been looked at.
        runs: Runs that the intervals rest on.
        slides: Whether the motions are those of a joint that slides.
        driven: Whether any of them had a controller's torque: 0 beside 0 is no test.
    """

    looks: Looks
    runs: int
    slides: bool
    driven: bool

    @classmethod
    def of(cls, motions: Sequence[Series], margins: Margins, looks: Looks, runs: int) -> _Kind:
        slides = any(one.slides for one in motions)
        if slides:
            _refuse_angles(margins)
        return cls(looks, runs, slides, any(np.ptp(one.effort) > 0.0 for one in motions))

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
    looks: Looks = Looks(),
    runs_differ: bool = True,
) -> list[EquivalenceTest]:
    """Test all pairs together.

    Args:
        pairs: Simulation and hardware of each run under one disturbance, on one clock.
        margins: The margins.
        looks: How often these data have been looked at.
        runs_differ: Whether runs may differ by more than their seeds.
    """
    band = min(common_band(margins.band.si, *pair) for pair in pairs)
    seen = [_Seen(*pair, band) for pair in pairs]
    # The delay is where the velocities are most alike. That is an extremum: to first order, an error of the delay does
    # not change the distances that are left, so they may be counted as if it were known.
    centre = _find_delay(seen)
    columns = [one.columns(centre or 0.0) for one in seen]
    resampled = resample(columns, runs_differ=runs_differ)
    kind = _Kind.of([one for pair in pairs for one in pair], margins, looks, len(pairs))
    tests = [_mean_test(resampled, lambda means: np.asarray(means[..., 0]), margins, kind)]
    tests += _spread_tests(resampled, _SIMULATION, _HARDWARE, margins, kind)
    if centre is None:
        tests.append(_no_delay(margins, kind))
    else:
        tests.append(_within(resampled, "delay", lambda means: centre + _lag(means), margins.delay, kind))
    for index, what, margin in (
        (1, "angle", margins.path_angle),
        (2, "velocity", margins.path_velocity),
        (3, "angle", margins.path_angle),
        (4, "velocity", margins.path_velocity),
    ):
        if centre is None and index > 2:
            continue  # nothing was taken out
        tests.append(_path_test(resampled, index, what, margin, kind))
    return tests


def unpaired_tests(
    simulations: Sequence[Series],
    hardware: Sequence[Series],
    margins: Margins,
    *,
    looks: Looks = Looks(),
    runs_differ: bool = True,
) -> list[EquivalenceTest]:
    """Test means and spreads of runs that share no disturbance; each side is resampled on its own."""
    band = common_band(margins.band.si, *simulations, *hardware)
    period = max(one.period for one in (*simulations, *hardware))
    sides = []
    for seed, runs in enumerate((simulations, hardware), start=1):
        columns = []
        for run in runs:
            times = np.arange(run.t[0], run.t[-1], period)
            columns.append(np.stack(_moments(BandLimited(run, band).at(times)), axis=1))
        sides.append(resample(columns, seed=seed, runs_differ=runs_differ))
    # One object with the columns of both sides, so that the same statistics apply.
    joined = Resampled(
        np.concatenate([side.means for side in sides]),
        np.concatenate([side.draws for side in sides], axis=1),
        np.concatenate([side.within for side in sides], axis=1),
        min(side.blocks for side in sides),
        min(side.runs for side in sides),
    )
    count = sides[0].means.size
    kind = _Kind.of([*simulations, *hardware], margins, looks, min(len(simulations), len(hardware)))
    mean = _mean_test(joined, lambda means: np.asarray(means[..., count] - means[..., 0]), margins, kind)
    return [mean, *_spread_tests(joined, 0, count, margins, kind)]


# -- columns -----------------------------------------------------------------------------------------------------


def _moments(values: tuple[Array, Array, Array]) -> list[Array]:
    """Return value and square of angle, velocity and torque."""
    position, velocity, effort = values
    # Around upright, so that x^2 does not drown the variance in the square of the mean.
    return [column for one in (position - np.pi, velocity, effort) for column in (one, one**2)]


class _Seen:
    """Two motions at the stamps of the slower one, the simulation earlier by any delay."""

    def __init__(self, simulation: Series, hardware: Series, band: float) -> None:
        start = max(simulation.t[0], hardware.t[0]) + LONGEST_DELAY
        stop = min(simulation.t[-1], hardware.t[-1]) - LONGEST_DELAY
        self.simulation, self.hardware = simulation, hardware
        self.is_slower = simulation.period > 1.01 * hardware.period
        stamps = (simulation if self.is_slower else hardware).t
        self.clock = SlowClock(stamps[(stamps >= start) & (stamps <= stop)], band)

    def both(self, delay: float) -> tuple[Array, Array]:
        """Return simulation and hardware, each with angle, velocity and torque, shape (n, 3), band-limited."""
        times = self.clock.times
        shifts = (0.0, delay) if self.is_slower else (-delay, 0.0)
        found = []
        for one, shift in zip((self.simulation, self.hardware), shifts, strict=True):
            part = one.interpolated(times + shift)
            values = np.stack([part.position - np.pi, part.velocity, part.effort], axis=1)
            found.append(self.clock.filtered(values))
        return found[0], found[1]

    def lagged(self, lags: Array) -> tuple[Array, Array]:
        """Return the simulation's velocity earlier by each lag, shape (n, len(lags)), and the hardware's, shape (n, 1).

        Where the simulation is the slower one, it is the hardware's that moves, the other way; the sides are exchanged.
        """
        times = self.clock.times
        moving, still = (self.hardware, self.simulation) if self.is_slower else (self.simulation, self.hardware)
        grid = times[:, None] + (1.0 if self.is_slower else -1.0) * lags[None, :]
        values = scipy.interpolate.CubicSpline(moving.t, moving.velocity)(np.clip(grid, moving.t[0], moving.t[-1]))
        own = scipy.interpolate.CubicSpline(still.t, still.velocity)(times)[:, None]
        return self.clock.filtered(values), self.clock.filtered(own)

    def columns(self, delay: float) -> Array:
        """Return the columns of which all statistics are functions."""
        a, b = self.both(0.0)
        earlier, later = self.both(delay)
        rows = [b[:, 0] - a[:, 0], (b[:, 0] - a[:, 0]) ** 2, (b[:, 1] - a[:, 1]) ** 2]
        rows += [(later[:, 0] - earlier[:, 0]) ** 2, (later[:, 1] - earlier[:, 1]) ** 2]
        # Spreads with the delay taken out: both sides at one phase of the disturbance.
        rows += [column for side in (earlier, later) for one in side.T for column in (one, one**2)]
        moving, still = self.lagged(delay + _LAGS)
        return np.concatenate((np.stack(rows, axis=1), moving * still, moving**2), axis=1)


def _find_delay(seen: Sequence[_Seen]) -> float | None:
    """Return the delay at which the velocities are most alike, over all runs, to a whole ``LAG_STEP`` [s].

    Returns:
        The delay; None where they are most alike at an end of what is looked at, which is no peak, or where they are
        hardly alike even there: of a machine that is later than all that is looked at, the noise has small peaks.
    """
    reach = LONGEST_DELAY - float(_LAGS[-1])
    lags = np.arange(-reach, reach + 0.5 * LAG_STEP, LAG_STEP)
    products = squares = np.zeros(lags.size)
    power = 0.0
    for one in seen:
        moving, still = one.lagged(lags)
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


# -- statistics --------------------------------------------------------------------------------------------------


def _variance(means: Array, first: int) -> Array:
    """Return the variance from the means of x and x^2 in two neighbouring columns."""
    return np.maximum(np.asarray(means[..., first + 1] - means[..., first] ** 2), 1e-300)


def _lag(means: Array) -> Array:
    """Return the lag, from the middle one of ``_LAGS``, at which the velocities are most alike, shape (...).

    The parabola through the highest correlation and its neighbours tells a fraction of a step. More distant ones would
    mislead: where the slower plant samples as the noise changes, it falls faster on one side than on the other.
    """
    first = _LIKENESS
    alike = _likeness(means[..., first : first + _LAGS.size], means[..., first + _LAGS.size : first + 2 * _LAGS.size])
    best = np.clip(np.argmax(alike, axis=-1), 1, _LAGS.size - 2)
    x = [_LAGS[best + i] for i in (-1, 0, 1)]
    y = [np.take_along_axis(alike, (best + i)[..., None], axis=-1)[..., 0] for i in (-1, 0, 1)]
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    bend = np.minimum((right - left) / (x[2] - x[0]), -1e-300)
    return np.asarray(np.clip(0.5 * (x[0] + x[1]) - 0.5 * left / bend, x[0], x[2]))


# -- tests -------------------------------------------------------------------------------------------------------


def _mean_test(resampled: Resampled, statistic: Statistic, margins: Margins, kind: _Kind) -> EquivalenceTest:
    margin = margins.mean_position if kind.slides else margins.mean_angle
    return _within(resampled, f"mean {kind.name('angle')} difference", statistic, margin, kind)


def _within(resampled: Resampled, name: str, statistic: Statistic, margin: Margin, kind: _Kind) -> EquivalenceTest:
    """Test a statistic in SI units against a margin on both sides."""
    scale = margin.per_si
    interval = bootstrap_interval(resampled, lambda means: scale * statistic(means), level=kind.looks.level)
    return equivalence_test(name, margin.unit, interval, -margin.value, margin.value, runs=kind.runs)


def _spread_tests(
    resampled: Resampled, simulation: int, hardware: int, margins: Margins, kind: _Kind
) -> list[EquivalenceTest]:
    """Test the spreads; the moments of the two sides begin at the columns given."""
    tests = []
    for index, what in enumerate(_QUANTITIES):
        if what == "torque" and not kind.driven:
            continue
        margin: Margin = getattr(margins, f"spread_{what}")
        tests.append(_spread_test(resampled, simulation + 2 * index, hardware + 2 * index, what, margin, kind))
    return tests


def _spread_test(
    resampled: Resampled, below: int, above: int, what: str, margin: Margin, kind: _Kind
) -> EquivalenceTest:
    if not margin.is_share:

        def difference(means: Array) -> Array:
            return np.asarray(np.sqrt(_variance(means, above)) - np.sqrt(_variance(means, below)))

        return _within(resampled, f"spread of {kind.name(what)} difference", difference, margin, kind)
    interval = bootstrap_interval(
        resampled,
        lambda means: np.asarray(np.sqrt(_variance(means, above) / _variance(means, below))),
        level=kind.looks.level,
    )
    top = 1.0 + margin.si
    return equivalence_test(
        f"spread of {kind.name(what)} (ratio)", "-", interval, 1.0 / top, top, runs=kind.runs, ratio=True
    )


def _no_delay(margins: Margins, kind: _Kind) -> EquivalenceTest:
    """Return the test of a delay that the motions do not tell: anything that was looked for may be it."""
    margin, scale = margins.delay, margins.delay.per_si
    end = scale * LONGEST_DELAY
    interval = Interval(math.nan, -end, end, kind.looks.level, math.nan, 1)
    test = equivalence_test("delay", margin.unit, interval, -margin.value, margin.value, runs=kind.runs)
    # However wide the margin, the delay may lie beyond all that was looked for.
    return replace(test, outcome=Outcome.UNDECIDED, more_runs=None, smallest_margin=math.nan)


def _path_test(resampled: Resampled, index: int, what: str, margin: Margin, kind: _Kind) -> EquivalenceTest:
    own = _HARDWARE + 2 * _QUANTITIES.index(what)

    def distance(means: Array) -> Array:
        size = np.sqrt(np.maximum(means[..., index], 0.0))
        if margin.is_share:
            return np.asarray(100.0 * size / np.sqrt(_variance(means, own)))
        return np.asarray(margin.per_si * size)

    interval = bootstrap_interval(resampled, distance, level=kind.looks.level)
    name = f"distance of {'velocities' if what == 'velocity' else kind.name('angles')}"
    if index > 2:
        name += " less the delay"
    return equivalence_test(name, margin.unit, interval, -math.inf, margin.value, runs=kind.runs)
