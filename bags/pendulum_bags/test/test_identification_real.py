"""Real recordings of three rigs: what a fit must reach on data that took no part in it."""

import numpy as np
import pytest

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Options
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.runs.read_recording import read_recording


@pytest.fixture(scope="module")
def swing_up(shared_data):
    folder = shared_data / "dfki_torque_limited_simple_pendulum"
    return {name: read_recording(folder / f"{name}_measured.csv") for name in ("ddp", "pd", "energy_1kg")}


@pytest.fixture(scope="module")
def from_swing_up(swing_up):
    return identify([swing_up["ddp"]])


def test_the_swing_up_is_fitted_to_its_sensor_noise(swing_up, from_swing_up):
    assert window_score(from_swing_up.model, swing_up["ddp"]).rms <= 0.0036


def test_its_parameters_predict_another_run(swing_up, from_swing_up):
    assert window_score(from_swing_up.model, swing_up["pd"]).rms <= 0.038


def test_the_scale_is_said_to_be_uncertain_and_the_frequency_less_so(from_swing_up):
    intervals = from_swing_up.uncertainty.intervals
    assert intervals["inertia"].relative > 0.1
    assert intervals["gravity"].relative > 0.1
    assert intervals["natural_frequency"].relative < 0.5 * intervals["gravity"].relative
    # Scales and ruler say 4.477 rad/s.
    assert intervals["natural_frequency"].low < 4.477 < intervals["natural_frequency"].high
    assert any("common scale of inertia and gravity" in sentence for sentence in from_swing_up.sentences())


def test_a_run_with_a_hand_in_it_keeps_its_frequency(swing_up):
    result = identify([swing_up["energy_1kg"]], Options(friction="viscous", multi_start=False, folds=2), profiles=0)
    assert 4.3 < result.model.natural_frequency < 4.55
    assert any("outside force" in sentence for sentence in result.sentences())


def test_a_voltage_driven_disc_runs_free_over_unseen_data(shared_data):
    disc = read_recording(shared_data / "tue_unbalanced_disk" / "first_20000.csv", "voltage_40hz")
    result = identify([disc.rows(0, 2500)], Options(friction="coulomb", multi_start=False, folds=2), profiles=0)
    assert result.model["transport_delay"] == pytest.approx(0.025, abs=0.003)
    assert free_run(result.model, disc.rows(15000)).rms <= 0.018


def test_servo_logs_that_took_no_part_are_predicted_better_than_the_authors_predict_all_of_theirs(shared_data):
    paths = sorted((shared_data / "rhoban_bam_xl330").glob("*.json"))
    logs = [read_recording(path) for path in paths]
    errors = []
    for left_out in (1, 2):
        rest = [log for i, log in enumerate(logs) if i != left_out]
        result = identify(rest, Options(friction="gear_load", folds=1, multi_start=False), profiles=0)
        errors.append(free_run(result.model, logs[left_out], fitted=False).mean_absolute)
    # 0.0557 rad is the best of the authors' models over all of their logs, which it was fitted to.
    assert np.mean(errors) < 0.0557
