"""Identification notices data that no pendulum model explains, and readings of them that are wrong."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

from pendulum_bags.commands import identify_cli
from pendulum_bags.identification.geometry import check_geometry
from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Geometry, Options
from pendulum_bags.identification.problem import prepare
from pendulum_bags.runs.datasets import Recording, distinct_names
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import pendulum_plant
from pendulum_testing.bag_messages import joint_state, write_bag
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

TRUTH = pendulum_plant(inertia=0.05, damping=0.03, gravity=1.5, coulomb_friction=0.05, transport_delay=0.006)
QUICK = Options(friction="coulomb", multi_start=False, folds=2)


def run(seed=0, *, seconds=6.0, period=0.01, amplitude=1.2, plant=TRUTH, start=(0.0, 0.0), **kwargs):
    rng = np.random.default_rng(seed)
    time = period * np.arange(round(seconds / period))
    effort = multisine(time, amplitude, rng) if amplitude else np.zeros_like(time)
    return synthetic_recording(plant, effort, period, rng, start=start, **kwargs)


def save(path, recording, *, header="time,position,torque", before=""):
    table = np.stack((recording.time, recording.position, recording.input), axis=1)
    np.savetxt(path, table, delimiter=",", header=before + header, comments="")
    return path


@pytest.fixture(scope="module")
def known():
    return run()


@pytest.mark.parametrize(
    ("factor", "shift", "words"),
    [
        (1.0, -np.pi, "measured from upright"),
        (180.0 / np.pi, 0.0, "in degrees"),
        (180.0 / np.pi, 180.0, "in degrees and measured from upright"),
        (1.0, 0.5 * np.pi, "measured from the horizontal"),
    ],
)
def test_an_angle_that_is_read_wrongly_is_refused_by_the_right_name(factor, shift, words, tmp_path):
    short = run(seconds=3.0, period=0.02)
    result = identify([replace(short, position=factor * short.position + shift)], QUICK, profiles=0)
    assert result.refused
    assert result.sentences()[0].startswith(f"REFUSED: the angle seems to be {words};")
    with pytest.raises(DataError, match="No plant file is written"):
        result.write(tmp_path / "plant.yaml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["none", "voltage"])
def test_an_angle_from_upright_is_refused_for_other_inputs_too(kind):
    drive = 0.0 if kind == "none" else 1.2
    recording = run(3, seconds=3.0, period=0.01, amplitude=drive, start=(0.0, 0.0) if drive else (1.5, 0.0))
    turned = replace(recording, position=recording.position - np.pi, input_kind=kind)
    result = identify([turned], replace(QUICK, window=1.0), profiles=0)
    assert "measured from upright" in result.sentences()[0]


def test_a_zero_that_is_elsewhere_is_not_taken_for_degrees():
    short = run(seconds=3.0, period=0.01)
    result = identify([replace(short, position=short.position + 0.7)], QUICK, profiles=0)
    assert "in degrees" not in result.sentences()[0]


def test_a_motion_guided_by_hand_is_refused_with_exit_code_3_and_no_plant_file(tmp_path, capsys):
    time = np.arange(0.0, 4.0, 0.02)
    angle = 0.8 * np.sin(1.9 * time) + 0.5 * np.sin(3.1 * time + 1.0)
    # The motor carries gravity, the hand does the rest: nothing of the motion is in the torque.
    guided = Recording(time, angle, None, 1.5 * np.sin(angle), hold="zero")
    path = save(tmp_path / "guided.csv", guided)
    out = tmp_path / "plant.yaml"
    assert identify_cli.main([str(path), "--friction", "coulomb", "--out", str(out)]) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert "REFUSED: the recorded torque is a function of the angle alone" in said
    assert not out.exists()
    assert not out.with_suffix(".json").exists()


def test_an_input_that_has_nothing_to_do_with_the_motion_is_refused():
    rng = np.random.default_rng(6)
    time = np.arange(0.0, 4.0, 0.02)
    angle = 0.5 * sum(np.sin(2.0 * np.pi * f * time + rng.uniform(0.0, 6.0)) for f in (1.3, 2.9, 4.7, 6.1))
    result = identify([Recording(time, angle, None, multisine(time, 1.2, rng), hold="zero")], QUICK, profiles=0)
    assert result.sentences()[0].startswith("REFUSED: the model explains next to nothing. It misses the angle by")


@pytest.mark.parametrize("scale", [1.0, 1e-4])
def test_two_constant_torques_that_lift_a_pendulum_determine_it(scale):
    plant = pendulum_plant(inertia=0.02 * scale, damping=0.01 * scale, gravity=0.6 * scale)
    rng = np.random.default_rng(5)
    runs = [synthetic_recording(plant, np.full(1200, level * scale), 0.005, rng) for level in (0.3, 0.2)]
    result = identify(runs, QUICK, profiles=0)
    assert not result.refused, result.sentences()[0]
    for name in ("inertia", "damping", "gravity"):
        assert result.model[name] == pytest.approx(getattr(plant, name), rel=0.05)


def test_a_good_fit_is_not_refused_however_its_windows_are_cut(known):
    for window in (0.5, 3.0):
        result = identify([known], replace(QUICK, window=window), profiles=0)
        assert not result.refused
        assert result.explained.share < 0.05
    noisy = run(5, seconds=3.0, noise=2e-2)
    assert not identify([noisy], QUICK, profiles=0).refused


def test_a_push_by_hand_in_one_window_is_named_in_time_since_the_start_and_is_no_refusal(known):
    position = known.position.copy()
    pushed = (known.time > 3.0) & (known.time < 4.0)
    position[pushed] += 1.5 * np.sin(np.pi * (known.time[pushed] - 3.0)) ** 2
    since_1970 = replace(known, time=known.time + 1.7e9, position=position)
    result = identify([since_1970], QUICK, profiles=0)
    assert not result.refused
    assert any("3.00 to 3.99 s after its start" in sentence for sentence in result.sentences())


def test_a_plant_that_no_candidate_can_be_is_said_loudly_to_have_no_honest_interval():
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 6.0, 0.005)
    effort = multisine(time, 1.2, rng)
    # Drag that grows with the square of speed is no part of a friction model by name.
    theta, omega, angles = 0.0, 0.0, []
    for u in effort:
        angles.append(theta)
        for _ in range(20):
            torque = u - 0.03 * omega - 0.02 * omega * abs(omega) - 1.5 * np.sin(theta)
            omega += 0.00025 * torque / 0.05
            theta += 0.00025 * omega
    position = np.array(angles) + 1e-3 * rng.standard_normal(time.size)
    result = identify([Recording(time, position, None, effort, hold="zero")], QUICK, profiles=0)
    said = result.sentences()
    assert said[0].startswith("MODEL INCOMPLETE: what the fit leaves over looks like quadratic drag")
    assert not any("the intervals allow for it" in sentence for sentence in said)
    assert result.to_dict()["incomplete"]


def test_the_shipped_simulation_by_euler_is_not_said_to_be_known_to_a_quarter_of_a_percent(pytestconfig):
    folder = pytestconfig.rootpath / "bags" / "examples" / "regulation_sim"
    result = identify([read_recording(folder)], replace(QUICK, friction="viscous"), profiles=0)
    assert result.sentences()[0].startswith("MODEL INCOMPLETE: what the fit leaves over depends on the past input")


def test_a_gravity_of_nothing_contradicts_a_known_mass_and_length(known):
    result = identify([known], QUICK, profiles=0)
    turned = result.model.with_vector(
        np.where(result.model.vector == result.model["gravity"], 0.0, result.model.vector)
    )
    intervals = {k: v for k, v in result.uncertainty.intervals.items() if k not in {"gravity", "natural_frequency"}}
    check = check_geometry(turned, replace(result.uncertainty, intervals=intervals), Geometry(1.0, 0.15))
    assert check is not None
    assert check.contradicts
    assert check.sentences[0].startswith("CONTRADICTION: gravity is 0 N m")


def test_mass_and_length_fix_the_scale_of_a_free_swing():
    swing = replace(run(8, amplitude=0.0, start=(1.5, 0.0)), input_kind="none")
    geometry = Geometry(1.5 / 9.80665 / 0.15, 0.15)
    result = identify([swing], replace(QUICK, geometry=geometry, fix_scale=True), profiles=0)
    assert result.model["inertia"] == pytest.approx(TRUTH.inertia, rel=1e-2)
    assert result.model["damping"] == pytest.approx(TRUTH.damping, rel=0.1)
    assert not any("only ratios" in sentence for sentence in result.sentences())


def test_a_torque_of_zeros_is_taken_for_a_free_swing():
    swing = run(8, amplitude=0.0, start=(1.5, 0.0))
    result = identify([swing], QUICK, profiles=0, held_out=[run(9, amplitude=0.0, start=(1.2, 0.0))])
    assert result.model.input_kind == "none"
    assert any("taken for a free swing" in sentence for sentence in result.sentences())
    assert result.model.natural_frequency == pytest.approx(np.sqrt(30.0), rel=1e-2)


def test_a_recording_that_rests_most_of_the_time_is_judged_without_a_division_by_zero(known):
    moving = known.time < 1.95
    still = replace(known, position=np.where(moving, known.position, 0.0), input=np.where(moving, known.input, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = identify([still], QUICK, profiles=0)
    # What moves is the measure: rest, which fits to the last digit, makes no motion an outside force.
    assert len(result.tests.outliers) < 2


def test_held_out_recordings_of_one_name_have_a_score_each(known):
    others = [
        replace(run(seed), meta={"source": f"{day}/run.csv"}) for seed, day in ((1, "mon"), (2, "tue"), (3, "wed"))
    ]
    result = identify([known], QUICK, profiles=0, held_out=others)
    assert list(result.held_out) == ["mon/run.csv", "tue/run.csv", "wed/run.csv"]
    assert distinct_names([known, known]) == ["synthetic (1)", "synthetic (2)"]


def test_data_that_would_count_twice_are_refused(known):
    with pytest.raises(DataError, match="same samples as"):
        identify([known, known], QUICK)
    with pytest.raises(DataError, match="took part in the fit"):
        identify([known], QUICK, held_out=[known])


def test_a_wrapped_angle_is_unwrapped_with_a_word_in_radians_and_degrees(tmp_path):
    recording = run(4, amplitude=2.5)
    assert np.ptp(recording.position) > 2.0 * np.pi
    wrapped = replace(recording, position=np.angle(np.exp(1j * recording.position)))
    read = read_recording(save(tmp_path / "run.csv", wrapped))
    turns = np.round((read.position[0] - recording.position[0]) / (2.0 * np.pi))
    np.testing.assert_allclose(read.position - 2.0 * np.pi * turns, recording.position, atol=1e-9)
    assert read.meta["unwrapped"] > 0
    degrees = replace(recording, position=np.degrees(recording.position) % 360.0)
    mapping = {
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "position", "unit": "deg"},
        "input": {"column": "torque", "unit": "N m", "hold": "zero"},
    }
    again = read_recording(save(tmp_path / "deg.csv", degrees), mapping)
    np.testing.assert_allclose(np.diff(again.position), np.diff(recording.position), atol=1e-9)
    result = identify([again], QUICK, profiles=0)
    assert result.model["gravity"] == pytest.approx(1.5, rel=2e-2)
    assert any("it was wrapped" in sentence for sentence in result.sentences())


def test_a_wrapped_angle_of_a_bag_is_unwrapped_too(tmp_path):
    recording = run(4, amplitude=2.5)
    turned = np.angle(np.exp(1j * recording.position)).tolist()
    velocity = np.gradient(recording.position, recording.time).tolist()
    joint = ["pendulum_joint"]
    messages = []
    for index, time in enumerate(recording.time):
        stamp = 1_700_000_000_000_000_000 + round(float(time) * 1e9)
        state = joint_state(stamp, "", joint, [turned[index]], [velocity[index]], [0.0])
        applied = joint_state(stamp, "", joint, [], [], [float(recording.input[index])])
        messages += [("/hw/joint_states", stamp, state), ("/hw/applied_effort", stamp, applied)]
    read = read_recording(write_bag(tmp_path / "bag", messages, seal_every=1000))
    assert read.meta["unwrapped"] > 0
    np.testing.assert_allclose(np.diff(read.position), np.diff(recording.position)[: len(read.position) - 1], atol=1e-9)


def test_an_angle_that_jumps_by_no_turn_is_refused(tmp_path):
    known = run(period=0.005)
    position = known.position.copy()
    position[700:] += 2.0
    with pytest.raises(DataError, match=r"jumps by 1\.99 rad in 0\.005 s"):
        read_recording(save(tmp_path / "run.csv", replace(known, position=position)))


def test_no_window_reaches_across_a_gap_and_the_gap_is_said(known):
    keep = (known.time < 2.3) | (known.time > 2.7)
    cut = Recording(known.time[keep], known.position[keep], None, known.input[keep], hold="zero")
    piece = prepare(cut, 1.0)
    for first, stop in piece.windows:
        assert np.max(np.diff(cut.time[first:stop])) < 0.02
    result = identify([cut], QUICK, profiles=0)
    assert result.model["gravity"] == pytest.approx(1.5, rel=2e-3)
    assert any("no samples for 0.42 s from 2.29 s after its start" in sentence for sentence in result.sentences())
    # The stream of the input may have the gap while the motion goes on.
    lossy = replace(known, input=known.input[keep], input_time=known.time[keep])
    piece = prepare(lossy, 1.0)
    middle = (lossy.time > 2.3) & (lossy.time < 2.7)
    assert not np.any(piece.mask & middle)


def test_a_held_command_that_was_read_as_a_measurement_is_asked_about(tmp_path, capsys):
    truth = TRUTH.with_values(transport_delay=0.0)
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 6.0, 0.01)
    recording = synthetic_recording(truth, multisine(time, 1.2, rng), 0.01, rng)
    path = save(tmp_path / "run.csv", recording)
    arguments = [str(path), "--friction", "coulomb", "--json"]
    assert identify_cli.main(arguments) == 0
    asked = json.loads(capsys.readouterr().out)
    assert asked["parameters"]["transport_delay"] == pytest.approx(0.005, abs=2e-4)
    assert any("--hold zero" in sentence for sentence in asked["sentences"])
    assert identify_cli.main([*arguments, "--hold", "zero"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["parameters"]["transport_delay"] == pytest.approx(0.0, abs=2e-4)
    assert not any("--hold zero" in sentence for sentence in told["sentences"])


def test_lines_before_the_header_are_skipped_and_a_drift_is_taken_from_the_input(tmp_path, known):
    drifting = replace(known, input=known.input + 0.1 * known.time)
    path = save(tmp_path / "run.csv", drifting, before="made by a logger\nrig 7\n")
    mapping = {
        "skip": 2,
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "position", "unit": "rad"},
        "input": {"column": "torque", "unit": "N m", "hold": "zero", "detrend": "linear"},
    }
    read = read_recording(path, mapping)
    assert read.time.size == known.time.size
    assert abs(np.polyfit(read.time, read.input, 1)[0]) < 1e-9
    assert read_recording(save(tmp_path / "numbers.csv", known, before="1,2,3\n")).time.size == known.time.size
    with pytest.raises(DataError, match="detrend of input is 'yes'"):
        read_recording(path, {**mapping, "input": {**mapping["input"], "detrend": "yes"}})


def test_each_recording_may_have_a_mapping_of_its_own(tmp_path, capsys):
    first, second = run(1), run(2)
    save(tmp_path / "a.csv", first)
    save(tmp_path / "b.csv", replace(second, position=np.degrees(second.position)), header="t,deg,u")
    base = "format: pendulum_columns/1\n"
    (tmp_path / "a.yaml").write_text(
        base + "time: {column: time, unit: s}\nposition: {column: position, unit: rad}\n"
        "input: {column: torque, unit: N m, hold: zero}\n"
    )
    (tmp_path / "b.yaml").write_text(
        base
        + "time: {column: t, unit: s}\nposition: {column: deg, unit: deg}\ninput: {column: u, unit: N m, hold: zero}\n"
    )
    arguments = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--friction", "coulomb", "--json"]
    maps = ["--mapping", str(tmp_path / "a.yaml"), "--mapping", str(tmp_path / "b.yaml")]
    assert identify_cli.main([*arguments, *maps]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"]["gravity"] == pytest.approx(1.5, rel=1e-2)
    assert identify_cli.main([*arguments, *maps, *maps[:2]]) == 2
    assert "--mapping is given 3 times for 2 recordings" in capsys.readouterr().err


def test_no_page_is_taken_where_there_is_none_and_named_as_typed_where_it_is_refused(capsys):
    assert identify_cli.main(["recording.csv", "--plant", "acrobot", "--no-page"]) == 2
    assert "recording.csv does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["angle_offset", "torque_offset"])
def test_each_recording_may_have_a_zero_of_its_own(name):
    plants = [TRUTH.with_values(**{name: value}) for value in (0.05, -0.03)]
    pair = [run(seed, seconds=4.0, plant=plant) for seed, plant in enumerate(plants, 1)]
    result = identify(pair, QUICK, profiles=0)
    zeros = result.fit.zeros
    assert zeros is not None
    assert zeros.names == (name,)
    assert zeros.values[:, 0] == pytest.approx([0.04, -0.04], abs=2e-3)
    assert result.explained.rms[0] == pytest.approx(1e-3, rel=0.1)
    assert result.model["gravity"] == pytest.approx(1.5, rel=5e-3)
    assert result.model[name] == pytest.approx(0.01, abs=2e-3)
    assert any("a zero of its own" in sentence for sentence in result.sentences())
    # The file names the data as they were read.
    alone = [identify([one], QUICK, profiles=0).to_dict()["data"][0] for one in pair]
    assert result.to_dict()["data"] == alone


def test_recordings_of_one_zero_keep_it_and_another_one_to_score_is_said_to_be_elsewhere():
    other = run(3, seconds=4.0, plant=TRUTH.with_values(angle_offset=0.05))
    result = identify([run(1, seconds=4.0), run(2, seconds=4.0)], QUICK, profiles=0, held_out=[other])
    assert result.fit.zeros is None
    offset, rms = result.moved_zeros["synthetic"]
    assert offset == pytest.approx(0.05, abs=2e-3)
    assert rms == pytest.approx(1e-3, rel=0.1)
    assert any("its zero lies +0.0" in sentence for sentence in result.sentences())


@pytest.mark.parametrize(("gravity", "excluding"), [(1.05, True), (1.5, False)])
def test_recordings_of_two_machines_in_one_fit_are_said_to_exclude_each_other(gravity, excluding):
    pair = [run(1, seconds=4.0), run(2, seconds=4.0, plant=TRUTH.with_values(gravity=gravity))]
    said = identify(pair, QUICK, profiles=0).sentences()
    assert any(one.startswith("The recordings exclude each other: fitted alone, natural") for one in said) == excluding


def test_a_file_without_a_torque_is_a_free_swing(tmp_path):
    swing = run(8, amplitude=0.0, start=(1.5, 0.0))
    path = tmp_path / "swing.csv"
    table = np.stack((swing.time, swing.position), axis=1)
    np.savetxt(path, table, delimiter=",", header="time,position", comments="")
    with pytest.raises(DataError, match=r"--mapping free_swing"):
        read_recording(path, "pendulum")
    assert {read_recording(path, mapping).input_kind for mapping in (None, "free_swing")} == {"none"}


@pytest.mark.parametrize(
    ("way", "unheeded"),
    [
        (["--plant", "acrobot"], ["--friction", "coulomb"]),
        (["--method", "thesis"], ["--fix-scale"]),
        (["--method", "thesis"], ["--held-out", "other.csv"]),
        (["--method", "thesis"], ["--window", "2"]),
        (["--method", "output_error"], ["--verbose"]),
        (["--method", "output_error"], ["--skew", "0.001"]),
    ],
)
def test_an_option_that_would_change_nothing_is_refused_by_its_name(way, unheeded, capsys):
    assert identify_cli.main(["recording.csv", *way, *unheeded]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"{unheeded[0]} has no effect with {way[0]}" in said
