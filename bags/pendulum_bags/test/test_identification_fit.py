"""Identification finds known truths, says what it does not know, and contradicts a wrong geometry loudly."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from threadpoolctl import threadpool_limits

from pendulum_bags.commands import identify_cli
from pendulum_bags.identification.excitation import Limits, design_excitation
from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Geometry, Options, default_window
from pendulum_bags.identification.result import load_fit_model
from pendulum_bags.identification.uncertainty import profile_interval
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_plant_file, pendulum_plant
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

TRUTH = pendulum_plant(
    inertia=0.05, damping=0.03, gravity=1.5, coulomb_friction=0.05, angle_offset=0.01, transport_delay=0.006
)


def run(seed=0, plant=TRUTH, seconds=6.0, noise=1e-3, amplitude=1.2, period=0.01):
    rng = np.random.default_rng(seed)
    time = period * np.arange(round(seconds / period))
    effort = multisine(time, amplitude, rng) if amplitude else np.zeros_like(time)
    return synthetic_recording(plant, effort, period, rng, noise=noise, start=(0.0, 0.0) if amplitude else (1.5, 0.0))


@pytest.fixture(scope="module")
def found():
    return identify([run(period=0.005)])


def test_everything_is_found_unaided(found):
    model = found.model
    assert found.fit.chosen.friction == "coulomb"
    assert model["inertia"] == pytest.approx(TRUTH.inertia, rel=5e-3)
    assert model["gravity"] == pytest.approx(TRUTH.gravity, rel=5e-3)
    assert model["damping"] == pytest.approx(TRUTH.damping, rel=5e-2)
    assert model["coulomb_friction"] == pytest.approx(TRUTH.coulomb_friction, rel=5e-2)
    assert model["transport_delay"] == pytest.approx(TRUTH.transport_delay, abs=5e-4)
    assert model["angle_offset"] == pytest.approx(TRUTH.angle_offset, abs=1e-3)
    assert found.tests.white
    assert found.score == pytest.approx(1e-3, rel=0.1)


def test_a_profile_interval_agrees_with_the_covariance_where_the_model_is_right(found):
    interval = found.uncertainty.intervals["inertia"]
    low, high = profile_interval(found.fit, "inertia")
    assert high - low == pytest.approx(interval.high - interval.low, rel=0.2)
    assert low < found.model["inertia"] < high


def test_intervals_cover_the_truth():
    inside = total = 0
    for seed in range(8):
        result = identify([run(100 + seed)], Options(friction="coulomb", folds=2, multi_start=False), profiles=0)
        for name in ("inertia", "damping", "gravity", "coulomb_friction", "transport_delay"):
            interval = result.uncertainty.intervals[name]
            truth = getattr(TRUTH, name)
            inside += interval.low <= truth <= interval.high
            total += 1
    assert inside / total >= 0.8


def test_a_reversed_sign_is_found_and_said():
    recording = run(5)
    turned = Recording(recording.time, recording.position, None, -recording.input, hold="zero", meta=recording.meta)
    result = identify([turned], Options(friction="coulomb", folds=2), profiles=0)
    assert result.fit.sign_flipped
    assert result.model["gravity"] == pytest.approx(TRUTH.gravity, rel=1e-2)
    assert any("opposite sign" in sentence for sentence in result.sentences())


def test_a_window_with_a_push_by_hand_does_not_move_the_fit_and_is_named():
    recording = run(7)
    position = recording.position.copy()
    pushed = (recording.time > 3.0) & (recording.time < 4.0)
    position[pushed] += 0.4 * np.sin(np.pi * (recording.time[pushed] - 3.0)) ** 2
    changed = Recording(recording.time, position, None, recording.input, hold="zero", meta=recording.meta)
    result = identify([changed], Options(friction="coulomb", folds=2), profiles=0)
    assert result.model["gravity"] == pytest.approx(TRUTH.gravity, rel=3e-2)
    assert any("3.00 to" in sentence and "outside force" in sentence for sentence in result.sentences())


def test_a_free_swing_says_that_the_scale_cannot_be_determined():
    recording = run(8, amplitude=0.0)
    free = Recording(recording.time, recording.position, None, recording.input, input_kind="none", hold="zero")
    result = identify([free], Options(friction="coulomb", folds=2), profiles=0)
    assert result.model.natural_frequency == pytest.approx(np.sqrt(30.0), rel=1e-2)
    assert any("not the absolute scale" in sentence for sentence in result.sentences())


def test_a_voltage_input_normalises_the_inertia():
    recording = run(9)
    volts = Recording(
        recording.time, recording.position, None, recording.input / 0.4, input_kind="voltage", hold="zero"
    )
    result = identify([volts], Options(friction="coulomb", folds=2, window=1.0), profiles=0)
    assert result.model["inertia"] == 1.0
    assert result.model["input_gain"] == pytest.approx(0.4 / TRUTH.inertia, rel=2e-2)
    assert result.model.natural_frequency == pytest.approx(np.sqrt(30.0), rel=5e-3)


@pytest.mark.parametrize(
    ("kind", "seconds", "window"),
    [
        ("voltage", 6.0, 2.0),
        ("voltage", 48.0, 4.0),
        ("voltage", 375.0, 5.0),
        ("effort", 375.0, 1.0),
        ("none", 10.0, 1.0),
        ("position_goal", 10.0, None),
    ],
)
def test_windows_are_long_where_a_drive_damps_and_enough_are_left(kind, seconds, window):
    assert default_window(kind, seconds) == window


def test_a_wrong_geometry_is_contradicted_and_a_right_one_is_not(found):
    wrong = identify(
        [run()], Options(friction="coulomb", folds=2, multi_start=False, geometry=Geometry(0.1, 0.5)), profiles=0
    )
    assert wrong.geometry is not None
    assert wrong.geometry.contradicts
    assert wrong.sentences()[0].startswith("CONTRADICTION: gravity is 1.5")
    right = identify(
        [run()], Options(friction="coulomb", folds=2, geometry=Geometry(1.5 / 9.80665 / 0.15, 0.15)), profiles=0
    )
    assert right.geometry is not None
    assert not right.geometry.contradicts


def test_a_known_mass_and_length_fix_the_scale_of_a_wrong_torque_sensor():
    recording = run(11)
    wrong = Recording(recording.time, recording.position, None, 1.3 * recording.input, hold="zero")
    geometry = Geometry(1.5 / 9.80665 / 0.15, 0.15)
    result = identify([wrong], Options(friction="coulomb", folds=2, geometry=geometry, fix_scale=True), profiles=0)
    assert result.model["inertia"] == pytest.approx(TRUTH.inertia, rel=1e-2)
    assert result.model["input_gain"] == pytest.approx(1.0 / 1.3, rel=1e-2)


def test_the_plant_file_carries_intervals_and_provenance(found, tmp_path):
    found.write(tmp_path / "plant.yaml", name="mine")
    plant, provenance = load_plant_file(tmp_path / "plant.yaml")
    assert plant.name == "mine"
    assert plant.inertia == pytest.approx(found.model["inertia"])
    low, high = provenance["intervals"]["inertia"]
    assert low < TRUTH.inertia < high
    assert provenance["data"][0]["samples"] == 1200
    assert load_fit_model(tmp_path / "plant.json").vector == pytest.approx(found.model.vector)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("parameters", [1.0], "expected numbers by name"),
        ("parameters", {"inertia": None}, "'inertia' is None; expected a finite number"),
        ("parameters", {"inertia": 10**400}, "expected a finite number"),
        ("parameters", {"inertia": 1.0, "mass": 1.0}, "has no parameter 'mass'"),
        ("duty_gain", "1", "'duty_gain' is 1; expected a finite number"),
        ("friction", [], "expected one of viscous"),
        ("input_kind", "force", "'input_kind' is 'force'; expected one of effort"),
    ],
)
def test_a_spoilt_identification_is_refused_by_the_entry(found, tmp_path, key, value, message):
    found.write(tmp_path / "plant.yaml")
    path = tmp_path / "plant.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(DataError, match=message):
        load_fit_model(path)


def test_the_same_data_give_the_same_result(found):
    options = Options(friction="coulomb", folds=2, multi_start=False)
    first = identify([run(period=0.005)], options, profiles=0).model.vector
    with threadpool_limits(limits=1, user_api="blas"):  # as on a worker of a cluster
        second = identify([run(period=0.005)], options, profiles=0).model.vector
    assert list(first) == list(second)
    assert first == pytest.approx(found.model.vector, rel=2e-2, abs=1e-3)


def test_standing_still_and_mixed_inputs_are_refused():
    time = np.arange(0.0, 2.0, 0.01)
    still = Recording(time, np.zeros_like(time), None, np.zeros_like(time))
    with pytest.raises(DataError, match="expected a moving pendulum"):
        identify([still])
    other = Recording(time, np.sin(time), None, time, input_kind="voltage", hold="zero")
    with pytest.raises(DataError, match="different inputs"):
        identify([run(), other])
    with pytest.raises(DataError, match="friction is 'magic'"):
        Options(friction="magic")


def test_a_designed_excitation_keeps_its_limits_and_predicts_its_intervals():
    limits = Limits(effort=1.5, speed=6.0, angle=1.2)
    design = design_excitation(TRUTH, limits, duration=8.0, period=0.005, trials=12, noise=1e-3)
    assert np.max(np.abs(design.effort)) <= 1.5
    assert np.max(np.abs(design.position)) <= 1.2
    assert np.max(np.abs(design.velocity)) <= 6.0
    recording = synthetic_recording(TRUTH, design.effort, 0.005, np.random.default_rng(1), noise=1e-3)
    result = identify([recording], Options(friction="coulomb", folds=2, torque_offset=False), profiles=0)
    for name in ("inertia", "damping", "gravity", "coulomb_friction"):
        interval = result.uncertainty.intervals[name]
        assert 0.5 * (interval.high - interval.low) == pytest.approx(design.predicted[name], rel=0.5)


def test_a_late_stamp_of_the_input_is_no_delay_of_the_plant(tmp_path):
    recording = run()
    late = replace(recording, input_time=recording.time + 0.012)
    result = identify([late], Options(friction="coulomb", folds=2, multi_start=False), profiles=0)
    assert result.model["transport_delay"] == pytest.approx(-0.006, abs=1e-3)
    assert any("stamped late" in sentence for sentence in result.sentences())
    plant, provenance = load_plant_file(result.write(tmp_path / "plant.yaml"))
    assert plant.transport_delay == 0.0
    content = yaml.safe_load((tmp_path / "plant.yaml").read_text())
    assert "interval" not in content["parameters"]["transport_delay"]
    assert "interval" in content["parameters"]["inertia"]
    assert any(text.startswith("transport_delay is 0 s here, and -0.00") for text in provenance["remarks"])


def test_no_interval_of_a_plant_file_leaves_its_value_out(found, tmp_path):
    content = yaml.safe_load(found.write(tmp_path / "plant.yaml").read_text())
    held = {n: p["interval"] for n, p in content["parameters"].items() if "interval" in p}
    assert {"inertia", "gravity", "transport_delay"} <= held.keys()
    assert all(low <= content["parameters"][name]["value"] <= high for name, (low, high) in held.items())


def test_intervals_obtained_stand_beside_those_that_the_excitation_promised():
    recording = run()
    promised = {"predicted": {"inertia": 1e-4, "gravity": 3e-3, "magic": 1.0, "damping": float("nan")}}
    played = replace(recording, meta={**recording.meta, "pendulum.excitation": promised})
    result = identify([played], Options(friction="coulomb", folds=2, multi_start=False), profiles=0)
    assert result.predicted == {"inertia": 1e-4, "gravity": 3e-3}
    assert any("the excitation predicted: inertia" in sentence for sentence in result.sentences())


def test_the_command_line_prints_json_and_ends_with_3_on_a_contradiction(tmp_path, capsys):
    recording = run()
    table = np.stack((recording.time, recording.position, recording.input), axis=1)
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="time,position,torque", comments="")
    arguments = [str(path), "--friction", "coulomb", "--json", "--mass", "0.1", "--length", "0.5"]
    assert identify_cli.main([*arguments, "--out", str(tmp_path / "plant.yaml")]) == 3
    content = json.loads(capsys.readouterr().out)
    assert content["geometry"]["contradicts"]
    assert content["parameters"]["gravity"] == pytest.approx(1.5, rel=1e-2)
    page = (tmp_path / "plant" / "index.html").read_text()
    assert "CONTRADICTION" in page
    assert page.count("data:image/png;base64") == 3
    assert identify_cli.main([str(tmp_path / "none.csv")]) == 2
    assert "does not exist" in capsys.readouterr().err
