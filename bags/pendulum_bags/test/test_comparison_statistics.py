"""Statistics of correlated samples."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy import signal, stats

from pendulum_bags.comparison.statistics import Interval, Jackknife, describe, exponential, kolmogorov_smirnov
from pendulum_bags.runs.correlation import effective_size
from pendulum_msgs_py.errors import DataError


def autoregressive(size: int, coefficient: float, seed: int) -> np.ndarray:
    """Return x[k] = coefficient x[k-1] + white noise, stationary."""
    noise = np.random.default_rng(seed).standard_normal(size + 500)
    return signal.lfilter([1.0], [1.0, -coefficient], noise)[500:]


def test_description_is_that_of_pandas() -> None:
    values = np.random.default_rng(1).gamma(2.0, size=137)
    expected = pd.Series(values).describe()
    found = describe(values)
    assert list(found) == list(expected.index)
    np.testing.assert_allclose(list(found.values()), expected.to_numpy(), rtol=1e-13)


def test_description_of_one_sample_is_refused() -> None:
    with pytest.raises(DataError, match="statistics of 1 samples; expected at least 2"):
        describe([1.0])


@pytest.mark.parametrize("coefficient", [0.0, 0.5, 0.9])
def test_effective_size_of_an_autoregressive_process_is_that_of_theory(coefficient: float) -> None:
    sizes = [effective_size(autoregressive(4000, coefficient, seed)) for seed in range(10)]
    theory = 4000 * (1.0 - coefficient) / (1.0 + coefficient)
    assert np.median(sizes) == pytest.approx(theory, rel=0.25)


@pytest.mark.parametrize("coefficient", [0.0, 0.5, 0.9, 0.99])
def test_a_sum_of_products_of_two_series_counts_by_the_correlation_of_both(coefficient: float) -> None:
    # rho of the products is the product of both: 0.9 ** k times coefficient ** k.
    sizes = [
        effective_size(autoregressive(8000, 0.9, seed), autoregressive(8000, coefficient, 1000 + seed))
        for seed in range(10)
    ]
    joint = 0.9 * coefficient
    assert np.median(sizes) == pytest.approx(8000 * (1.0 - joint) / (1.0 + joint), rel=0.25)


def test_a_common_offset_of_residuals_counts_as_what_all_samples_share() -> None:
    noise = autoregressive(2000, 0.0, 3)
    # About zero, as a regression without intercept has them, samples far from it all say the same.
    assert effective_size(noise + 10.0, noise + 10.0) < 0.01 * effective_size(noise, noise)


def interval_of_mean(runs: list[np.ndarray], *, runs_differ: bool) -> Interval:
    """Return the interval of the mean of all samples, by leaving out each of eight blocks of each run."""
    values = np.concatenate(runs)
    blocks = [block for run in runs for block in np.array_split(run, 8)]
    without = np.array([(values.sum() - block.sum()) / (values.size - block.size) for block in blocks])
    found = Jackknife.of(float(values.mean()), without)
    if runs_differ:
        found = found.of_runs(np.array([run.mean() for run in runs]), [run.size for run in runs])
    return found.interval(0.9)


def test_the_interval_of_a_ratio_that_is_not_determined_has_no_upper_end() -> None:
    interval = Jackknife(0.0, 1000.0, 2.0, 3).interval(0.95, exponential)
    assert (interval.estimate, interval.low, interval.high) == (1.0, 0.0, math.inf)


def test_interval_of_a_mean_covers_the_truth_as_often_as_stated_in_spite_of_correlation() -> None:
    covered = naive = 0
    trials = 300
    for seed in range(trials):
        values = autoregressive(500, 0.9, seed)
        interval = interval_of_mean([values], runs_differ=False)
        covered += interval.low <= 0.0 <= interval.high
        naive += abs(values.mean()) <= 1.645 * values.std() / np.sqrt(values.size)
    # 90 % is meant; the binomial error of 300 trials is 1.7 %. Counting samples instead of blocks gives about a third.
    assert 0.85 <= covered / trials <= 0.95
    assert naive / trials < 0.5


@pytest.mark.parametrize("count", [2, 8])
def test_interval_of_few_runs_that_differ_counts_the_runs_and_not_the_blocks(count: int) -> None:
    rng = np.random.default_rng(5)
    covered = ignored = 0
    trials = 300
    for _ in range(trials):
        runs = [offset + 0.3 * rng.standard_normal(60) for offset in rng.standard_normal(count)]
        interval = interval_of_mean(runs, runs_differ=True)
        covered += interval.low <= 0.0 <= interval.high
        interval = interval_of_mean(runs, runs_differ=False)
        ignored += interval.low <= 0.0 <= interval.high
    assert 0.92 <= covered / trials <= 0.98
    assert ignored / trials < 0.8


def test_the_difference_of_two_sides_has_the_error_of_both() -> None:
    rng = np.random.default_rng(4)
    covered = 0
    for _ in range(300):
        sides = []
        for spread in (1.0, 3.0):
            values = spread * rng.standard_normal(8)
            sides.append(Jackknife.of(float(values.mean()), (values.sum() - values) / 7))
        interval = sides[1].less(sides[0]).interval(0.9)
        covered += interval.low <= 0.0 <= interval.high
    assert 0.86 <= covered / 300 <= 0.95


def test_kolmogorov_smirnov_has_the_distance_of_scipy_and_counts_correlated_samples_less() -> None:
    a, b = autoregressive(600, 0.95, 1), autoregressive(400, 0.95, 2)
    found = kolmogorov_smirnov(a, b)
    reference = stats.ks_2samp(a, b)
    assert found.distance == pytest.approx(reference.statistic)
    assert found.p_value > reference.pvalue
    assert max(found.sizes) < 100


def test_kolmogorov_smirnov_of_equal_samples_finds_nothing() -> None:
    a = autoregressive(200, 0.5, 1)
    found = kolmogorov_smirnov(a, a)
    assert found.distance == 0.0
    assert found.p_value == pytest.approx(1.0)
