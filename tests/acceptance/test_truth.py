"""The first layer judged by plants of numpy and scipy alone; the short form of ``make bench ONLY=truth``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pendulum_bags.comparison.band import SlowClock
from pendulum_bags.comparison.long_run import covariance, moments
from tests.benchmarks.bench_truth import SPREADS, Setting, margins_on, misses, on_the_margin, recordings
from tests.truth_loops import certificates, choice, distance
from tests.truth_plants import BAND, HOLD, PAIRS

SAME = PAIRS["one plant at two rates"]
IN_REAL_TIME = replace(SAME, hardware=replace(SAME.hardware, jitter=HOLD))
"""A phase of its own in each run."""


@pytest.mark.parametrize(
    "setting",
    [
        Setting(PAIRS["gravity 10 for 1.678 N m"], 5.0),
        Setting(PAIRS["gain 15 % more"], 5.0, apart=True),
        Setting(PAIRS["gravity 10 for 1.678 N m"], 5.0, known=False),
        Setting(PAIRS["4 ms of delay"], 5.0),
        Setting(IN_REAL_TIME, 5.0, runs=2),
    ],
    ids=["gravity", "unpaired", "unknown noise", "late", "real time"],
)
def test_long_run_values_lie_in_the_intervals_of_windows_of_five_seconds(setting: Setting) -> None:
    truth = setting.pair.truth(apart=setting.apart)
    found = misses(range(16), setting, truth)
    # 2.5 % a side are meant; 6 of 16 or more happen once in 10 000 at 5 %. Spreads about the window's own mean missed
    # by 15 to 40 % on one side, those of unpaired runs and those of few phases by half.
    assert {key: number for key, number in found.items() if number >= 6} == {}
    assert {quantity for quantity, _ in found} == set(truth)


def test_the_delay_of_one_plant_contains_zero_and_that_of_four_milliseconds_four() -> None:
    for name, delay in (("one plant at two rates", 0.0), ("4 ms of delay", 4.0)):
        assert misses(range(4), Setting(PAIRS[name], 5.0), {**PAIRS[name].truth(), "delay": delay}).total() <= 2


def test_a_spread_on_its_margin_is_seldom_called_equivalent() -> None:
    pair = PAIRS["gravity 10 for 1.678 N m"]
    found = on_the_margin(range(10), pair, margins_on(pair.truth()))
    # 5 % are meant; 5 of 10 or more happen once in 15 000. 47 % said yes while the spread was biased.
    assert max(found[f"spread of {name} (ratio) equivalent"] for name in SPREADS) <= 4
    assert found["any different"] <= 4


@pytest.mark.parametrize(("known", "low"), [(True, 0.96), (False, 0.86)])
def test_the_mean_of_many_long_run_variances_is_that_of_a_run_without_end(known: bool, low: float) -> None:
    pair = PAIRS["dry friction 0.1 N m"] if known else PAIRS["gravity 10 for 1.678 N m"]
    ratios = []
    for one in recordings(Setting(pair, 5.0, known=known), range(80)):
        motion = one.motions[1]
        clock = SlowClock(motion.t, BAND)
        angle = clock.filtered(motion.position[:, None] - np.pi)
        found = moments(clock, angle, one.noises[1], 5)
        spread, _ = covariance(found.products.sum(axis=0), found.sizes.sum(), found.noise.sum(), found)
        ratios.append(spread[0, 0])
    long = np.stack([pair.noise(10**6 + k, 102.0) for k in range(40)])
    truth = pair.hardware.run(long, 10_200)[:, 200:, 0].var()
    # About the windows' own means it is 0.79 and 0.84 of the truth; without what the noise does not explain, less.
    assert low < np.mean(ratios) / truth < 1.04


def test_the_intervals_of_nu_gap_and_regret_hold_the_truth() -> None:
    gaps = [distance("pendulum", seed) for seed in range(6)]
    choices = [choice(seed) for seed in range(6)]
    for found in (gaps, choices):
        pairs = [one for one in found if one is not None]
        assert len(pairs) >= 5
        # 5 % in all are meant; two of six miss once in 30.
        assert sum(not interval.low <= truth <= interval.high for interval, truth in pairs) <= 1


@pytest.mark.parametrize(
    ("name", "seed", "refusal"),
    [
        ("pendulum", 0, ""),
        ("cart-pole, cart stiffness -0.3 to -1 1/s^2", 0, "refused for poles"),
        ("Furuta pendulum, resonance between lines", 25, "refused for a resonance"),
    ],
)
def test_no_certified_controller_falls_on_the_machine_that_was_measured(name: str, seed: int, refusal: str) -> None:
    found = certificates(name, seed, 60)
    # Of the last pair one fell while a resonance between lines was only a premise.
    assert found["failing"] == 0
    assert found[refusal] > 0 if refusal else 2 * found["robust certified"] > found["robust"] > 10
