"""Alignment, interpolation, spectra, metrics and equivalence tests on signals whose answers are known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_bags.comparison.alignment import align_motion, align_signals
from pendulum_bags.comparison.equivalence import Margins, Outcome, conclude, equivalence_test
from pendulum_bags.comparison.metrics import METRICS, Episode, metrics_of, summarise_metrics
from pendulum_bags.comparison.pairs import interpolated_difference
from pendulum_bags.comparison.spectra import spectra_of
from pendulum_bags.comparison.statistics import Interval
from pendulum_bags.runs.series import Series, Signal, unwrap_near_upright
from pendulum_msgs_py.errors import DataError, ParameterError


def smooth(t: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return a sum of sines between 0.3 and 15 Hz."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.3, 15.0, 40), rng.uniform(0.0, 6.3, 40)
    return np.sin(2.0 * np.pi * frequency * t[:, None] + phase).sum(axis=1)


def series(rate: float, delay: float = 0.0, duration: float = 5.0, name: str = "series") -> Series:
    t = np.arange(0.0, duration, 1.0 / rate)
    return Series(t, smooth(t - delay, 1), smooth(t - delay), np.zeros_like(t), name)


@settings(deadline=None, max_examples=20)
@given(st.floats(-0.06, 0.06))
def test_delay_between_motions_of_different_rates_is_found_to_a_fraction_of_a_sample(delay: float) -> None:
    found = align_motion(series(500.0), series(100.0, delay))
    assert found.delay == pytest.approx(delay, abs=0.0015)
    assert found.correlation > 0.97


def test_delay_of_held_signals_is_found() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(300) * 0.01
    values = rng.uniform(-1.0, 1.0, 300)
    found = align_signals(Signal(t, values), Signal(t + 0.03, values), 0.002)
    assert found.delay == pytest.approx(0.03, abs=0.001)
    assert found.correlation == pytest.approx(1.0, abs=0.02)
    assert abs(found.correlation_at_zero) < 0.3


def test_series_that_share_no_time_are_refused() -> None:
    with pytest.raises(DataError, match="share no time"):
        interpolated_difference(series(500.0, duration=1.0), series(100.0, duration=1.0).shifted(-2.0))


def test_cubic_interpolation_of_slow_data_is_exact_to_its_order() -> None:
    difference = interpolated_difference(series(500.0), series(100.0))
    assert difference.t.size == 2496  # those of the simulation's stamps that the hardware's data enclose
    assert np.abs(difference.position).max() < 0.1 * np.abs(difference.simulation.position).max()
    inside = (difference.t > 0.1) & (difference.t < 4.9)
    assert np.abs(difference.position[inside]).max() < 0.02


def test_paired_difference_stands_at_the_slower_stamps() -> None:
    sim, hw = series(500.0), series(100.0)
    assert interpolated_difference(sim, hw, at="slower").t.size == 500
    assert interpolated_difference(hw, sim, at="slower").t.size == 500


def test_series_refuses_stamps_that_go_back_and_values_that_are_not_numbers() -> None:
    t = np.array([0.0, 0.1, 0.1, 0.2])
    with pytest.raises(DataError, match="strictly increasing"):
        Series(t, t, t, t)
    with pytest.raises(DataError, match="velocity is nan in sample 2"):
        Series(np.arange(4.0), t, np.array([0.0, 1.0, np.nan, 1.0]), t)


@pytest.mark.parametrize("rest", [0.0, math.pi])
def test_a_pendulum_at_either_rest_is_at_that_rest_whatever_its_noise_and_its_turn(rest: float) -> None:
    for noise in (-1e-6, 0.0, 1e-6):
        for turn in (-2, 0, 3):
            angles = np.full(20, rest + noise + 2.0 * math.pi * turn)
            np.testing.assert_allclose(unwrap_near_upright(angles), rest + noise, atol=1e-9)


@settings(deadline=None)
@given(st.integers(-5, 5), st.floats(-1.0, 1.0))
def test_angles_come_back_near_upright_whatever_the_turn(turns: int, deviation: float) -> None:
    angles = math.pi + deviation + 2.0 * math.pi * turns + np.linspace(0.0, 0.1, 20)
    wrapped = np.mod(angles + np.pi, 2.0 * np.pi) - np.pi
    np.testing.assert_allclose(unwrap_near_upright(wrapped), angles - 2.0 * math.pi * turns, atol=1e-9)


# -- spectra -----------------------------------------------------------------------------------------------------


def test_coherence_is_one_for_equal_motions_and_below_the_threshold_for_strangers() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(3000) / 100.0
    motions = [Series(t, np.zeros(3000), rng.standard_normal(3000), np.zeros(3000)) for _ in range(2)]
    same = spectra_of(motions[0], motions[0])
    assert same.coherence.min() > 0.999
    strangers = spectra_of(*motions)
    assert np.mean(strangers.coherence > strangers.threshold) < 0.12


def test_power_density_integrates_to_the_variance() -> None:
    t = np.arange(4000) / 100.0
    values = np.random.default_rng(1).standard_normal(4000)
    motion = Series(t, values, values, values)
    found = spectra_of(motion, motion)
    step = found.frequency[1] - found.frequency[0]
    assert found.first.sum() * step == pytest.approx(values.var(), rel=0.1)


# -- metrics -----------------------------------------------------------------------------------------------------


def second_order(zeta: float, omega: float = 5.0) -> Episode:
    """Return the step response of omega^2 / (s^2 + 2 zeta omega s + omega^2), from -1 to 0."""
    t = np.linspace(0.0, 6.0, 60_001)
    damped = omega * math.sqrt(1.0 - zeta**2)
    error = -np.exp(-zeta * omega * t) * (np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t))
    velocity = np.gradient(error, t)
    return Episode(t, error, velocity, 2.0 * np.ones_like(t), step=-1.0)


def test_metrics_of_a_second_order_step_are_those_of_the_closed_form() -> None:
    zeta, omega = 0.4, 5.0
    found = metrics_of(second_order(zeta, omega))
    assert found["overshoot"] == pytest.approx(math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)), rel=1e-4)
    assert found["ise"] == pytest.approx((1.0 + 4.0 * zeta**2) / (4.0 * zeta * omega), rel=1e-4)
    # The envelope bounds the settling time from above, half a period of oscillation from below.
    envelope = -math.log(0.02 * math.sqrt(1.0 - zeta**2)) / (zeta * omega)
    assert envelope - math.pi / (omega * math.sqrt(1.0 - zeta**2)) < found["settling_time"] <= envelope
    assert found["effort_energy"] == pytest.approx(24.0)
    assert found["smoothness"] == 0.0
    assert found["work"] == pytest.approx(2.0, rel=1e-4)


def test_regulation_has_no_step_metrics_but_all_others() -> None:
    episode = second_order(0.5)
    found = metrics_of(Episode(episode.t, episode.error, episode.velocity, episode.effort))
    assert {metric.name for metric in METRICS} - set(found) == {"overshoot", "rise_time", "settling_time"}


def test_a_step_that_never_settles_says_so_in_the_table() -> None:
    t = np.linspace(0.0, 1.0, 101)
    episode = Episode(t, -np.ones_like(t), np.zeros_like(t), np.zeros_like(t), step=-1.0)
    assert metrics_of(episode)["settling_time"] == math.inf
    rows = {row["metric"]: row["a"] for row in summarise_metrics({"a": episode})}
    assert rows["settling_time"] is None


@pytest.mark.parametrize("rate", [50.0, 100.0, 500.0, 1000.0])
def test_smoothness_is_that_of_the_torque_and_not_of_its_sampling(rate: float) -> None:
    t = np.arange(0.0, 10.0, 1.0 / rate)
    effort = 2.0 * np.sin(2.0 * math.pi * 1.5 * t)
    zero = np.zeros_like(t)
    found = metrics_of(Episode(t, zero, zero, effort))["smoothness"]
    # rms of u(t + h) - u(t) for a sine of amplitude a: sqrt(2) a |sin(pi f h)|.
    assert found == pytest.approx(math.sqrt(2.0) * 2.0 * math.sin(math.pi * 1.5 * 0.02) / 0.02, rel=0.01)


def test_torque_sampled_too_seldom_has_no_smoothness() -> None:
    t = np.arange(0.0, 2.0, 0.04)
    assert "smoothness" not in metrics_of(Episode(t, t, t, t))


# -- equivalence -------------------------------------------------------------------------------------------------


def interval(estimate: float, low: float, high: float) -> Interval:
    return Interval(estimate, low, high, 0.9, (high - low) / 3.29, 10)


@pytest.mark.parametrize(
    ("found", "outcome"),
    [
        (interval(0.1, -0.5, 0.7), Outcome.EQUIVALENT),
        (interval(2.0, 1.2, 2.8), Outcome.DIFFERENT),
        (interval(-2.0, -2.8, -1.2), Outcome.DIFFERENT),
        (interval(0.8, 0.2, 1.4), Outcome.UNDECIDED),
    ],
)
def test_outcome_follows_from_interval_and_margin(found: Interval, outcome: Outcome) -> None:
    test = equivalence_test("offset", "rad", found, -1.0, 1.0)
    assert test.outcome is outcome
    assert outcome.value in test.sentence()


def test_undecided_names_the_runs_that_would_decide_and_fewer_for_narrower_intervals() -> None:
    wide = equivalence_test("offset", "rad", interval(0.5, -1.5, 2.5), -1.0, 1.0)
    narrow = equivalence_test("offset", "rad", interval(0.5, -0.2, 1.2), -1.0, 1.0)
    assert wide.more_runs is not None
    assert narrow.more_runs is not None
    assert wide.more_runs > narrow.more_runs >= 1
    assert f"undecided: record {wide.more_runs} more runs" in wide.sentence()


def test_an_estimate_on_the_margin_asks_for_no_runs_in_vain() -> None:
    test = equivalence_test("offset", "rad", interval(1.0, 0.5, 1.5), -1.0, 1.0)
    assert test.more_runs is None
    assert "more runs would hardly decide it" in test.sentence()


@pytest.mark.parametrize("truth", [0.0, 0.3, 0.8, 1.2])
def test_the_named_number_of_runs_decides_about_as_often_as_promised(truth: float) -> None:
    """With n more runs the interval is narrower by sqrt; 80 % of the estimates then lead to a decision."""
    rng = np.random.default_rng(0)
    error, margin = 1.0, 1.0
    first = equivalence_test("x", "", interval(truth, truth - 1.645 * error, truth + 1.645 * error), -margin, margin)
    assert first.more_runs is not None
    total = 1 + first.more_runs
    estimates = truth + error / math.sqrt(total) * rng.standard_normal(4000)
    reach = 1.645 * error / math.sqrt(total)
    decided = (np.abs(estimates) + reach < margin) | (np.abs(estimates) - reach > margin)
    assert 0.77 < decided.mean() < 0.9


def test_ratios_are_judged_by_their_logarithm() -> None:
    test = equivalence_test("spread", "-", interval(1.0, 0.79, 1.1), 0.8, 1.25, ratio=True)
    assert test.outcome is Outcome.UNDECIDED
    assert test.smallest_margin == pytest.approx(1.0 / 0.79)


def test_verdict_is_the_worst_outcome_in_words() -> None:
    good = equivalence_test("mean", "rad", interval(0.0, -0.1, 0.1), -1.0, 1.0)
    bad = equivalence_test("spread", "-", interval(3.0, 2.5, 3.5), 0.8, 1.25, ratio=True)
    open_ = equivalence_test("path", "-", interval(0.9, 0.5, 1.4), -math.inf, 1.0)
    default = Margins.parse()
    assert conclude([good], default, "simulation", "hardware").outcome is Outcome.EQUIVALENT
    undecided = conclude([good, open_], default, "simulation", "hardware")
    assert undecided.more_runs == open_.more_runs
    assert f"record {open_.more_runs} more run" in undecided.sentence
    verdict = conclude([good, open_, bad], default, "simulation", "hardware")
    assert verdict.outcome is Outcome.DIFFERENT
    assert "not equivalent within the default margins (none were stated): spread is 3" in verdict.sentence
    partly = conclude([good], Margins.parse(["delay=8ms", "band=10 Hz"]), "simulation", "hardware")
    assert "within the stated margins (delay, band) and the default ones for the rest, in all" in partly.sentence
    whole = Margins.parse({name: 1.0 for name in default.as_dict() if name != "stated"})
    assert "within the stated margins, in all" in conclude([good], whole, "simulation", "hardware").sentence


# -- margins -----------------------------------------------------------------------------------------------------


def test_margins_are_read_as_users_write_them(tmp_path: Path) -> None:
    texts = Margins.parse(["delay=8 ms", "spread_angle=0.2deg", "path_angle=20 %"])
    assert texts.delay.si == pytest.approx(0.008)
    assert (texts.spread_angle.unit, texts.spread_angle.si) == ("deg", pytest.approx(math.radians(0.2)))
    assert str(texts.path_angle) == "20 %"
    assert texts.stated == {"delay", "spread_angle", "path_angle"}
    assert Margins.parse("delay=8ms,spread_angle=0.2 deg,path_angle=20%") == texts
    assert Margins.parse({"delay": "8 ms", "spread_angle": {"value": 0.2, "unit": "deg"}, "path_angle": 20}) == texts
    file = tmp_path / "mine.yaml"
    file.write_text(
        "format: pendulum_margins/1\nmargins:\n  delay: {value: 0.008, unit: s}\n"
        "  spread_angle: {value: 0.2, unit: deg}\n  path_angle: {value: 30, unit: '%'}\n"
    )
    both = Margins.of(file, ["path_angle=20 %"])
    assert both.delay.si == texts.delay.si
    assert (both.path_angle, both.stated) == (texts.path_angle, texts.stated)


def test_margins_come_back_from_a_summary() -> None:
    stated = Margins.parse(["delay=8ms", "spread_torque=0.1 N m"])
    again = Margins.from_dict(json.loads(json.dumps(stated.as_dict())))
    assert (again, again.stated) == (stated, stated.stated)
    assert not Margins.parse([]).stated


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"delay": -1}, "margin delay is -1 ms; expected a finite number > 0"),
        ({"angle": 0.9}, "margin has no 'angle'; expected one of mean_angle, spread_angle"),
        (["delay=late"], "margin delay is 'late', without a unit; expected a number in ms or s"),
        (["delay=0.008"], "margin delay is '0.008', without a unit; expected a number in ms or s"),
        (["delay=late ms"], "margin delay is 'late ms'; expected a number in ms, s"),
        (["0.02"], "margin is '0.02'; expected NAME=VALUE, such as delay=8ms"),
        ({"path_angle": math.nan}, "margin path_angle is nan %; expected a finite number > 0"),
        ({"delay": {"value": 3, "unit": "deg"}}, "margin delay has unit 'deg'; expected one of ms, s"),
    ],
)
def test_margins_that_mean_nothing_are_refused(stated: object, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Margins.parse(stated)  # type: ignore[arg-type]
