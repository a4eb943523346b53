"""Quantiles and tails equal those of ``scipy.stats``, far out too."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from pendulum_bags import distributions as ours


@pytest.mark.parametrize("p", [1e-9, 1e-4, 0.025, 0.5, 0.9, 0.975, 1.0 - 1e-6])
def test_quantiles_are_those_of_scipy_stats(p: float) -> None:
    freedom = np.array([1.0, 2.0, 3.7, 40.0, 1e6])
    assert ours.normal_quantile(p) == pytest.approx(scipy.stats.norm.ppf(p), rel=1e-9, abs=1e-15)
    np.testing.assert_allclose(ours.student_quantile(p, freedom), scipy.stats.t.ppf(p, freedom), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(ours.f_quantile(p, 2.0, freedom), scipy.stats.f.ppf(p, 2.0, freedom), rtol=1e-7)


@pytest.mark.parametrize("x", [0.01, 0.3, 1.0, 2.5, 9.0])
def test_tails_are_those_of_scipy_stats(x: float) -> None:
    freedom = np.array([1.0, 2.0, 3.7, 40.0, 1e6])
    for sign in (1.0, -1.0):
        assert ours.normal_probability(sign * x) == pytest.approx(scipy.stats.norm.cdf(sign * x), rel=1e-12)
        tail = ours.student_tail(sign * x, freedom)
        np.testing.assert_allclose(tail, scipy.stats.t.sf(sign * x, freedom), rtol=1e-9)
    np.testing.assert_allclose(ours.f_tail(x, 2.0, freedom), scipy.stats.f.sf(x, 2.0, freedom), rtol=1e-9)
    assert ours.chi_square_tail(x, 7) == pytest.approx(scipy.stats.chi2.sf(x, 7), rel=1e-12)
    assert ours.kolmogorov_tail(x) == pytest.approx(scipy.stats.kstwobign.sf(x), rel=1e-12)


def test_the_interval_of_a_mean_is_students_and_of_one_value_there_is_none() -> None:
    values = np.array([1.0, 2.0, 4.0, 8.0])
    for level in (0.9, 0.95):
        found = ours.mean_interval(values, level)
        expected = scipy.stats.t.interval(level, 3, values.mean(), scipy.stats.sem(values))
        assert found == pytest.approx((3.75, *expected))
    one = ours.mean_interval([3.0])
    assert one.mean == 3.0
    assert math.isnan(one.low)
    assert math.isnan(one.high)
    assert math.isnan(ours.mean_interval([]).mean)
