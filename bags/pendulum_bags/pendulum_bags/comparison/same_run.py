"""Tests of the first layer: do simulation and hardware move alike under one controller and one disturbance?

Estimands, each over an endless run under the same noise, both motions at the slower plant's sampling times and
band-limited: the difference of the means; the ratio of the standard deviations; the delay at which the simulation's
velocity is nearest to the hardware's; the rms distance per standard deviation of the hardware, with and without that
delay. Where runs differ by more than their seeds (real time: random phase between the loops), it is the mean over runs;
of a single run, and for distances with the delay left in, it is that of these runs.

Long-run variances are from :mod:`pendulum_bags.comparison.long_run`, all intervals from a jackknife over blocks of
time, plus systematic errors: half a millisecond of the delay, and the correction for the window's own mean where the
noise is not known. :class:`Looks` states the error rates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.band import SlowClock, common_band
from pendulum_bags.comparison.equivalence import EquivalenceTest, Outcome, equivalence_test
from pendulum_bags.comparison.long_run import Disturbance, covariance, moments
from pendulum_bags.comparison.margins import Margin, Margins
from pendulum_bags.comparison.statistics import Interval, Jackknife, exponential
from pendulum_bags.runs.series import Series, uniform_times
from pendulum_msgs_py.errors import ParameterError

__all__ = ["Looks", "paired_tests", "unpaired_tests"]

LONGEST_DELAY = 0.1
"""Largest delay of the search [s]."""
LEAST_LIKENESS = 0.5
"""Correlation of the velocities from which a peak is a delay: 0.92 with 1 N m of dry friction, 0.13 by chance."""
RESOLUTION = 1e-3
"""No interval is narrower on either side, as a share of a standard deviation: neither integration nor the recording of
a motion is more exact."""
LAG_STEP = 0.001
"""Resolution of the lags near the delay; between two of them the slope of the distance is interpolated [s]."""
DEFINITION = 0.5 * LAG_STEP
"""Where two motions are most alike, where they are nearest and where they begin differ by up to 0.25 ms in loops whose
plants differ by 15 %: what a delay is, is a matter of definition to about twice that [s]."""
_NEAR = 1.5 * DEFINITION
"""By how much the delay may be another where it is taken out: a velocity's spread has a kink at whole periods [s]."""
_AHEAD = LAG_STEP * np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0])
_LAGS = np.concatenate((-_AHEAD[::-1], [0.0], _AHEAD))
_QUANTITIES = ("angle", "velocity", "torque")
_TESTS = 9
"""Tests that may each result in "not equivalent"."""
_BLOCKS = (5, 20)
"""Fewest and most blocks of a run: fewer make wide intervals, and those of short blocks are not independent."""
_BLOCK_TIME = 2.0
"""Length of a block between those bounds [s]."""

Statistic = Callable[[Array, Array], Array]
"""Maps the long-run covariance of the motions, shape (..., m, m), and their means, shape (..., m), to values."""


