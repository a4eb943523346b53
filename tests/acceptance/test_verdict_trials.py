"""Trials of the verdict on whole runs: the short form of its benchmark."""

from __future__ import annotations

import pytest

from pendulum_bags.comparison import Outcome
from tests.benchmarks.bench_verdict import DEFAULT_LOOKS, DIFFERENCES, ON_THE_MARGIN, margins_at, run_trial


def test_a_machine_on_the_margins_is_seldom_called_equivalent_however_often_one_looks() -> None:
    """The short form of ``make bench ONLY=verdict``, which has 300 trials; here each has two looks."""
    stated = margins_at(ON_THE_MARGIN, 60.0)
    trials = [run_trial(seed, ON_THE_MARGIN, stated, (5.0, 10.0), each=True) for seed in range(1, 9)]
    for quantity in trials[0].outcomes:
        if "less the delay" not in quantity:
            # 3 of 8 or more happen once in 170 where the probability is 5 %.
            assert sum(trial.outcomes[quantity] is Outcome.EQUIVALENT for trial in trials) <= 2, quantity
    assert sum(trial.whole is Outcome.EQUIVALENT for trial in trials) <= 1


@pytest.mark.parametrize("what", DIFFERENCES)
def test_a_difference_that_matters_is_found_in_a_default_run(what: str) -> None:
    assert run_trial(1, DIFFERENCES[what], {}, DEFAULT_LOOKS).whole is Outcome.DIFFERENT
