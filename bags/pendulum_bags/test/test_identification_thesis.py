"""The thesis's two regressions on data made from known coefficients."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy

from pendulum_bags.commands import identify_cli
from pendulum_bags.identification.page import write_thesis_page
from pendulum_bags.identification.thesis import fit_gravity, fit_inertia_damping, static_holds
from pendulum_bags.identification.thesis_figures import TrialSet, thesis_figures
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError

M, B, G = 0.055, 11.77, 1.678


def hand_trial(seed, sign=1.0):
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 12.0, 0.01)
    rate = 0.5 + 0.1 * seed
    position = 0.5 * np.pi * (1.0 - np.cos(rate * time))
    velocity = 0.5 * np.pi * rate * np.sin(rate * time)
    acceleration = 0.5 * np.pi * rate**2 * np.cos(rate * time)
    effort = sign * (B * velocity + M * acceleration) + 0.02 * rng.standard_normal(time.size)
    return Recording(time, position, velocity, effort, meta={"source": f"trial_{seed}"})


def staircase(seed, loop=0.1):
    rng = np.random.default_rng(seed)
    targets = np.radians([*range(10, 91, 10), *range(80, -1, -10), *range(-10, -91, -10), *range(-80, 1, 10)])
    position, effort, now = [], [], 0.0
    for target in targets:
        ramp = np.linspace(now, target, 100)
        hold = np.full(150, target)
        direction = np.sign(target - now)
        position += [ramp, hold]
        effort += [G * np.sin(ramp) + 0.5 * direction, G * np.sin(hold) + 0.5 * loop * direction]
        now = target
    angle, torque = np.concatenate(position), np.concatenate(effort)
    time = 0.01 * np.arange(angle.size)
    return Recording(
        time,
        angle + 1e-4 * rng.standard_normal(time.size),
        None,
        torque + 0.005 * rng.standard_normal(time.size),
        meta={"source": f"stairs_{seed}"},
    )


def test_inertia_and_damping_come_back_within_their_intervals():
    result = fit_inertia_damping([hand_trial(seed) for seed in range(6)])
    for name, truth in (("damping", B), ("inertia", M)):
        low, high = result.intervals[name]
        assert low <= truth <= high
        assert result.average[name] == pytest.approx(truth, rel=0.2)
    assert len(result.trials) == 6
    assert all(trial.r_squared > 0.99 for trial in result.trials)
    assert "R-squared" in result.trials[0].summary
    assert any("inertial torque is" in sentence for sentence in result.sentences)


def slow_noise(size, level, memory, seed):
    """Noise of a standard deviation that is correlated over some samples."""
    pole = np.exp(-1.0 / memory)
    white = np.random.default_rng(seed).standard_normal(size + 20 * int(memory))
    return level * np.sqrt(1.0 - pole**2) * scipy.signal.lfilter([1.0], [1.0, -pole], white)[-size:]


# Of noise that remembers 1 s a trial of 12 s has a dozen independent samples, of which two are fitted.
@pytest.mark.parametrize(
    ("memory", "level", "least"), [(1e-3, 0.02, 0.9), (30.0, 0.02, 0.87), (30.0, 0.3, 0.87), (100.0, 0.02, 0.8)]
)
def test_one_trial_has_intervals_that_hold_the_truth_whatever_the_memory_of_its_noise(memory, level, least):
    inside, independent = [], []
    for seed in range(60):
        trial = hand_trial(seed % 6)
        effort = B * trial.velocity + M * np.gradient(trial.velocity, trial.time)
        noisy = effort + slow_noise(effort.size, level, memory, seed)
        result = fit_inertia_damping([replace(trial, input=noisy)], skew=0.0)
        regression = result.trials[0]
        for (name, truth), at in ((("damping", B), 0), (("inertia", M), 1)):
            low, high = result.intervals[name]
            inside.append(low <= truth <= high)
            error = regression.errors[at] / regression.inflation[at]
            independent.append(abs(regression.values[at] - truth) <= 1.96 * error)
    assert least <= np.mean(inside) <= 0.99
    # As if residuals were independent, a slow noise is far too surely averaged out.
    assert (np.mean(independent) < 0.5) == (memory > 1.0)


def test_a_loop_that_the_regression_leaves_out_widens_the_interval_and_is_reported():
    trial = hand_trial(1)
    clean = fit_inertia_damping([trial])
    loop = 0.05 * np.sign(np.gradient(trial.velocity, trial.time))
    looped = fit_inertia_damping([replace(trial, input=trial.input + loop)])
    widths = [np.ptp(result.intervals["damping"]) for result in (clean, looped)]
    assert widths[1] > 5.0 * widths[0]
    assert any("correlated in time" in sentence for sentence in looped.sentences)
    assert not any("correlated in time" in sentence for sentence in clean.sentences)
    assert any("One trial does not show" in sentence for sentence in clean.sentences)
    assert not any("One trial" in s for s in fit_inertia_damping([hand_trial(1), hand_trial(2)]).sentences)


def test_holds_of_one_staircase_are_as_many_as_they_are_independent():
    inside = []
    for seed in range(60):
        stairs = staircase(seed)
        drift = slow_noise(stairs.time.size, 0.03, 2000.0, seed)
        low, high = fit_gravity([replace(stairs, input=stairs.input + drift)]).intervals["gravity"]
        inside.append(low <= G <= high)
    assert 0.88 <= np.mean(inside) <= 1.0


def test_the_result_stands_before_the_trials_and_full_tables_come_on_demand(tmp_path, capsys):
    paths = []
    for seed in range(2):
        trial = hand_trial(seed)
        paths.append(str(tmp_path / f"hand_{seed}.csv"))
        columns = np.stack((trial.time, trial.position, trial.velocity, trial.input), axis=1)
        np.savetxt(paths[-1], columns, delimiter=",", header="time,position,velocity,effort", comments="")
    arguments = [*paths, "--method", "thesis", "--experiment", "inertia_damping"]
    assert identify_cli.main(arguments) == 0
    said = capsys.readouterr().out
    assert (
        said.index("Average over 2 trials") < said.index("Regression of each trial") < said.index("inertial torque is")
    )
    assert re.search(r"hand_1\S* +│ +11\.\d+ \+- 0\.\d+", said)
    assert len(said.splitlines()) < 40
    assert "OLS Regression" not in said
    assert identify_cli.main([*arguments, "--verbose"]) == 0
    assert capsys.readouterr().out.count("OLS Regression") == 2


def test_the_interval_of_the_inertia_allows_for_what_is_not_known_of_the_timing():
    trials = [hand_trial(seed) for seed in range(3)]
    from_a_bag = [replace(t, meta={**t.meta, "topic": "/hw/joint_states"}) for t in trials]

    def half(recordings, skew=None):
        low, high = fit_inertia_damping(recordings, skew=skew).intervals["inertia"]
        return 0.5 * (high - low)

    scatter = half(trials, skew=0.0)
    for recordings, skew in ((trials, 0.005), (from_a_bag, 0.0005)):
        expected = np.hypot(scatter, 1.96 / np.sqrt(3.0) * skew * B)
        assert half(recordings) == pytest.approx(expected, rel=1e-3)
    with pytest.raises(DataError, match=r"skew is -0\.001 s; expected at least 0"):
        fit_inertia_damping(trials, skew=-0.001)


def test_an_actuator_that_reports_the_torque_of_the_environment_is_turned_and_said():
    result = fit_inertia_damping([hand_trial(seed, sign=-1.0) for seed in range(3)])
    assert result.sign == -1
    assert result.average["damping"] == pytest.approx(B, rel=0.01)
    assert any("signs are turned" in sentence for sentence in result.sentences)


def test_gravity_comes_back_from_both_directions_with_the_loop_named():
    recordings = [staircase(seed) for seed in range(3)]
    result = fit_gravity(recordings)
    low, high = result.intervals["gravity"]
    assert low <= G <= high
    assert result.average["gravity"] == pytest.approx(G, rel=0.02)
    assert result.hysteresis == pytest.approx(0.1, rel=0.25)
    assert len(static_holds(recordings[0])) == 36


def test_holds_follow_the_events_of_a_bag_where_there_are_any():
    recording = staircase(0)
    phases = [(1.0, "static", {}), (2.4, "dynamic", {}), (3.5, "static", {}), (4.9, "dynamic", {})]
    noted = Recording(recording.time, recording.position, None, recording.input, meta={"phases": phases})
    holds = static_holds(noted)
    assert [round(hold.start, 3) for hold in holds] == [1.0, 3.5]
    assert holds[1].position == pytest.approx(np.radians(20.0), abs=1e-3)


def test_the_figures_of_the_thesis_are_drawn(tmp_path):
    trials = [hand_trial(seed) for seed in range(6)]
    first = thesis_figures(TrialSet(fit_inertia_damping(trials), trials))
    assert {figure.name for figure in first} == {"effort_over_velocity", "effort_over_acceleration", "trials"}
    stairs = [staircase(0)]
    page = write_thesis_page(fit_gravity(stairs), stairs, tmp_path)
    assert {p.stem for p in (tmp_path / "figures").iterdir()} == {
        "dynamic_phase",
        "static_phase",
        "effort_over_sine",
    }
    assert re.search(r">gravity</th><td[^>]*>[\d.]+</td><td[^>]*>[^<]+</td><td[^>]*>N m</td>", page.read_text())


def test_what_the_regressions_need_is_asked_for():
    trial = hand_trial(0)
    blind = Recording(trial.time, trial.position, None, trial.input)
    with pytest.raises(DataError, match="has no velocity"):
        fit_inertia_damping([blind])
    with pytest.raises(DataError, match="static holds; expected at least 4"):
        fit_gravity([trial])