@dataclass(frozen=True)
class Looks:
    """The number of interim analyses, and the share of the error that is left for this one.

    The k-th analysis may err with probability alpha 2^-k on each side of a margin: at most alpha over all analyses, for
    any stopping rule (union bound). Each should have about twice the data of the one before: Student's quantile grows
    with the root of k, the error halves with every second analysis.

    "Equivalent" needs each test's interval inside its margin, which errs with alpha at most for any number of tests
    (Berger, Technometrics 24, 1982). One test suffices for "not equivalent", so each of nine has its share of alpha
    (Bonferroni). Other layers of the verdict have errors of their own.

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

    @property
    def level_of_each(self) -> float:
        """Probability of the interval that shows a difference, where any of all tests may."""
        return 1.0 - (1.0 - self.level) / _TESTS

    @property
    def sentence(self) -> str:
        """How often the answers err, as text."""
        share = f"{100.0 * self.alpha:.3g} %"
        return (
            f"\u201cEquivalent\u201d needs all tests at {share} on a side, \u201cnot equivalent\u201d one of "
            f"{_TESTS} at {share} / {_TESTS}: each errs in at most {share} of experiments on a margin, over all "
            "interim analyses."
        )


@dataclass(frozen=True)
class _Kind:
    """What all tests of some motions have in common; ``driven`` if any had a controller's torque to test."""

    looks: Looks
    runs: int
    slides: bool
    driven: bool
    effort: str
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
        driven = any(np.ptp(one.effort) > 0.0 for one in motions)
        return cls(looks, runs, slides, driven, motions[0].effort_word, runs_differ)

    def name(self, quantity: str) -> str:
        """Return the field's word for a quantity: what slides has a position, and a force instead of a torque."""
        words = {"angle": "position", "angles": "positions"} if self.slides else {}
        return {**words, "torque": self.effort}.get(quantity, quantity)


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
    """Test all pairs together; ``noises`` are the white, known disturbances of the runs on their common clock."""
    band = min(common_band(margins.band.si, *pair) for pair in pairs)
    seen = [_Seen(*pair, band) for pair in pairs]
    kind = _Kind.of([one for pair in pairs for one in pair], margins, looks, len(pairs), runs_differ)
    centre = _find_delay(seen)
    delay, own = (None, [0.0] * len(seen)) if centre is None else _delay(seen, centre, kind)
    noises = noises or (None,) * len(pairs)
    runs = [
        _Run.of(one.clock, one.motions((late, late - _NEAR, late + _NEAR)), noise)
        for one, late, noise in zip(seen, own, noises, strict=True)
    ]
    later = len(_QUANTITIES)
    tests = [_mean_test([runs], _LATE, _LATE + later, margins, kind)]
    tests += _spread_tests([runs], _LATE, _LATE + later, margins, kind)
    tests.append(_within(delay, "delay", margins.delay, kind, DEFINITION) if delay else _no_delay(margins, kind))
    for first, note in ((0, ""), (_LATE, " less the delay")):
        if delay is None and first:
            continue  # nothing was taken out
        step = 2 if first == 0 else later
        # With the delay left in, few runs do not show the mean: it grows steeply with the phase.
        used = kind if first else replace(kind, runs_differ=False)
        for index, (what, margin) in enumerate((("angle", margins.path_angle), ("velocity", margins.path_velocity))):
            tests.append(_path_test(runs, (first + index, first + index + step), f"{what}{note}", margin, used))
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
    """Test means and spreads of runs without a common disturbance; ``noises`` are the white, known ones of both."""
    band = common_band(margins.band.si, *simulations, *hardware)
    period = max(one.period for one in (*simulations, *hardware))
    sides = []
    for series, known in zip((simulations, hardware), noises, strict=True):
        runs = []
        for one, noise in zip(series, known or (None,) * len(series), strict=True):
            clock = SlowClock(uniform_times(float(one.t[0]), float(one.t[-1]), period), band)
            runs.append(_Run.of(clock, [clock.filtered(_values(one.interpolated(clock.times)))], noise))
        sides.append(runs)
    kind = _Kind.of([*simulations, *hardware], margins, looks, min(map(len, sides)), runs_differ)
    return [_mean_test(sides, 0, 0, margins, kind), *_spread_tests(sides, 0, 0, margins, kind)]


# -- motions -----------------------------------------------------------------------------------------------------

_LATE = 4
"""First column of the motions with the delay taken out; before it, angles and velocities as they are."""


