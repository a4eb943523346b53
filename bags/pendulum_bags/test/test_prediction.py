"""How well predicted scores order measured ones, against worked examples and the definitions."""

import math

import numpy as np
import pytest

from pendulum_bags.ranking.prediction import judge_prediction
from pendulum_msgs_py.errors import DataError


def judged(predicted, measured, seed=0):
    return judge_prediction(predicted, measured, np.random.default_rng(seed))


def test_a_worked_example_has_the_correlation_and_the_violation_of_their_definitions():
    # Ranks 1 2 3 4 against 2 1 3 4: rho = 1 - 6 (1 + 1) / (4 (16 - 1)). One pair is wrong, and costs both of it 0.2.
    found = judged([0.1, 0.3, 0.5, 0.9], [0.4, 0.2, 0.6, 0.8])
    assert found.spearman.value == pytest.approx(1.0 - 12.0 / 60.0)
    assert found.mmrv.value == pytest.approx((0.2 + 0.2) / 4.0)
    assert found.designs == 4


def test_the_same_order_is_one_whatever_the_scores_and_the_reverse_is_minus_one():
    score = np.linspace(0.0, 1.0, 12)
    same = judged(score, score**3)
    assert (same.spearman.value, same.spearman.low, same.spearman.high) == pytest.approx((1.0, 1.0, 1.0))
    assert (same.mmrv.value, same.mmrv.high) == (0.0, 0.0)
    assert judged(score, -score).spearman.value == pytest.approx(-1.0)


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
    assert found.mmrv.value == pytest.approx((0.0 + 0.1 + 0.2) / 3.0)


@pytest.mark.parametrize(
    ("predicted", "measured", "message"),
    [
        ([0.1, 0.2], [0.1, 0.2], r"have the shapes \(2,\) and \(2,\); expected one of each for 3 designs or more"),
        ([0.1, 0.2, 0.3], [0.1, 0.2], r"have the shapes \(3,\) and \(2,\)"),
        ([0.1, 0.2, math.nan], [0.1, 0.2, 0.3], "a score is no finite number; expected 0 for a design that fails"),
    ],
)
def test_scores_that_cannot_be_compared_are_refused_in_a_sentence(predicted, measured, message):
    with pytest.raises(DataError, match=message):
        judged(predicted, measured)
