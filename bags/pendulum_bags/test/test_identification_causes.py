"""Good recordings, made by SciPy alone, with one thing spoiled: the refusal or note names that and nothing else."""

import numpy as np
import pytest

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Options
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import DataError
from pendulum_testing.scipy_pendulum import coulomb_pendulum, tones
from pendulum_testing.spoiled_recordings import (
    NOISE,
    PERIOD,
    QUICK,
    SPOILS,
    TAKEN,
    Spoiled,
    hinted,
    pendulum,
    spoil,
    verdict,
)
from pendulum_testing.undetermined_recordings import small_staircase


@pytest.mark.parametrize(("name", "seed"), [*((name, 1) for name in SPOILS), ("gap", 2)])
def test_what_is_spoiled_is_named_and_nothing_else(name, seed, tmp_path):
    cause = SPOILS[name][0]
    named, refused, said = verdict(spoil(name, seed), tmp_path / "run.csv")
    assert named == ({cause} if cause else set()), said[0]
    assert refused == (name not in TAKEN), said[0]


@pytest.mark.parametrize("name", ["horizontal", "position and velocity", "velocity in degrees", "short window"])
def test_following_a_hint_leads_to_a_fit_that_is_taken(name, tmp_path):
    path = tmp_path / "run.csv"
    spoiled = spoil(name, 2)
    _, _, said = verdict(spoiled, path)
    options, mapping = hinted(spoiled, said[0])
    mended = identify([read_recording(path, mapping)], options, profiles=0)
    assert not mended.refused
    assert mended.model["gravity"] == pytest.approx(pendulum(2)["gravity"], rel=0.02)


@pytest.mark.parametrize("shape", ["gravity compensation", "spring"])
def test_motion_by_hand_is_refused_for_the_torque_and_by_no_reading_of_the_angle(shape, tmp_path):
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(600)
    angle = 0.6 * np.sin(0.9 * time) + 0.5 * np.sin(2.3 * time + 1.0) + 0.3 * np.sin(0.31 * time + 2.0)
    torque = 3.3 * np.sin(angle) if shape == "gravity compensation" else 1.5 * angle
    torque += 0.02 * rng.standard_normal(time.size)
    table = np.column_stack((time, angle + NOISE * rng.standard_normal(time.size), np.gradient(angle, time), torque))
    named, refused, said = verdict(Spoiled(table), tmp_path / "run.csv")
    assert (named, refused) == ({"hand"}, True), said[0]


def test_a_motor_at_constant_speed_determines_nothing():
    time = 0.005 * np.arange(200)
    angle = 30.0 * (time - 0.07 * (1.0 - np.exp(-time / 0.07)))
    steady = Recording(time, np.round(angle, 4), None, np.full(200, 0.1), input_kind="voltage", hold="zero")
    said = identify([steady], QUICK).sentences()[0]
    assert said.startswith("REFUSED: the recording does not determine")
    assert "e+" not in said


def test_a_joint_that_a_constant_torque_holds_still_determines_nothing():
    rng = np.random.default_rng(1)
    time = PERIOD * np.arange(800)
    torque = np.minimum(0.885, 0.6 * time)
    # It follows the torque to its rest and is then pushed a little, by nothing that is in the recording.
    angle = np.arcsin(torque / 3.4) + 0.03 * np.exp(-(((time - 5.0) / 0.3) ** 2)) * np.sin(20.0 * time)
    noisy = angle + 8e-4 * rng.standard_normal(time.size)
    result = identify([Recording(time, noisy, None, torque)], QUICK)
    # Refused, or with the gravity that its rest shows.
    assert result.refused or result.model["gravity"] == pytest.approx(3.4, rel=0.3)


def test_a_torque_that_never_changes_determines_no_scale():
    time = PERIOD * np.arange(400)
    angle = coulomb_pendulum(lambda t: 0.3 + 0.0 * np.asarray(t), time, start=(1.2, 0.0))
    with pytest.raises(DataError, match=r"the torque is 0.3 N m throughout, which no fit can tell from a zero error"):
        identify([Recording(time, angle, None, np.full(400, 0.3))], QUICK)


def test_a_gravity_of_0_that_may_be_anything_is_refused():
    trial = small_staircase(np.random.default_rng([101, *b"small_staircase"]))
    result = identify([trial.recording])
    assert result.refused, result.sentences()[0]


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_pendulum_with_coulomb_friction_and_no_noise_is_complete_and_has_that_friction(hold):
    time = PERIOD * np.arange(600)
    drive = tones(np.random.default_rng(1), 1.2)
    angle = coulomb_pendulum(drive, time)
    # Read as held, the torque is late by half a sample: a delay, and nothing that is missing.
    result = identify([Recording(time, angle, None, drive(time), hold=hold)], Options(multi_start=False, folds=2))
    assert not result.incomplete, result.sentences()[0]
    interval = result.uncertainty.intervals["coulomb_friction"]
    assert interval.low > 0.0
    assert interval.value == pytest.approx(0.05, rel=0.05)
    assert not any("none at all" in one and "coulomb" in one for one in result.sentences())