def _values(motion: Series) -> Array:
    # Around upright, for numerical precision.
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
        times = self.clock.times
        shifts = (0.0, delay) if self.is_slower else (-delay, 0.0)
        first, second = (
            self.clock.filtered(_values(one.interpolated(times + shift)))
            for one, shift in zip((self.simulation, self.hardware), shifts, strict=True)
        )
        return first, second

    def motions(self, delays: Sequence[float]) -> list[Array]:
        """Return angle and velocity of both sides, then all three with a delay taken out, shape (n, 10), for each."""
        now = [one[:, :2] for one in self._both(0.0)]
        return [np.concatenate((*now, *self._both(delay)), axis=1) for delay in delays]

    def lagged(self, lags: Array, *, sloped: bool = True) -> tuple[Array, Array, Array]:
        """Return the simulation's velocity earlier by each lag and its slope, shape (n, len(lags)), and the hardware's.

        Where the simulation is slower, both are exchanged. The slope is to the previous sample: it jumps with the
        noise.
        """
        times = self.clock.times
        moving, still = (self.hardware, self.simulation) if self.is_slower else (self.simulation, self.hardware)
        curve = scipy.interpolate.CubicSpline(moving.t, moving.velocity)
        grid = times[:, None] + (1.0 if self.is_slower else -1.0) * lags[None, :]
        values = self.clock.filtered(curve(np.clip(grid, moving.t[0], moving.t[-1])))
        before = values
        if sloped:
            before = self.clock.filtered(curve(np.clip(grid - moving.period, moving.t[0], moving.t[-1])))
        own = scipy.interpolate.CubicSpline(still.t, still.velocity)(times)[:, None]
        return values, values - before, self.clock.filtered(own)


@dataclass(frozen=True)
class _Run:
    """The statistics of one run.

    Args:
        spread: Long-run covariance of the motions; of all samples, then without each block, shape (1 + g, m, m).
        mean: Means of the motions, shape (1 + g, m).
        sizes: Samples of each of these, shape (1 + g,).
        near: Covariance and mean within the window, at the delay and at its bounds, shape (k, m, m) and (k, m).
    """

    spread: Array
    mean: Array
    sizes: Array
    near: tuple[Array, Array]
    short: float

    @classmethod
    def of(cls, clock: SlowClock, near: Sequence[Array], noise: Disturbance | None) -> _Run:
        """Return them of motions with the delay as it is, then as it might be too, shape (n, m) each."""
        found = moments(clock, near[0], noise, _blocks(clock))
        products, left, power = (
            one.sum(axis=0) - np.concatenate((np.zeros_like(one[:1]), one))
            for one in (found.products, found.sizes, found.noise)
        )
        spread, mean = covariance(products, left, power, found)
        within = np.stack([np.cov(one.T, bias=True) for one in near]), np.stack([one.mean(axis=0) for one in near])
        short = 0.0 if found.known else float(np.log(found.short.max()))
        return cls(spread, mean, left, within, short)


def _blocks(clock: SlowClock) -> int:
    duration = float(clock.times[-1] - clock.times[0])
    return int(np.clip(duration / _BLOCK_TIME, *_BLOCKS))


def _jackknife(runs: Sequence[_Run], statistic: Statistic, kind: _Kind) -> Jackknife:
    """Return a statistic of all runs together, weighted by their samples."""
    m = runs[0].mean.shape[-1]
    sums = [
        np.column_stack((run.spread.reshape(-1, m * m), run.mean, np.ones_like(run.sizes))) * run.sizes[:, None]
        for run in runs
    ]
    whole = np.sum([one[0] for one in sums], axis=0)
    parts = np.concatenate((whole[None], *(whole - one[0] + one[1:] for one in sums)))
    parts /= parts[:, -1:]
    values = statistic(parts[:, : m * m].reshape(-1, m, m), parts[:, m * m : -1])
    found = Jackknife.of(float(values[0]), values[1:])
    if not kind.runs_differ:
        return found
    alone = np.array([float(statistic(run.spread[0], run.mean[0])) for run in runs])
    return found.of_runs(alone, [run.sizes[0] for run in runs])


def _systematic(runs: Sequence[_Run], statistic: Statistic, size: float) -> float:
    """Return the systematic error; ``size`` is what shares are of, 1 for a logarithm."""
    values = [statistic(*run.near) for run in runs]
    late = float(np.mean([np.abs(one - one[0]).max() for one in values]))
    return late + size * (RESOLUTION + max(run.short for run in runs))


# -- the delay ---------------------------------------------------------------------------------------------------


