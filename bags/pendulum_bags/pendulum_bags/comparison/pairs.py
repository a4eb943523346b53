"""The two comparisons of a simulation with hardware: the thesis's, and the paired one under one disturbance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_bags.comparison.alignment import Alignment, align_motion, align_signals
from pendulum_bags.comparison.equivalence import EquivalenceTest, Margins, equivalence_test
from pendulum_bags.comparison.spectra import Spectra, spectra_of
from pendulum_bags.comparison.statistics import (
    Resampled,
    bootstrap_interval,
    describe,
    kolmogorov_smirnov,
    resample,
)
from pendulum_bags.runs.run_data import RunData
from pendulum_bags.runs.series import Array, Series, shared_span

__all__ = [
    "Difference",
    "Pair",
    "interpolated_difference",
    "paired_tests",
    "same_disturbance",
    "unpaired_tests",
]


SAME_DISTURBANCE = 0.6
"""Correlation from which two recorded disturbances count as one: independent noise of 5 s stays below 0.3."""


@dataclass(frozen=True)
class Difference:
    """Hardware minus simulation at common times.

    Args:
        t: Shape (n,) [s].
        position: Shape (n,) [rad].
        velocity: Shape (n,) [rad/s].
        simulation: The simulation at those times.
        hardware: The hardware at those times.
    """

    t: Array
    position: Array
    velocity: Array
    simulation: Series
    hardware: Series

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return count, mean, std, min, quartiles and max of both differences."""
        return {"position": describe(self.position), "velocity": describe(self.velocity)}


def interpolated_difference(simulation: Series, hardware: Series, *, at: str = "simulation") -> Difference:
    """Return the difference, with one motion interpolated by cubic splines at the other's stamps.

    Args:
        simulation: Simulated motion.
        hardware: Measured motion.
        at: ``simulation`` takes the simulation's stamps, as the thesis does; ``slower`` those of the motion with
            fewer samples, so that no sample is counted that was never measured.
    """
    start, stop = shared_span(simulation, hardware)
    use_simulation = at == "simulation" or simulation.period > 1.01 * hardware.period
    times = (simulation if use_simulation else hardware).t
    times = times[(times >= start) & (times <= stop)]
    a, b = simulation.interpolated(times), hardware.interpolated(times)
    return Difference(times, b.position - a.position, b.velocity - a.velocity, a, b)


def same_disturbance(simulation: RunData, hardware: RunData) -> Alignment | None:
    """Compare the recorded disturbances as functions of time since their start; None where one is missing."""
    if simulation.disturbance is None or hardware.disturbance is None:
        return None
    if min(simulation.disturbance.t.size, hardware.disturbance.t.size) < 12:
        return None
    period = min(simulation.window.period, hardware.window.period)
    return align_signals(simulation.disturbance, hardware.disturbance, period)


