"""Mechanisms of several joints are identified from recordings of all their joints, or refused in a sentence."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pendulum_bags.commands import identify_cli, replay_cli
from pendulum_bags.identification.between_recordings import Alone, half_width
from pendulum_bags.identification.identify import identify_joints
from pendulum_bags.identification.joint_fit import fit, prepare_windows, scores, window_length
from pendulum_bags.identification.joint_kernel import motion_kernel
from pendulum_bags.identification.joint_model import DELAY, LAG, JointModel, tellable
from pendulum_bags.identification.joint_readings import better_reading
from pendulum_bags.identification.joint_recordings import JointRecording, read_joints
from pendulum_bags.recordings.mapping import FORMAT
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant_file, write_plant
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.balanced_machine import run_balanced
from pendulum_testing.mechanism_recordings import NOISE, OFF, PERIOD, motion, truth


def save(path, recording, names, driven, order=None):
    columns = {"time": recording.time}
    for i, name in enumerate(names):
        columns[f"{name}.position"] = recording.position[:, (order or range(len(names)))[i]]
        if i in driven:
            columns[f"{name}.effort"] = recording.effort[:, (order or range(len(names)))[i]]
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")
    return path


def record(path, recording, plant, *, joints=None, push=0.0, called=None):
    """Write a recording as the bag of a plant: an applied effort with each state, or measured efforts alone."""
    names, driven = plant.coordinates.names, plant.coordinates.driven_names
    columns = [list(names).index(name) for name in driven]
    names, driven = (tuple((called or {}).get(name, name) for name in one) for one in (names, driven))
    with BagWriter(path) as bag:
        for topic in ("joint_states", "applied_effort", "push"):
            bag.add_topic(f"/plant/{topic}", "sensor_msgs/msg/JointState")
        for k, t in enumerate(recording.time):
            stamp = 10**18 + round(t * 1e9)
            q, u = recording.position[k], recording.effort[k]
            v = 0.0 * q if recording.velocity is None else recording.velocity[k]
            state = encode_joints(stamp, "plant", joints or names, tuple(q), tuple(v), tuple(0.0 * u))
            bag.write("/plant/joint_states", stamp, state)
            efforts = tuple(float(u[i]) for i in columns)
            bag.write("/plant/applied_effort", stamp, encode_joints(stamp, "plant", driven, effort=efforts))
        bag.write("/plant/push", 10**18, encode_joints(10**18, "hand", names[:1], effort=(push,)))
    return path


@pytest.fixture(scope="module")
def both_driven():
    plant = truth("double_pendulum")
    return [motion(plant, seed) for seed in (1, 2)]


@pytest.mark.parametrize("name", ["acrobot", "cart_pole"])
def test_a_mechanism_is_found_again_within_one_and_a_half_times_its_intervals(name):
    plant = truth(name)
    result = identify_joints(plant.with_values(OFF[name]), [motion(plant, 3)], extras="friction")
    assert not result.refused, result.refusal
    for key in tellable(plant):
        interval = result.intervals[key]
        width = 0.5 * (interval.high - interval.low)
        assert abs(interval.value - plant.value(key)) <= 1.5 * width + 0.005 * plant.value(key), key
        assert width < 0.25 * plant.value(key), key


def test_two_driven_joints_are_found_from_a_start_that_is_off_and_a_held_out_run_is_predicted_to_the_noise(both_driven):
    plant = truth("double_pendulum")
    start = plant.with_values(OFF["double_pendulum"])
    result = identify_joints(start, both_driven[:1], held_out=both_driven[1:], extras="friction")
    (score,) = result.held_out.values()
    assert score.rms.max() < 10.0 * NOISE
    assert result.plant().value("inertia_2") == pytest.approx(plant.value("inertia_2"), rel=0.03)
    assert "mass_2" in " ".join(result.sentences())


def test_the_simulated_motion_is_that_of_scipy_under_an_input_that_comes_late_and_lags(both_driven):
    plant = truth("double_pendulum").with_values({f"{j}.coulomb_friction": 0.0 for j in ("shoulder", "elbow")})
    names, delay, lag = ("shoulder.effort_offset", "elbow.angle_offset", DELAY, LAG), 0.0123, 0.03
    start = JointModel.of(plant)
    changed = start.with_changes(dict(zip(names, (0.05, 0.1, delay, lag), strict=True)))
    period, held = 0.01, np.random.default_rng(4).uniform(-1.0, 1.0, (60, 2))
    one = both_driven[0]
    recording = replace(
        one, time=period * np.arange(60), position=one.position[:60], effort=held, hold=("zero", "zero")
    )
    data = prepare_windows(recording, 0.4).subset([0])
    found = fit(changed, [data], (), np.ones(2), states=[data.states], most=0)
    path = found.errors[0][0, :, :2] + data.position[0]

    def rate(t, x):
        q, v, torque = x[:2], x[2:4], x[4:]
        # Before the recording the input was as at its start, and the lag had settled.
        command = held[max(int(np.floor((t - delay) / period + 1e-9)), 0)]
        a = plant.acceleration((q[0], q[1] - 0.1), tuple(v), (torque[0] + 0.05, torque[1]))
        return (*v, *a, *((command - torque) / lag))

    x, when = np.concatenate((np.zeros(4), held[0])), 0.0
    x[:4] = data.states[0]
    inside = data.time[0]
    for t in np.arange(0.0, inside[0] - 1e-9, 1e-4):
        # The lag alone runs before the window starts.
        x[4:] += 1e-4 * (held[max(int(np.floor((t + 5e-5 - delay) / period)), 0)] - x[4:]) / lag
    when = inside[0]
    for k in range(1, inside.size):
        edges = [when, *(e for e in delay + period * np.arange(60) if when + 1e-9 < e < inside[k] - 1e-9), inside[k]]
        for low, high in itertools.pairwise(edges):
            x = solve_ivp(rate, (low + 1e-12, high - 1e-12), x, rtol=1e-9, atol=1e-11).y[:, -1]
        when = inside[k]
        if data.inside[0, k]:
            np.testing.assert_allclose(path[k], x[:2], atol=5e-4)


def test_a_step_in_which_joints_rest_and_break_away_ends_where_fifty_short_ones_do():
    model, count, step = JointModel.of(load_mechanism("acrobot")), 20000, 5e-4
    rng = np.random.default_rng(0)
    bounds = np.array((0.03, 0.05, 0.0, 0.003))
    states = (np.pi, 0.0, 0.0, 0.0) + bounds * rng.uniform(-1.0, 1.0, (count, 4))
    effort, rise = rng.uniform(-0.5, 0.5, count), rng.uniform(-500.0, 500.0, count)

    def ends(pieces):
        drive, path = np.zeros((1, count, pieces, 4)), np.empty((1, count, pieces + 1, 4))
        drive[0, ..., 1] = effort[:, None] + rise[:, None] * step / pieces * np.arange(pieces)
        drive[0, ..., 3] = rise[:, None]
        run, steps = motion_kernel(model.plant.mechanism.name), np.full((count, pieces), step / pieces)
        run(*model.tables(model.vector[None]), drive, np.zeros(1, dtype=int), steps, states[None], path)
        return path[0, :, -1]

    apart = np.abs(ends(1) - ends(50))[:, 2:].max(axis=1)
    # A joint that broke away too late moved by up to 1.7e-3 rad/s less: the cost jumped, and so did its derivatives.
    assert apart.max() < 2e-4
    assert np.mean(apart > 1e-5) < 1e-3


@pytest.mark.parametrize(
    ("preset", "seconds", "window", "late"),
    [("furuta", 5.0, (0.1, 0.3), 45), ("cart_pole", 5.0, (0.2, 0.8), 0)],
)
def test_intervals_from_a_run_held_upright_hold_the_values_of_a_machine_that_is_off(preset, seconds, window, late):
    plant, run = load_mechanism(preset), run_balanced(preset, 3, seconds)
    # Efforts that are stamped too early by so many samples act that much later: far from the start's delay of 0.
    stop = len(run.position) - late
    time = 0.002 * np.arange(stop)
    recording = JointRecording(
        "hw", time, run.position[:stop], run.effort[late:], ("zero", "zero"), velocity=run.velocity[:stop]
    )
    result = identify_joints(plant, [recording])
    assert not result.refused, result.refusal
    assert window[0] <= result.window <= window[1]
    truth = {**run.truth, "delay": run.truth["delay"] + 0.002 * late}
    held = {n: i.low <= truth.get(n, 0.0) <= i.high for n, i in result.intervals.items()}
    # A delay and a lag of one motor have nearly the same effect: where one is missed, so is the other.
    assert len({n.replace("time_constant", "delay") for n, inside in held.items() if not inside}) <= 1, held
    for name in ("pendulum_inertia", "inertia_2", "pole_inertia"):
        if name in held:
            interval = result.intervals[name]
            assert interval.high - interval.low < 0.1 * run.truth[name]
    (actuator,) = result.plant().actuators
    assert actuator.transport_delay == pytest.approx(truth["delay"], abs=2e-4)
    assert actuator.time_constant == pytest.approx(run.truth["time_constant"], abs=2e-4)


def test_a_tare_that_no_common_offset_explains_is_found_as_one_of_a_recording():
    plant, run = load_mechanism("cart_pole"), run_balanced("cart_pole", 760, 5.0)
    half = len(run.position) // 2
    time = 0.002 * np.arange(half)
    halves = [
        JointRecording(name, time, run.position[at], run.effort[at] + tare, ("zero", "zero"), velocity=run.velocity[at])
        for name, at, tare in (("a", slice(0, half), 0.0), ("b", slice(half, 2 * half), np.array([0.5, 0.0])))
    ]
    result = identify_joints(plant, halves)
    assert not result.refused, result.refusal
    assert result.fit.own == ("cart.effort_offset",)
    np.testing.assert_allclose(np.diff(result.fit.offsets, axis=0), [[-0.5]], atol=1e-4)
    for name in ("cart_mass", "pole_inertia"):
        assert result.intervals[name].low <= run.truth[name] <= result.intervals[name].high


def test_a_wrong_sign_of_an_effort_that_comes_late_is_named():
    plant, run = load_mechanism("furuta"), run_balanced("furuta", 3, 5.0)
    time = 0.002 * np.arange(len(run.position))
    recording = JointRecording("hw", time, run.position, -run.effort, ("zero", "zero"), velocity=run.velocity)
    said = better_reading(JointModel.of(plant), [prepare_windows(recording, 0.144)])
    assert said is not None
    assert said.startswith("with the effort of arm negated")


def test_a_velocity_that_contradicts_the_positions_is_not_used(tmp_path):
    plant, one = truth("cart_pole"), motion(truth("cart_pole"), 3)
    rate = np.gradient(one.position, one.time, axis=0)
    for name, velocity, used in (("right", rate, True), ("zero", 0.0 * rate, False), ("negated", -rate, False)):
        read = read_joints(record(tmp_path / name, replace(one, velocity=velocity), plant), plant.coordinates)
        assert (read.velocity is not None) == used, name


def test_what_a_recording_cannot_be_is_refused_in_a_sentence(both_driven, tmp_path):
    plant = truth("double_pendulum")
    one = both_driven[0]
    still = replace(one, position=one.position * [1.0, 0.0])
    with pytest.raises(DataError, match="joint elbow moves by 0 rad"):
        identify_joints(plant, [still])
    with pytest.raises(DataError, match="1 joints; expected 2: shoulder, elbow"):
        identify_joints(plant, [replace(one, position=one.position[:, :1], effort=one.effort[:, :1])])
    short = replace(one, time=one.time[:200], position=one.position[:200], effort=one.effort[:200])
    with pytest.raises(DataError, match="expected at least 5"):
        identify_joints(plant, [short])
    with pytest.raises(DataError, match="the same samples"):
        identify_joints(plant, [one, one])


def test_swapped_columns_are_refused_by_name(both_driven):
    one = both_driven[0]
    swapped = replace(one, position=one.position[:, ::-1], effort=one.effort[:, ::-1])
    result = identify_joints(truth("double_pendulum"), [swapped], extras="friction")
    assert result.refused
    assert "columns of shoulder and elbow exchanged" in result.sentences()[0]


@pytest.mark.parametrize(
    ("name", "position", "effort", "words"),
    [
        ("double_pendulum", [[1, 0], [0, 1]], (-1, -1), "with every effort negated"),
        ("double_pendulum", [[1, 0], [0, 1]], (1, -1), "with the effort of elbow negated"),
        ("acrobot", [[1, 0], [1, 1]], (1, 1), "with the angle of elbow less that of shoulder"),
        ("cart_pole", [[1, 0], [0, 1]], (-1, 1), "with the effort of cart negated"),
    ],
)
def test_a_wrong_sign_and_an_angle_against_the_world_are_named(name, position, effort, words):
    plant, one = truth(name), motion(truth(name), 3, 3.0)
    wrong = replace(one, position=one.position @ np.array(position, dtype=float).T, effort=one.effort * effort)
    said = better_reading(JointModel.of(plant), [prepare_windows(wrong, 0.5)])
    assert said is not None
    assert said.startswith(words)


@pytest.mark.parametrize("factor", [15.0, 1.0 / 15.0])
def test_a_value_ten_times_off_the_start_is_refused_whichever_is_larger(factor):
    plant = truth("furuta")
    far = plant.with_values({"arm_inertia": plant.value("arm_inertia") * factor})
    result = identify_joints(far, [motion(plant, 3)], extras="friction")
    assert "arm_inertia is" in result.sentences()[0]
    assert "expected a plant that is near, or a start that is" in result.sentences()[0]


@pytest.mark.parametrize(
    ("turn", "scale", "words"), [(57.3, 1.0, "and elbow in degrees"), (1.0, 1e3, "every effort in mN m")]
)
def test_degrees_and_milli_newton_metres_are_refused_by_their_unit(both_driven, turn, scale, words):
    one = both_driven[0]
    wrong = replace(one, position=turn * one.position, effort=scale * one.effort)
    try:
        said = identify_joints(truth("double_pendulum"), [wrong], extras="friction").refusal or "accepted"
    except DataError as error:
        said = str(error)
    assert words in said


def test_a_held_out_run_that_straight_lines_predict_as_well_is_a_refusal_with_its_own_exit_code(
    both_driven, tmp_path, capsys
):
    names = ("shoulder", "elbow")
    good = save(tmp_path / "good.csv", both_driven[0], names, (0, 1))
    foreign = replace(both_driven[1], position=-0.5 * both_driven[1].position[::-1])
    bad = save(tmp_path / "foreign.csv", foreign, names, (0, 1))
    out = tmp_path / "plant.yaml"
    command = [str(good), "--plant", "double_pendulum", "--out", str(out)]
    assert identify_cli.main([*command, "--held-out", str(bad)]) == 3
    assert "REFUSED: foreign.csv, held out" in capsys.readouterr().out
    assert not out.exists()
    assert identify_cli.main([*command, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert "Free run over windows" in (out.with_suffix("") / "index.html").read_text(encoding="utf-8")
    plant, provenance = load_plant_file(out)
    assert plant.value("inertia_2") == pytest.approx(said["parameters"]["inertia_2"])
    assert set(tellable(plant)) <= set(provenance["intervals"])
    assert plant.coordinates.driven_names == names


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda joints: {"shoulder": joints["shoulder"], "wrist": joints["elbow"]}, "joints are shoulder, wrist; exp"),
        (lambda joints: {**joints, "wrist": {"position": {"column": "u", "unit": "rad"}}}, "expected shoulder, elbow"),
        (lambda joints: {**joints, "elbow": joints["shoulder"]}, "the same column 'a'"),
        (lambda joints: {**joints, "elbow": {"position": joints["elbow"]["position"]}}, "has no effort, but the plant"),
    ],
)
def test_joints_of_a_mapping_that_are_swapped_foreign_repeated_or_without_their_effort_are_refused(
    change, words, tmp_path
):
    joints = {
        "shoulder": {"position": {"column": "a", "unit": "rad"}, "effort": {"column": "u", "unit": "N m"}},
        "elbow": {"position": {"column": "b", "unit": "rad"}, "effort": {"column": "w", "unit": "N m"}},
    }
    data = tmp_path / "run.csv"
    table = np.column_stack((np.arange(50) * 0.01, np.random.default_rng(0).normal(0.0, 0.1, (50, 4))))
    np.savetxt(data, table, delimiter=",", header="time,a,b,u,w", comments="")
    rules = {"format": FORMAT, "time": {"column": "time", "unit": "s"}, "joints": change(joints)}
    mapping = tmp_path / "columns.yaml"
    mapping.write_text(json.dumps(rules))
    with pytest.raises(DataError, match=words):
        read_joints(data, truth("double_pendulum").coordinates, mapping)


def test_rows_with_nan_are_left_out_and_counted(both_driven, tmp_path):
    one = both_driven[0]
    position = one.position.copy()
    position[[50, 51, 300], 1] = np.nan
    table = np.column_stack((one.time, position[:, 0], one.effort[:, 0], position[:, 1], one.effort[:, 1]))
    path = tmp_path / "gaps.csv"
    header = "time,shoulder.position,shoulder.effort,elbow.position,elbow.effort"
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    read = read_joints(path, truth("double_pendulum").coordinates)
    assert (read.left_out, read.time.size) == (3, one.time.size - 3)
    assert np.isfinite(read.position).all()
    assert scores(JointModel.of(truth("double_pendulum")), [prepare_windows(read, 1.0)])[0].rms.max() < 20.0 * NOISE


def sparse(recording: JointRecording) -> JointRecording:
    """Return every fifth row."""
    rows = {name: getattr(recording, name)[::5] for name in ("time", "position", "effort")}
    return replace(recording, **rows, velocity=None)


def test_a_real_double_pendulum_is_predicted_far_better_than_by_its_published_parameters(shared_data, tmp_path):
    folder = shared_data / "dfki_double_pendulum"
    start = load_mechanism("double_pendulum")
    joint = {
        name: {
            "position": {"column": f"pos_meas{i}", "unit": "rad"},
            "effort": {"column": f"tau_meas{i}", "unit": "N m", "hold": "linear"},
        }
        for i, name in ((1, "shoulder"), (2, "elbow"))
    }
    mapping = tmp_path / "columns.yaml"
    mapping.write_text(json.dumps({"format": FORMAT, "time": {"column": "time", "unit": "s"}, "joints": joint}))
    one, other = (read_joints(folder / f"c1_{key}.csv", start.coordinates, mapping) for key in ("143339", "143524"))
    third = read_joints(folder / "c1_143704.csv", start.coordinates, mapping)
    data = [prepare_windows(sparse(recording), 2.0) for recording in (one, third)]
    model = JointModel.of(start)
    found = fit(model, data, model.fitted(), np.ones(2), most=10, tolerance=1e-3)
    held_out = [prepare_windows(sparse(other), 0.5)]
    ours, published = (float(np.sqrt(np.mean(scores(m, held_out)[0].rms ** 2))) for m in (found.model, model))
    assert published > 0.03
    assert ours < 0.7 * published


def test_a_hole_in_one_joints_column_leaves_its_row_out_for_all_joints(tmp_path):
    coordinates = truth("double_pendulum").coordinates
    rows = np.arange(40.0)
    columns = {"time": 0.01 * rows}
    for index, name in enumerate(coordinates.names):
        angle = 0.5 * np.sin(0.2 * rows + index)
        angle[[5, 9][index]] = np.nan
        columns |= {f"{name}.position": angle}
        if index in coordinates.driven:
            columns |= {f"{name}.effort": rows}
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack([*columns.values()]), delimiter=",", header=",".join(columns), comments="")
    read = read_joints(path, coordinates)
    kept = np.delete(np.arange(40), [5, 9])
    np.testing.assert_allclose(read.time, 0.01 * kept)
    for index in range(len(coordinates.names)):
        np.testing.assert_allclose(read.position[:, index], 0.5 * np.sin(0.2 * kept + index))


def test_a_bag_of_a_plant_is_identified_by_the_efforts_that_it_says_it_applied(tmp_path):
    from pendulum_sim.stepping.mechanism_plant import MechanismPlant

    plant = truth("cart_pole")
    model, rng = MechanismPlant(plant, PERIOD), np.random.default_rng(5)
    rows, state = [], model.reset((0.0, 0.4))
    for k in range(900):
        # By cosines the cart stays near its middle, away from its end stops.
        effort = 2.0 * np.cos(2.9 * k * PERIOD) + 3.0 * np.cos(6.1 * k * PERIOD)
        rows.append((*state.position, effort))
        state = model.step((effort,))
    table = np.array(rows)
    told = JointRecording(
        "run",
        PERIOD * np.arange(900),
        table[:, :2] + rng.normal(0.0, NOISE, (900, 2)),
        np.column_stack((table[:, 2], np.zeros(900))),
        ("zero", "zero"),
    )
    bag = record(tmp_path / "run", told, plant)
    read = read_joints(bag, plant.coordinates)
    assert read.hold[0] == "zero"
    np.testing.assert_allclose(read.effort, told.effort)
    np.testing.assert_allclose(read.time, told.time, atol=1e-9)
    start = tmp_path / "start.yaml"
    write_plant(start, plant.with_values(OFF["cart_pole"]), provenance={})
    out = tmp_path / "found.yaml"
    assert identify_cli.main([str(bag), "--plant", str(start), "--out", str(out)]) == 0
    found, _ = load_plant_file(out)
    for key in ("cart_mass", "pole_inertia"):
        assert found.value(key) == pytest.approx(plant.value(key), rel=0.03), key


def test_bags_that_are_not_of_this_plant_or_were_pushed_are_refused(both_driven, tmp_path, capsys):
    plant = truth("double_pendulum")
    short = replace(
        both_driven[0],
        time=both_driven[0].time[:50],
        position=both_driven[0].position[:50],
        effort=both_driven[0].effort[:50],
    )
    swapped = record(tmp_path / "swapped", short, plant, joints=("elbow", "shoulder"))
    np.testing.assert_array_equal(read_joints(swapped, plant.coordinates).position, short.position[:, ::-1])
    np.testing.assert_array_equal(read_joints(swapped, plant.coordinates).effort, short.effort)
    three = record(tmp_path / "three", short, plant, called={"shoulder": "a", "elbow": "b"})
    with pytest.raises(
        DataError, match=r"is of the joints a, b; expected shoulder, elbow, and neither names nor efforts"
    ):
        read_joints(three, plant.coordinates)
    pushed = record(tmp_path / "pushed", short, plant, push=0.2)
    with pytest.raises(DataError, match=r"topic /plant/push of bag .* pushes links from outside"):
        read_joints(pushed, plant.coordinates)
    both = record(tmp_path / "run", short, plant)
    assert read_joints(both, truth("acrobot").coordinates).passive_effort == ("shoulder",)
    with pytest.raises(DataError, match=r"one: joints\.shoulder has no effort, but the plant has an actuator"):
        read_joints(record(tmp_path / "one", short, truth("acrobot")), plant.coordinates)
    with pytest.raises(DataError, match="nowhere does not exist"):
        read_joints(tmp_path / "nowhere", plant.coordinates)


@pytest.mark.parametrize(
    ("name", "called", "how"),
    [
        ("double_pendulum", {"shoulder": "arm_2_shoulder_joint", "elbow": "arm_1_Elbow_joint"}, "by their name"),
        ("acrobot", {"shoulder": "a", "elbow": "b"}, "by which joints are driven"),
    ],
)
def test_a_bag_with_other_names_of_joints_is_read_where_names_or_efforts_show_which_is_which(
    tmp_path, name, called, how
):
    plant = truth(name)
    t = 0.01 * np.arange(300.0)
    position = np.stack([np.sin(3.0 * t), 0.3 * np.cos(7.0 * t)], axis=1)
    effort = np.stack([np.cos(2.0 * t), np.sin(5.0 * t)], axis=1)
    run = JointRecording("run", t, position, effort, ("zero", "zero"))
    own, other = (record(tmp_path / key, run, plant, called=names) for key, names in (("own", None), ("o", called)))
    found, expected = (read_joints(bag, plant.coordinates) for bag in (other, own))
    np.testing.assert_array_equal(found.position, expected.position)
    np.testing.assert_array_equal(found.effort, expected.effort)
    theirs = ", ".join(called[joint] for joint in plant.coordinates.names)
    assert (found.renamed, expected.renamed) == (f"joints {theirs} are taken for shoulder, elbow, {how}", "")


def test_the_next_step_of_several_joints_is_the_experiment_that_recorded_them(both_driven):
    command = "python -m pendulum_bags experiment joints --plant acrobot --seed 3"
    told = {"pendulum.run": {"command": command, "seed": 3}}
    start = truth("double_pendulum")
    result = identify_joints(start, [replace(both_driven[0], meta=told)], extras="friction")
    assert result.next_step("my.yaml")[1] == ("python -m pendulum_bags experiment joints --plant my.yaml --seed 4")


def test_the_starts_of_windows_are_fitted_in_metres_and_radians_by_what_each_joint_does():
    plant, one = truth("cart_pole"), motion(truth("cart_pole"), 3)
    noise = np.random.default_rng(0).normal(0.0, 1.0, one.position.shape) * [NOISE, 0.05]
    data = [prepare_windows(replace(one, position=one.position + noise), 0.3)]
    # Weighed alike, the noise of the pole in radians bends the cart by half a millimetre.
    assert scores(JointModel.of(plant), data)[0].rms[0] < 1.6 * NOISE


def test_a_held_out_run_in_which_a_joint_hardly_moves_refuses_no_good_fit(both_driven):
    plant, one = truth("double_pendulum"), both_driven[0]
    rng = np.random.default_rng(4)
    # At rest but for a last twitch: straight lines predict the noise as well as any model.
    still = replace(
        both_driven[1],
        position=rng.normal(0.0, NOISE, one.position.shape) + np.linspace(0.0, 2e-3, one.time.size)[:, None],
        effort=np.zeros_like(one.effort),
    )
    result = identify_joints(plant, [one], held_out=[still], extras="friction")
    assert not result.refused, result.refusal


def test_windows_in_which_something_else_pushes_are_left_out_and_named(both_driven):
    plant, one = truth("double_pendulum"), both_driven[0]
    position = one.position.copy()
    pushed = (one.time > 2.5) & (one.time < 3.5)
    position[pushed] += (0.8 * np.sin(np.pi * (one.time[pushed] - 2.5)) ** 2)[:, None]
    result = identify_joints(plant, [replace(one, position=position)], extras="friction", window=0.5)
    assert not result.refused, result.refusal
    assert any(note.startswith("Left out, since something that was not recorded") for note in result.notes)
    assert result.model["inertia_2"] == pytest.approx(plant.value("inertia_2"), rel=0.05)


def test_the_windows_of_motion_about_an_unstable_equilibrium_are_short():
    plant = truth("cart_pole")
    one = motion(plant, 3)
    rng = np.random.default_rng(2)
    near = np.column_stack((0.05 * np.sin(one.time), np.pi + 0.02 * np.sin(3.0 * one.time)))
    balanced = replace(one, position=near + rng.normal(0.0, NOISE, near.shape))
    model = JointModel.of(plant)
    length = window_length(model, [balanced], 5.0)
    # The pole falls at sqrt(m g c / J) = 3.8 1/s and the cart makes it faster: a factor of 30 within a second or so.
    assert 0.4 < length < 1.5
    assert window_length(model, [one], 5.0) > 2.0 * length


def test_sizes_that_the_motion_does_not_determine_are_held_and_said_so():
    plant = truth("cart_pole")
    one = motion(plant, 3)
    rng = np.random.default_rng(1)
    # The pole hardly swings: its inertia and centre are anything.
    quiet = replace(one, position=np.column_stack((one.position[:, 0], 2e-3 * rng.standard_normal(one.time.size))))
    result = identify_joints(plant, [quiet], extras="friction", window=0.5)
    written = not result.refused and result.plant()
    if written:
        assert "do not determine" in " ".join(result.sentences())
        assert written.value("pole_inertia") == plant.value("pole_inertia")
    for interval in result.intervals.values():
        assert interval.low < interval.high


def test_recordings_of_a_mechanism_have_offsets_of_their_own_and_those_of_two_machines_exclude_each_other():
    plant, tare = truth("double_pendulum"), np.array((0.15, -0.06))
    one, other, third = (motion(plant, seed, 4.0) for seed in (1, 2, 3))
    tared, third = replace(other, effort=other.effort + tare), replace(third, effort=third.effort - tare)
    result = identify_joints(plant, [one, tared], held_out=[third], extras="friction")
    assert result.fit.own == ("shoulder.effort_offset", "elbow.effort_offset")
    assert result.fit.offsets[1] - result.fit.offsets[0] == pytest.approx(-tare, abs=0.01)
    assert any("a zero of its own" in note for note in result.notes)
    assert all(
        plant.value(n) == pytest.approx(result.model[n], rel=0.03) for n in ("inertia_1", "inertia_2", "centre_2")
    )
    (score,) = result.held_out.values()
    assert score.rms.max() < 10.0 * NOISE
    assert not identify_joints(plant, [one, other], extras="friction").fit.own
    heavier = motion(plant.with_values({"inertia_2": 1.4 * plant.value("inertia_2")}), 2, 4.0)
    two = identify_joints(plant, [one, heavier], extras="friction")
    assert any("exclude each other: fitted alone, inertia_2 is" in said for said in two.sentences())


def test_the_interval_of_a_common_fit_holds_what_differs_from_recording_to_recording():
    rng = np.random.default_rng(1)
    held = {0.0: 0, 2.0: 0}
    for spread in held:
        for _ in range(300):
            errors = rng.uniform(0.5, 2.0, 3)
            values = rng.normal(0.0, np.hypot(spread, errors))
            weights = errors**-2.0
            alone = [Alone(f"{i}", {"x": v}, {"x": e}) for i, (v, e) in enumerate(zip(values, errors, strict=True))]
            half, _ = half_width("x", alone, float(weights.sum() ** -0.5), 1e6)
            held[spread] += abs(float(weights @ values / weights.sum())) < half
    # Without it 62 % would, of the second.
    assert held[0.0] > 0.95 * 300
    assert 0.88 * 300 < held[2.0] < 0.98 * 300


def test_a_torque_recorded_at_a_passive_joint_acts_and_is_said_so(tmp_path):
    both, plant = truth("double_pendulum"), truth("acrobot")
    path = save(tmp_path / "run.csv", motion(both, 1), ("shoulder", "elbow"), (0, 1))
    read = read_joints(path, plant.coordinates)
    assert read.passive_effort == ("shoulder",)
    result = identify_joints(plant, [read], extras="friction")
    assert not result.refused, result.refusal
    assert any("no actuator at shoulder" in note for note in result.notes)


def test_a_csv_of_several_joints_is_replayed_and_the_plant_of_another_machine_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plant = truth("double_pendulum")
    path = save(tmp_path / "run.csv", motion(plant, 1), ("shoulder", "elbow"), (0, 1))
    assert replay_cli.main([str(path), "--params", "double_pendulum", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert max(joint["rms"] for joint in found["joints"].values()) < 20.0 * NOISE
    assert [file.name for file in tmp_path.iterdir()] == ["run.csv"]
    # A part gives what a file of that part alone gives.
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    time = np.loadtxt(path, delimiter=",", skiprows=1)[:, 0]
    inside = (time - time[0] >= 2.0) & (time - time[0] <= 6.0)
    kept = [line for line, wanted in zip(lines[1:], inside, strict=True) if wanted]
    (tmp_path / "part.csv").write_text("".join([lines[0], *kept]), encoding="utf-8")
    parts = []
    for words in (["run.csv", "--start", "2", "--stop", "6"], ["part.csv"]):
        assert replay_cli.main([*words, "--params", "double_pendulum", "--json"]) == 0
        parts.append(json.loads(capsys.readouterr().out)["joints"])
    assert parts[0] == parts[1] != found["joints"]
    other = tmp_path / "other.yaml"
    write_plant(other, plant.with_values({"inertia_2": 0.4, "inertia_1": 0.3}))
    assert replay_cli.main([str(path), "--params", str(other), "--out", str(tmp_path / "out")]) == 3
    assert "does not describe run.csv" in capsys.readouterr().out
    assert (tmp_path / "out" / "replay.png").exists()


def test_chaotic_motion_is_fitted_in_windows_over_which_neighbours_stay_together():
    free = {f"{joint}.{key}": 0.0 for joint in ("shoulder", "elbow") for key in ("coulomb_friction", "damping")}
    plant = truth("double_pendulum").with_values(free)
    chaotic = motion(plant, 5, seconds=20.0, swing=2.5)
    length = window_length(JointModel.of(plant), [chaotic], 5.0)
    assert length < 3.0
    result = identify_joints(plant.with_values(OFF["double_pendulum"]), [chaotic], extras="friction")
    assert not result.refused, result.refusal
    assert result.window < 3.0
    assert result.model["inertia_2"] == pytest.approx(plant.value("inertia_2"), rel=0.03)