def _find_delay(seen: Sequence[_Seen]) -> float | None:
    """Return the delay of the most alike velocities, to a whole ``LAG_STEP`` [s]; None without a peak."""
    reach = LONGEST_DELAY - float(_LAGS[-1])
    coarse = int(np.clip(0.1 / (seen[0].clock.band * LAG_STEP), 1.0, 10.0))
    end = round(reach / LAG_STEP)
    steps = np.append(np.arange(0, end, coarse), end)
    lags = LAG_STEP * np.concatenate((-steps[:0:-1], steps))
    best = int(np.argmax(_likenesses(seen, lags)[0]))
    fine = np.arange(lags[max(best - 1, 0)], lags[min(best + 1, lags.size - 1)] + 0.5 * LAG_STEP, LAG_STEP)
    likeness, power = _likenesses(seen, fine)
    best = int(np.argmax(likeness))
    alike = float(likeness[best]) >= LEAST_LIKENESS * math.sqrt(power)
    return float(fine[best]) if alike and abs(fine[best]) < reach - 0.5 * LAG_STEP else None


def _likenesses(seen: Sequence[_Seen], lags: Array) -> tuple[Array, float]:
    products = squares = np.zeros(lags.size)
    power = 0.0
    for one in seen:
        moving, _, still = one.lagged(lags, sloped=False)
        products = products + (moving * still).sum(axis=0)
        squares = squares + (moving**2).sum(axis=0)
        power += float((still**2).sum())
    return _likeness(products, squares), power


def _likeness(products: Array, squares: Array) -> Array:
    """Return the correlation of two velocities at each lag, up to a common factor."""
    return np.asarray(products / np.sqrt(np.maximum(squares, 1e-300)))