@dataclass(frozen=True)
class Pair:
    """One run of simulation and hardware, compared.

    Args:
        simulation, hardware: The runs.
        clock: Alignment of the disturbances; None where they were not recorded.
        response: Alignment of the motions.
        difference: As recorded.
        aligned: After the response delay has been taken out of the hardware.
        spectra: Spectra and coherence of the velocities.
    """

    simulation: RunData
    hardware: RunData
    clock: Alignment | None
    response: Alignment
    difference: Difference
    aligned: Difference
    spectra: Spectra

    @classmethod
    def of(cls, simulation: RunData, hardware: RunData) -> Pair:
        """Compare two runs."""
        response = align_motion(simulation.window, hardware.window)
        shifted = hardware.window.shifted(response.delay)
        return cls(
            simulation,
            hardware,
            same_disturbance(simulation, hardware),
            response,
            interpolated_difference(simulation.window, hardware.window, at="slower"),
            interpolated_difference(simulation.window, shifted, at="slower"),
            spectra_of(simulation.window, hardware.window),
        )

    @property
    def is_paired(self) -> bool:
        """Whether both had one disturbance, but for samples that a late loop skipped or repeated."""
        return self.clock is not None and self.clock.correlation > SAME_DISTURBANCE

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of this pair for JSON."""
        return {
            **self.difference.statistics(),
            "rms_position": _rms(self.difference.position),
            "rms_velocity": _rms(self.difference.velocity),
            "path": _rms(self.difference.position) / float(self.difference.hardware.position.std()),
            "disturbance_alignment": None if self.clock is None else self.clock.as_dict(),
            "response_alignment": self.response.as_dict(),
            "aligned": {**self.aligned.statistics(), "rms_position": _rms(self.aligned.position)},
            "coherent_up_to_hz": self.spectra.coherent_up_to,
        }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# -- tests on columns of samples ---------------------------------------------------------------------------------


def _variance(means: Array, first: int) -> Array:
    """Return the variance from the means of x and x^2 in two neighbouring columns."""
    return np.maximum(np.asarray(means[..., first + 1] - means[..., first] ** 2), 1e-300)


def _moments(series: Series) -> list[Array]:
    columns = []
    for values in (series.position, series.velocity, series.effort):
        # Around the middle, so that x^2 does not drown the variance in the square of the mean.
        centred = values - np.pi if values is series.position else values
        columns += [centred, centred**2]
    return columns


def _column(index: int, minus: int | None = None) -> Callable[[Array], Array]:
    """Return the statistic that is the mean of a column, or the difference of two."""
    if minus is None:
        return lambda means: np.asarray(means[..., index])
    return lambda means: np.asarray(means[..., index] - means[..., minus])


def _spread_ratio(above: int, below: int) -> Callable[[Array], Array]:
    """Return the statistic that is the ratio of two standard deviations."""
    return lambda means: np.asarray(np.sqrt(_variance(means, above) / _variance(means, below)))


def _spread_tests(
    resampled: Resampled, simulation: int, hardware: int, margins: Margins, runs: int
) -> list[EquivalenceTest]:
    """Test the ratios of spreads; the moments of the two sides begin at the columns given."""
    return [
        equivalence_test(
            f"spread of {what} (ratio)",
            "-",
            bootstrap_interval(resampled, _spread_ratio(hardware + index, simulation + index)),
            1.0 / margins.spread,
            margins.spread,
            runs=runs,
            ratio=True,
        )
        for index, what in ((0, "angle"), (2, "velocity"), (4, "torque"))
    ]


def paired_tests(pairs: Sequence[Pair], margins: Margins) -> list[EquivalenceTest]:
    """Test all pairs together; blocks are drawn at the same times from both motions, so that pairing counts."""
    columns = []
    for pair in pairs:
        difference = pair.difference
        rows = [difference.position, difference.velocity, difference.position**2]
        rows += _moments(difference.simulation) + _moments(difference.hardware)
        columns.append(np.stack(rows, axis=1))
    resampled = resample(columns)
    runs = len(pairs)
    tests = [
        equivalence_test(
            f"mean {what} difference",
            unit,
            bootstrap_interval(resampled, _column(i)),
            -margin,
            margin,
            runs=runs,
        )
        for i, what, unit, margin in (
            (0, "angle", "rad", margins.position),
            (1, "velocity", "rad/s", margins.velocity),
        )
    ]
    tests += _spread_tests(resampled, 3, 9, margins, runs)
    path = bootstrap_interval(
        resampled, lambda means: np.asarray(np.sqrt(np.maximum(means[..., 2], 0.0) / _variance(means, 9)))
    )
    tests.append(equivalence_test("path distance per spread", "-", path, -np.inf, margins.path, runs=runs))
    return tests


def unpaired_tests(
    simulations: Sequence[RunData], hardware: Sequence[RunData], margins: Margins
) -> list[EquivalenceTest]:
    """Test means and spreads of runs that share no disturbance; each side is resampled on its own."""
    sides = [
        resample([np.stack(_moments(run.window), axis=1) for run in runs], seed=seed)
        for seed, runs in enumerate((simulations, hardware), start=1)
    ]
    # One object with the columns of both sides, so that the same statistics apply.
    joined = Resampled(
        np.concatenate([side.means for side in sides]),
        np.concatenate([side.draws for side in sides], axis=1),
        np.concatenate([side.within for side in sides], axis=1),
        min(side.blocks for side in sides),
        min(side.runs for side in sides),
    )
    count = sides[0].means.size
    runs = min(len(simulations), len(hardware))
    tests = [
        equivalence_test(
            f"difference of mean {what}",
            unit,
            bootstrap_interval(joined, _column(count + i, minus=i)),
            -margin,
            margin,
            runs=runs,
        )
        for i, what, unit, margin in (
            (0, "angle", "rad", margins.position),
            (2, "velocity", "rad/s", margins.velocity),
        )
    ]
    return tests + _spread_tests(joined, 0, count, margins, runs)


def distribution_tests(simulation: Series, hardware: Series) -> dict[str, dict[str, Any]]:
    """Return Kolmogorov-Smirnov comparisons of angle and velocity with effective sample sizes, for JSON."""
    results = {}
    for name in ("position", "velocity"):
        found = kolmogorov_smirnov(getattr(simulation, name), getattr(hardware, name))
        results[name] = {**found._asdict(), "sizes": list(found.sizes)}
    return results
