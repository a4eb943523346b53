"""How well predicted scores order measured ones, against worked examples and the definitions."""

import math

import numpy as np
import pytest
import scipy

from pendulum_bags.ranking.ranking import mmrv
from pendulum_msgs_py.errors import DataError
from tests.benchmarks.prediction import judge_prediction


def judged(predicted, measured, seed=0):
    return judge_prediction(predicted, measured, np.random.default_rng(seed))


def test_a_worked_example_has_the_correlation_and_the_violation_of_their_definitions():
    # Ranks 1 2 3 4 against 2 1 3 4: rho = 1 - 6 (1 + 1) / (4 (16 - 1)). One pair is wrong, and costs both of it 0.2:
    # what they differ by on the machine, not in simulation.
    found = judged([0.1, 0.45, 0.5, 0.9], [0.4, 0.2, 0.6, 0.8])
    assert found.spearman.value == pytest.approx(1.0 - 12.0 / 60.0)
    assert found.mmrv.value == pytest.approx((0.2 + 0.2) / 4.0)
    assert found.designs == 4
    assert found.note == ""
    # 1234, and three others that exchange two neighbours, of 24.
    assert found.chance == pytest.approx(4.0 / 24.0)
    scaled = judged([1.0, 4.5, 5.0, 9.0], [0.4, 0.2, 0.6, 0.8])
    assert scaled == found


def test_intervals_are_the_percentiles_that_scipy_finds_and_leave_draws_without_correlation_out():
    rng = np.random.default_rng(3)
    sim = rng.uniform(size=15)
    hw = sim + 0.3 * rng.uniform(size=15)
    found = judged(sim, hw)
    for interval, statistic in (
        (found.spearman, lambda a, b: scipy.stats.spearmanr(a, b).statistic),
        (found.mmrv, mmrv),
    ):
        other = scipy.stats.bootstrap(
            (sim, hw), statistic, paired=True, vectorized=False, method="percentile", n_resamples=2000, random_state=rng
        ).confidence_interval
        assert (interval.low, interval.high) == pytest.approx(tuple(other), abs=0.15 * (other.high - other.low))
    # Of three designs one draw in nine is of one design alone.
    few = judged([0.1, 0.4, 0.5], [0.4, 0.2, 0.6])
    assert (few.spearman.low, few.spearman.high) == pytest.approx((-1.0, 1.0))


def test_the_same_order_is_one_whatever_the_scores_and_the_reverse_is_minus_one():
    score = np.linspace(0.0, 1.0, 12)
    same = judged(score, score**3)
    assert (same.spearman.value, same.spearman.low, same.spearman.high) == pytest.approx((1.0, 1.0, 1.0))
    assert (same.mmrv.value, same.mmrv.high) == (0.0, 0.0)
    reverse = judged(score, -score)
    assert reverse.spearman.value == pytest.approx(-1.0)
    assert reverse.note.startswith("Simulation orders all 12 designs against the way the machine does")
    assert reverse.chance == 1.0


def test_a_perfect_order_of_a_few_designs_is_reported_as_what_chance_gives_too():
    few = judged([0.1, 0.3, 0.5], [0.2, 0.3, 0.9])
    assert (few.spearman.low, few.spearman.high) == pytest.approx((1.0, 1.0))
    assert few.chance == pytest.approx(1.0 / 6.0)
    assert few.note == (
        "Simulation orders all 3 designs as the machine does, and so in each draw of them: the interval has no width "
        "and says nothing of other designs; by chance they are ordered so one time in 6."
    )


def test_intervals_hold_the_correlation_that_many_designs_have():
    # Normal scores with Pearson's r have Spearman's 6 / pi asin(r / 2) in the long run.
    truth, held, rng = 6.0 / math.pi * math.asin(0.4), 0, np.random.default_rng(1)
    for _ in range(60):
        sim, own = rng.normal(size=(2, 40))
        interval = judge_prediction(sim, 0.8 * sim + 0.6 * own, rng, replicates=200).spearman
        held += interval.low <= truth <= interval.high
    assert held >= 50


def test_designs_that_all_fail_in_simulation_have_no_correlation():
    found = judged([0.0, 0.0, 0.0], [0.1, 0.2, 0.3])
    assert math.isnan(found.spearman.value)
    assert math.isnan(found.spearman.low)
    assert math.isnan(found.chance)
    assert found.note == ""
    assert found.mmrv.value == pytest.approx((0.0 + 0.1 + 0.2) / 3.0)


@pytest.mark.parametrize(
    ("predicted", "measured", "message"),
    [
        ([0.1, 0.2], [0.1, 0.2], r"have the shapes \(2,\) and \(2,\); expected one of each for 3 designs or more"),
        ([0.1, 0.2, 0.3], [0.1, 0.2], r"have the shapes \(3,\) and \(2,\)"),
        ([0.1, 0.2, 0.3], [0.1, math.inf, 0.3], "a score is no finite number"),
        ([0.1, 0.2, math.nan], [0.1, 0.2, 0.3], "a score is no finite number; expected 0 for a design that fails"),
    ],
)
def test_scores_that_cannot_be_compared_are_refused_in_a_sentence(predicted, measured, message):
    with pytest.raises(DataError, match=message):
        judged(predicted, measured)