def _lag(sums: Array) -> Array:
    """Return the lag, from the middle one of ``_LAGS``, at which the velocities are nearest, shape (...).

    There the residual of the scaled velocity is orthogonal to its slope. The distance itself would mislead: where the
    slower plant samples as the noise changes, it rises faster on one side.

    Args:
        sums: Of products, squares, slopes times the other velocity and slopes times the own, shape (..., 4, lags).
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


def _delay(seen: Sequence[_Seen], centre: float, kind: _Kind) -> tuple[Jackknife, list[float]]:
    """Return the delay and what is taken out of each run [s]: its own, phase included, where runs differ."""
    parts, alone, sizes = [], [], []
    for one in seen:
        moving, slope, still = one.lagged(centre + _LAGS)
        columns = np.stack((moving * still, moving**2, slope * still, slope * moving), axis=1)
        edges = np.linspace(0, len(columns), _blocks(one.clock) + 1).astype(int)
        blocks = np.add.reduceat(columns, edges[:-1], axis=0)
        parts.append(blocks)
        alone.append(float(_lag(blocks.sum(axis=0))))
        sizes.append(len(columns))
    blocks = np.concatenate(parts)
    whole = blocks.sum(axis=0)
    found = Jackknife.of(centre + float(_lag(whole)), centre + _lag(whole - blocks))
    if not kind.runs_differ:
        return found, [found.estimate] * len(seen)
    return found.of_runs(centre + np.array(alone), sizes), [centre + one for one in alone]


def _no_delay(margins: Margins, kind: _Kind) -> EquivalenceTest:
    """Return the test of a delay that the motions do not show: any delay in the searched range is possible."""
    margin, scale = margins.delay, margins.delay.per_si
    end = scale * LONGEST_DELAY
    interval = Interval(math.nan, -end, end, kind.looks.level, math.nan, 1)
    test = equivalence_test("delay", margin.unit, interval, -margin.value, margin.value, runs=kind.runs)
    return replace(test, outcome=Outcome.UNDECIDED, more_runs=None, smallest_margin=math.nan)


# -- tests -------------------------------------------------------------------------------------------------------


def _mean_test(
    sides: Sequence[Sequence[_Run]], below: int, above: int, margins: Margins, kind: _Kind
) -> EquivalenceTest:
    margin = margins.mean_position if kind.slides else margins.mean_angle
    spread = max(float(_spread(above)(*run.near)[0]) for run in sides[-1])
    found, systematic = _difference(
        sides, lambda _, mean: mean[..., below], lambda _, mean: mean[..., above], kind, spread
    )
    return _within(found, f"mean {kind.name('angle')} difference", margin, kind, systematic)


def _difference(
    sides: Sequence[Sequence[_Run]], below: Statistic, above: Statistic, kind: _Kind, size: float = 1.0
) -> tuple[Jackknife, float]:
    """Return hardware minus simulation, of pairs or of two sides, and the systematic error."""
    if len(sides) == 1:

        def both(spread: Array, mean: Array) -> Array:
            return np.asarray(above(spread, mean) - below(spread, mean))

        return _jackknife(sides[0], both, kind), _systematic(sides[0], both, size)
    first, second = (_jackknife(runs, one, kind) for runs, one in zip(sides, (below, above), strict=True))
    errors = [_systematic(runs, one, size) for runs, one in zip(sides, (below, above), strict=True)]
    return second.less(first), max(errors)


def _within(found: Jackknife, name: str, margin: Margin, kind: _Kind, systematic: float = 0.0) -> EquivalenceTest:
    """Test a statistic in SI units against a margin on both sides; ``systematic`` is its systematic error."""
    ends = -margin.value, margin.value
    return _test(found, name, margin.unit, ends, kind, lambda value: margin.per_si * value, systematic=systematic)


def _test(
    found: Jackknife,
    name: str,
    unit: str,
    ends: tuple[float, float],
    kind: _Kind,
    scale: Callable[[float], float],
    *,
    ratio: bool = False,
    systematic: float = 0.0,
) -> EquivalenceTest:
    levels = kind.looks.level, kind.looks.level_of_each
    inside, outside = (found.interval(level, scale, systematic=systematic) for level in levels)
    return equivalence_test(name, unit, inside, *ends, outside=outside, runs=kind.runs, ratio=ratio)


def _log_spread(column: int) -> Statistic:
    return lambda spread, _: 0.5 * np.log(np.maximum(spread[..., column, column], 1e-300))


def _spread(column: int) -> Statistic:
    return lambda spread, _: np.sqrt(np.maximum(spread[..., column, column], 0.0))


def _spread_tests(
    sides: Sequence[Sequence[_Run]], simulation: int, hardware: int, margins: Margins, kind: _Kind
) -> list[EquivalenceTest]:
    """Test the spreads of angle, velocity and torque; ``simulation`` and ``hardware`` are their first columns."""
    tests = []
    for index, what in enumerate(_QUANTITIES):
        if what == "torque" and not kind.driven:
            continue
        margin: Margin = getattr(margins, f"spread_{what}")
        size = _log_spread if margin.is_share else _spread
        share = 1.0 if margin.is_share else max(float(_spread(hardware + index)(*run.near)[0]) for run in sides[-1])
        found, systematic = _difference(sides, size(simulation + index), size(hardware + index), kind, share)
        if margin.is_share:
            top = 1.0 + margin.si
            name = f"spread of {kind.name(what)} (ratio)"
            tests.append(
                _test(found, name, "-", (1.0 / top, top), kind, exponential, ratio=True, systematic=systematic)
            )
        else:
            tests.append(_within(found, f"spread of {kind.name(what)} difference", margin, kind, systematic))
    return tests


def _path_test(
    runs: Sequence[_Run], columns: tuple[int, int], what: str, margin: Margin, kind: _Kind
) -> EquivalenceTest:
    a, b = columns

    def distance(spread: Array, mean: Array) -> Array:
        square = spread[..., a, a] + spread[..., b, b] - 2.0 * spread[..., a, b] + (mean[..., b] - mean[..., a]) ** 2
        per = np.maximum(spread[..., b, b], 1e-300) if margin.is_share else 1.0
        return np.asarray(np.sqrt(np.maximum(square, 0.0) / per))

    quantity, _, note = what.partition(" ")
    name = f"distance of {'velocities' if quantity == 'velocity' else kind.name('angles')} {note}".rstrip()
    factor = 100.0 if margin.is_share else margin.per_si
    found = _jackknife(runs, distance, kind)
    size = 1.0 if margin.is_share else max(float(_spread(b)(*run.near)[0]) for run in runs)
    systematic = _systematic(runs, distance, size)
    ends = -math.inf, margin.value
    return _test(found, name, margin.unit, ends, kind, lambda value: factor * max(value, 0.0), systematic=systematic)
