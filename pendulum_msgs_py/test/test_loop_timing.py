"""Clocks and loop statistics, with time as an argument."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.contract.timing import LoopStatistics, RingOfTimes, SteadyWallClock, Throttle

_MS = 1_000_000


def test_the_wall_clock_ignores_a_step_of_the_system_clock() -> None:
    wall, monotonic = [10_000], [500]
    clock = SteadyWallClock(lambda: wall[0], lambda: monotonic[0])
    assert clock() == 10_000
    wall[0], monotonic[0] = 3, 700
    assert clock() == 10_200


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=40), st.integers(1, 20))
def test_percentiles_are_those_of_the_last_durations(durations: list[int], size: int) -> None:
    ring = RingOfTimes(size)
    for duration in durations:
        ring.add(duration)
    assert ring.count == len(durations)
    expected = np.percentile(durations[-size:], [50, 99, 100], method="nearest") / 1e3
    assert ring.percentiles_us(50, 99, 100) == pytest.approx(expected.tolist())


def test_before_the_first_cycle_figures_are_not_numbers_but_zero_counts() -> None:
    summary = LoopStatistics(_MS).summary(0)
    assert summary["cycles"] == summary["overruns"] == 0
    assert math.isnan(summary["rate_hz"])
    assert math.isnan(summary["jitter_p99_us"])
    # Of a plant that measures nothing, nobody is told how old its measurements are.
    assert not [key for key in summary if "age" in key]


def test_rate_jitter_overruns_and_latency_are_what_happened() -> None:
    statistics = LoopStatistics(_MS)
    for index in range(1000):
        late = 1_500_000 if index == 500 else 20_000
        statistics.cycle(index * _MS + late, index * _MS)
        statistics.round_trip(300_000)
    statistics.act_on_age(700_000)
    summary = statistics.summary(1000 * _MS)
    assert summary["rate_hz"] == pytest.approx(1000.0, rel=1e-3)
    assert summary["overruns"] == 1
    assert summary["jitter_p50_us"] == 20.0
    assert summary["jitter_max_us"] == 1500.0
    assert summary["command_latency_p50_us"] == 300.0
    assert summary["answered_age_p50_us"] == summary["answered_age_max_us"] == 700.0
    # The rate is that since the last summary; nothing ran since.
    assert statistics.summary(2000 * _MS)["rate_hz"] == 0.0


def test_of_many_lines_one_a_second_is_reported_and_none_is_forgotten() -> None:
    throttle = Throttle(1.0)
    told = [throttle.ask(0.05 * k) for k in range(100)]
    # Twenty a second for five seconds.
    assert [k for k, left_out in enumerate(told) if left_out is not None] == [0, 20, 40, 60, 80]
    assert [told[k] for k in (0, 20, 40, 60, 80)] == [0, 19, 19, 19, 19]
    # How it ended is told once the time of the last line is over.
    assert throttle.flush(4.99) == 0
    assert throttle.flush(5.1) == 19
    assert throttle.flush(9.0) == 0
    # What is new is told at once.
    assert throttle.ask(5.2) is None
    assert throttle.ask(5.3, urgent=True) == 1


@given(st.lists(st.lists(st.integers(0, 10**9), max_size=9), max_size=6), st.integers(1, 7))
def test_durations_kept_several_at_a_time_are_those_kept_one_by_one(parts: list[list[int]], size: int) -> None:
    one_by_one, several = RingOfTimes(size), RingOfTimes(size)
    for part in parts:
        several.extend(part)
        for duration in part:
            one_by_one.add(duration)
    assert several.count == one_by_one.count
    assert list(several._values) == list(one_by_one._values)


def test_cycles_reported_several_at_a_time_are_those_reported_one_by_one() -> None:
    one_by_one, several = LoopStatistics(_MS), LoopStatistics(_MS)
    late = [1000 * k for k in range(40)]
    for part in (late[:25], late[25:]):
        begin = late.index(part[0])
        several.punctual_cycles(part, begin * _MS + part[0])
    for k, each in enumerate(late):
        one_by_one.cycle(k * _MS + each, k * _MS)
    summaries = [each.summary(40 * _MS) for each in (several, one_by_one)]
    told = [{key: value for key, value in each.items() if not math.isnan(value)} for each in summaries]
    assert told[0] == told[1]
    assert "jitter_p99_us" in told[0]
