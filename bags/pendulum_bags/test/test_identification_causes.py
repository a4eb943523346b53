"""Good recordings, made by SciPy alone, with one thing spoiled: the refusal or note names that and nothing else."""

import re
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Geometry, Options
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import PendulumError
from pendulum_testing.scipy_pendulum import coulomb_pendulum, tones

PERIOD, NOISE = 0.01, 5e-4
QUICK = Options(friction="coulomb", multi_start=False, folds=2)

WORDS = {
    "unit": r"in degrees|in revolutions|is the unit deg|unit: (deg|rev)",
    "zero": r"measured from",
    "sign": r"opposite sign",
    "wrap": r"it was wrapped",
    "gap": r"no samples for",
    "clock": r"stamps of the torque",
    "torque": r"torque is 0 throughout",
    "velocity": r"the velocity is",
    "position": r"moves by",
    "gain": r"CONTRADICTION",
    "window": r"--window",
    "hand": r"function of the angle alone",
}
"""How a sentence names a cause."""


@dataclass(frozen=True)
class Spoiled:
    """A table of time, position, velocity and torque, and how it is identified."""

    table: np.ndarray
    options: Options = QUICK


@cache
def good(seed, seconds=6.0):
    """Return the table of a pendulum that swings through large angles."""
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(round(seconds / PERIOD))
    drive = tones(rng, rng.uniform(1.2, 2.0))
    angle = coulomb_pendulum(drive, time, coulomb=rng.uniform(0.0, 0.1), start=(rng.uniform(0.5, 1.5), 0.0))
    noisy = angle + NOISE * rng.standard_normal(time.size)
    return np.column_stack((time, noisy, np.gradient(angle, time), drive(time)))


def whirling(seed):
    """Return the table of a pendulum that is driven over the top again and again."""
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(800)
    drive = tones(rng, 4.0, lowest=0.5)
    angle = coulomb_pendulum(drive, time, start=(2.5, 0.0))
    return np.column_stack(
        (time, angle + NOISE * rng.standard_normal(time.size), np.gradient(angle, time), drive(time))
    )


def columns(table, factor=(1.0, 1.0, 1.0, 1.0), shift=(0.0, 0.0, 0.0, 0.0)):
    return Spoiled(table * np.array(factor) + np.array(shift))


def late(table, seconds):
    return np.interp(table[:, 0] - seconds, table[:, 0], table[:, 3])


SPOILS = {
    "degrees": ("unit", lambda t, s: columns(t, (1.0, 180 / np.pi, 180 / np.pi, 1.0))),
    "revolutions": ("unit", lambda t, s: columns(t, (1.0, 0.5 / np.pi, 0.5 / np.pi, 1.0))),
    "upright": ("zero", lambda t, s: columns(t, shift=(0.0, np.pi, 0.0, 0.0))),
    "horizontal": ("zero", lambda t, s: columns(t, shift=(0.0, -np.pi / 2, 0.0, 0.0))),
    "elsewhere": ("zero", lambda t, s: columns(t, shift=(0.0, 1.1, 0.0, 0.0))),
    "sign": ("sign", lambda t, s: columns(t, (1.0, 1.0, 1.0, -1.0))),
    "wrap": ("wrap", lambda t, s: Spoiled(np.column_stack((t[:, 0], np.angle(np.exp(1j * t[:, 1])), t[:, 2:])))),
    "gap": ("gap", lambda t, s: Spoiled(np.delete(t, np.s_[250:330], axis=0))),
    "clock": ("clock", lambda t, s: Spoiled(np.column_stack((t[:, :3], late(t, 0.5 * (-1) ** s))))),
    "dead torque": ("torque", lambda t, s: columns(t, (1.0, 1.0, 1.0, 0.0))),
    "dead velocity": ("velocity", lambda t, s: columns(t, (1.0, 1.0, 0.0, 1.0))),
    "dead position": ("position", lambda t, s: columns(t, (1.0, 0.0, 0.0, 1.0))),
    "gain": (
        "gain",
        lambda t, s: replace(
            columns(t, (1.0, 1.0, 1.0, 2.5)), options=replace(QUICK, geometry=Geometry(1.5 / 9.80665 / 0.15, 0.15))
        ),
    ),
    "short window": ("window", lambda t, s: Spoiled(t, replace(QUICK, window=0.04))),
    "long window": ("window", lambda t, s: Spoiled(whirling(s), replace(QUICK, window=8.0))),
    "chaos": (None, lambda t, s: Spoiled(whirling(s))),
    "nothing": (None, lambda t, s: Spoiled(t)),
}
"""What is spoiled: the cause to be named, and how."""


def spoil(name, seed):
    table = good(seed)
    if name == "wrap":
        # Only an angle that passes the top can wrap.
        table = whirling(seed)
    return SPOILS[name][1](table, seed)


def verdict(spoiled, path):
    """Return the causes that are named, and whether the recording is refused."""
    header = "time,position,velocity,torque"
    np.savetxt(path, spoiled.table, delimiter=",", header=header, comments="", fmt="%.7g")
    try:
        result = identify([read_recording(path)], spoiled.options, profiles=0)
    except PendulumError as error:
        said, refused = [str(error)], True
    else:
        said = result.sentences()
        refused = result.refused or (result.geometry is not None and result.geometry.contradicts)
    named = {cause for cause, words in WORDS.items() if any(re.search(words, one) for one in said)}
    return named, refused, said


@pytest.mark.parametrize(("name", "seed"), [*((name, 1) for name in SPOILS), ("gap", 2)])
def test_what_is_spoiled_is_named_and_nothing_else(name, seed, tmp_path):
    cause = SPOILS[name][0]
    named, refused, said = verdict(spoil(name, seed), tmp_path / "run.csv")
    assert named == ({cause} if cause else set()), said[0]
    assert refused == (cause not in {None, "sign", "wrap", "gap"}), said[0]


def test_following_a_hint_leads_to_a_fit_that_is_taken(tmp_path):
    _, _, said = verdict(spoil("horizontal", 2), tmp_path / "run.csv")
    offset = float(re.search(r"`offset: (\S+)`", said[0])[1])
    mapping = {
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "position", "unit": "rad", "offset": offset},
        "input": {"column": "torque", "unit": "N m", "hold": "linear"},
    }
    mended = identify([read_recording(tmp_path / "run.csv", mapping)], QUICK, profiles=0)
    assert not mended.refused
    assert mended.model["gravity"] == pytest.approx(1.5, rel=0.02)


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
