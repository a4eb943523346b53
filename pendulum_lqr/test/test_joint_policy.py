"""A learned policy of several joints: its file, its answers, which plant it is for, and where it gives up."""

import io
import json
import math
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.policies.onnx_file import observation_names
from pendulum_lqr.policies.policy_file import dumps_policy, load_policy, loads_policy, write_policy
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_testing.joint_plants import delayed_plant
from pendulum_testing.policies import random_policy

CART_POLE = load_mechanism("cart_pole")
DOUBLE = load_mechanism("double_pendulum")
RANGES = {"cart_mass": (0.75, 1.25), "pole.damping": (1e-6, 3e-6)}
GOOD = dumps_policy(random_policy(CART_POLE, hidden=(4,), ranges=RANGES))
STILL = ((0.0, math.pi), (0.0, 0.0))


def controller(tmp_path, policy, plant=CART_POLE, period=0.01, **values):
    """Return the controller of a policy, with all of its effort from the start unless told otherwise."""
    path = write_policy(tmp_path / "policy.npz", policy)
    given = {"policy": str(path), "start_time": 0.0, **values}
    return make_controller("policy", plant, period or 0.01, given, checked=period is not None)


def with_header(content, **changes):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    header = json.loads(np.load(io.BytesIO(parts["header.npy"])).tobytes())
    header.update({key: change(header[key]) if callable(change) else change for key, change in changes.items()})
    array = io.BytesIO()
    np.save(array, np.frombuffer(json.dumps(header).encode(), dtype=np.uint8))
    parts["header.npy"] = array.getvalue()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.parametrize("plant", [CART_POLE, DOUBLE, load_mechanism("furuta")], ids=lambda plant: plant.name)
def test_a_policy_of_several_joints_comes_back_from_its_file_to_the_last_bit(tmp_path, plant):
    policy = random_policy(plant)
    back = load_policy(write_policy(tmp_path / "a.npz", policy))
    assert (back.plant, back.joints) == (plant, plant.coordinates.names)
    assert dumps_policy(back) == dumps_policy(policy)


def test_a_sample_holds_each_signal_of_the_joints_that_have_it_signal_by_signal(tmp_path):
    policy = random_policy(CART_POLE, history=2, seed=3, velocity_scale=(2.0, 5.0))
    names = ["pole: cos", "pole: sin", "cart: position", "cart: velocity", "pole: velocity", "cart: effort"]
    assert observation_names(policy) == [f"{name}, sample {age}" for age in (-1, 0) for name in names]
    learned = controller(tmp_path, policy)
    rows, efforts = [], [0.0]
    for k, (x, angle, v, rate) in enumerate([(0.1, 3.0, -0.4, 2.0), (0.2, -0.3, 0.6, -7.0)]):
        rows.append([-math.cos(angle), -math.sin(angle), x / 0.5, v / 2.0, rate / 5.0, efforts[-1] / 10.0])
        efforts += learned.efforts(0.01 * k, (x, angle), (v, rate))
    whole = np.array([[*rows[0], *rows[0]], [*rows[0], *rows[1]]], dtype=np.float32)
    assert efforts[1:] == pytest.approx(10.0 * policy.network.forward(whole)[:, 0], abs=1e-4)


def test_each_driven_joint_gets_its_own_answer_within_its_own_limit_and_rate(tmp_path):
    policy = random_policy(DOUBLE, seed=1, effort_limit=(6.0, 2.0), effort_rate=(100.0, 10.0))
    learned = controller(tmp_path, policy, DOUBLE)
    rng = np.random.default_rng(0)
    states = rng.uniform(-3.0, 3.0, (300, 2, 2))
    efforts = np.array([learned.efforts(0.01 * k, tuple(q), tuple(v)) for k, (q, v) in enumerate(states)])
    assert np.all(np.abs(efforts) <= [6.0, 2.0])
    steps = np.abs(np.diff(efforts, axis=0, prepend=0.0)).max(axis=0)
    assert steps == pytest.approx([1.0, 0.1])
    small = controller(tmp_path, policy, DOUBLE, effort_limit=0.05)
    assert np.abs([small.efforts(0.01 * k, tuple(q), tuple(v)) for k, (q, v) in enumerate(states)]).max() == 0.05


@pytest.mark.parametrize(
    ("position", "velocity", "told"),
    [
        ((0.51, 0.0), (0.0, 0.0), "position of cart 0.51 m, velocity 0 m/s is outside of what it was trained for"),
        ((-0.51, 0.0), (0.0, 0.0), "position of cart -0.51 m"),
        ((0.0, 0.0), (0.0, 20.1), r"angle of pole -3.14 rad, velocity 20.1 rad/s"),
        ((0.0, 0.0), (math.nan, 0.0), "velocity nan m/s"),
        ((math.inf, 0.0), (0.0, 0.0), "position of cart inf m"),
    ],
)
def test_outside_of_the_box_of_any_joint_it_gives_up_for_good_and_names_it(tmp_path, position, velocity, told):
    learned = controller(tmp_path, random_policy(CART_POLE, seed=4))
    assert learned.efforts(0.0, *STILL) != (0.0,)
    assert learned.efforts(0.01, position, velocity) == (0.0,)
    assert learned.efforts(0.02, *STILL) == (0.0,)
    assert told in learned.notice
    assert learned.notice in learned.describe()
    learned.reset()
    assert learned.efforts(0.0, *STILL) != (0.0,)


def test_a_fallback_or_a_catch_that_does_not_settle_is_refused_as_soon_as_the_period_is_known(tmp_path):
    late = delayed_plant("cart_pole", 0.3)
    refusal = r"lqr asked every 0\.01 s does not settle on plant 'cart_pole'"
    learned = controller(tmp_path, random_policy(late), late, period=None, fallback="lqr")
    with pytest.raises(ParameterError, match=refusal):
        learned.check(0.01)
    with pytest.raises(ParameterError, match=refusal):
        controller(tmp_path, random_policy(late), late, fallback="lqr")
    with pytest.raises(ParameterError, match=refusal.replace("lqr", "policy")):
        controller(tmp_path, random_policy(late), late, catch="lqr")


def test_a_chosen_fallback_answers_after_it_gave_up_and_begins_softly(tmp_path):
    learned = controller(tmp_path, random_policy(CART_POLE, velocity_box=(1.0, 1.0)), fallback="lqr", start_time=0.2)
    lqr = make_controller("lqr", CART_POLE, 0.01)
    state = ((0.1, math.pi + 0.1), (2.0, 0.0))
    efforts = [learned.efforts(0.01 * k, *state)[0] for k in range(30)]
    assert efforts[0] == 0.0
    assert abs(efforts[1]) == pytest.approx(0.5)
    assert efforts[-1] == lqr.efforts(0.0, *state)[0] != 0.0


def test_a_catch_takes_over_near_upright_and_the_policy_goes_on_from_its_efforts(tmp_path):
    policy = random_policy(CART_POLE, effort_rate=(20.0,), seed=5)
    bare, caught = controller(tmp_path, policy), controller(tmp_path, policy, catch="lqr")
    lqr = make_controller("lqr", CART_POLE, 0.01)
    near, far = ((0.02, math.pi + 0.05), (0.1, 0.0)), ((0.1, 1.0), (0.1, 1.0))
    assert "LQR within x'Sx <=" in caught.describe()
    assert "LQR within" not in bare.describe()
    for k in range(3):
        assert caught.efforts(0.01 * k, *far) == bare.efforts(0.01 * k, *far)
    effort = caught.efforts(0.03, *near)[0]
    assert effort == pytest.approx(lqr.efforts(0.03, *near)[0])
    assert abs(effort - bare.efforts(0.03, *near)[0]) > 1.0
    # Its rate is limited from what acted, 0.2 N in a period.
    assert caught.efforts(0.04, *far)[0] == pytest.approx(effort, abs=0.2 + 1e-9)
    # Who gave up is not caught: its fallback answers.
    caught.efforts(0.05, *near)
    assert caught.catch.active
    caught.efforts(0.06, (0.9, 0.0), (0.0, 0.0))
    assert caught.efforts(0.07, *near) == (0.0,)
    caught.reset()
    assert not caught.catch.active
    # A state between the region's edge and twice that is held on by who holds already, after new parameters too.
    level, S = caught.catch.region.level, caught.catch.gain.S
    away = math.sqrt(1.5 * level / S[1, 1])
    between = ((0.0, math.pi + away), (0.0, 0.0))
    caught.efforts(0.0, *near)
    caught.efforts(0.01, *between)
    assert caught.catch.active
    changed = controller(tmp_path, policy, catch="lqr", start_time=0.3)
    changed.carry_over(caught)
    changed.efforts(0.02, *between)
    assert changed.catch.active
    caught.reset()
    assert not caught.catch.active
    caught.efforts(0.0, *between)
    assert not caught.catch.active
    soft = controller(tmp_path, policy, catch="lqr", start_time=0.2)
    assert soft.efforts(0.0, *near) == (0.0,)
    assert abs(soft.efforts(0.01, *near)[0]) == pytest.approx(0.5)


def test_with_less_effort_a_catch_holds_fewer_states(tmp_path):
    policy = random_policy(CART_POLE, seed=5)
    whole = controller(tmp_path, policy, catch="lqr")
    weak = controller(tmp_path, policy, catch="lqr", effort_limit=1.0)
    # Deviations that a limited effort brings back grow with it, so the level, a square, falls by far more.
    assert weak.catch.region.level < 0.1 * whole.catch.region.level
    state = ((0.0, math.pi + 0.3 * math.sqrt(whole.catch.region.level / whole.catch.gain.S[1, 1])), (0.0, 0.0))
    whole.efforts(0.0, *state)
    weak.efforts(0.0, *state)
    assert whole.catch.active
    assert not weak.catch.active
    near = ((0.0, math.pi + 0.01), (0.0, 0.0))
    assert abs(weak.efforts(0.01, *near)[0]) <= 1.0


def test_torque_begins_at_zero_and_states_at_another_rate_make_it_give_up(tmp_path):
    learned = controller(tmp_path, random_policy(CART_POLE, seed=4), start_time=0.2)
    efforts = [abs(learned.efforts(0.01 * k, *STILL)[0]) for k in range(15)]
    assert efforts[0] == 0.0
    assert all(effort <= 10.0 * 0.01 * k / 0.2 + 1e-12 for k, effort in enumerate(efforts))
    for k in range(40):
        learned.efforts(1.0 + 0.02 * k, *STILL)
    assert "states come every 0.02 s; the policy expects 0.01 s" in learned.notice


def test_faster_states_get_each_answer_as_often_and_other_periods_are_refused(tmp_path):
    policy = random_policy(CART_POLE, seed=2)
    fast = controller(tmp_path, policy, period=0.002)
    efforts = [fast.efforts(0.002 * k, (0.01 * k, 3.0), (0.1, 0.1 * k)) for k in range(20)]
    assert all(len(set(efforts[k : k + 5])) == 1 for k in range(0, 20, 5))
    assert len(set(efforts)) == 4
    with pytest.raises(ParameterError, match=r"period of 0\.01 s and states come every 0\.004 s"):
        controller(tmp_path, policy, period=0.004)
    with pytest.raises(ParameterError, match=r"period of 0\.01 s and states come every 0\.004 s"):
        fast.check(0.004)


def test_a_change_while_it_runs_does_not_forget_the_past(tmp_path):
    policy = random_policy(CART_POLE, effort_rate=(20.0,), seed=5)
    first, second = (controller(tmp_path, policy) for _ in range(2))
    for k in range(5):
        first.efforts(0.01 * k, (0.01 * k, 3.0), (0.1, 1.0))
    second.carry_over(first)
    assert second.efforts(0.05, *STILL) == first.efforts(0.05, *STILL)
    first.efforts(0.06, (0.9, 0.0), (0.0, 0.0))
    second.carry_over(first)
    assert second.efforts(0.07, *STILL) == (0.0,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cart_mass": 1.3}, r"cart_mass is 1\.3 kg, trained 0\.75 to 1\.25; expected a plant within"),
        ({"pole_mass": 0.12}, r"pole_mass is 0\.12 kg, trained 0\.1"),
        ({"pole.coulomb_friction": 0.1}, r"pole\.coulomb_friction is 0\.1 N m, trained 0"),
        ({"cart.effort_limit": 5.0}, r"cart\.effort_limit is 5 N, trained 10"),
        ({"cart.upper_stop": 0.45}, r"cart\.upper_stop is 0\.45 m, trained to move 0\.5 m"),
        ({"cart.lower_stop": -0.45}, r"cart\.lower_stop is -0\.45 m, trained to move 0\.5 m"),
        ({"cart.lower_stop": 0.6}, r"cart\.lower_stop is 0\.6 m, trained to move 0\.5 m"),
    ],
)
def test_another_plant_is_refused_by_parameter_value_and_range(tmp_path, changes, message):
    with pytest.raises(ParameterError, match=message):
        controller(tmp_path, random_policy(CART_POLE, ranges=RANGES), CART_POLE.with_values(changes))


@pytest.mark.parametrize(
    "changes", [{"cart_mass": 1.24}, {"cart.effort_limit": 20.0}, {"cart.upper_stop": 0.5, "cart.lower_stop": -9.0}]
)
def test_a_plant_within_what_was_trained_is_taken(tmp_path, changes):
    controller(tmp_path, random_policy(CART_POLE, ranges=RANGES), CART_POLE.with_values(changes))


def test_a_plant_of_other_joints_or_other_motors_is_refused(tmp_path):
    with pytest.raises(ParameterError, match="trained on a cart_pole driven at cart, and this one is a furuta"):
        controller(tmp_path, random_policy(CART_POLE), load_mechanism("furuta"))
    acrobot = load_mechanism("acrobot")
    with pytest.raises(
        ParameterError, match="double_pendulum driven at elbow, and this one is a double_pendulum driven at"
    ):
        controller(tmp_path, random_policy(acrobot), load_mechanism("pendubot"))
    path = str(write_policy(tmp_path / "cart.npz", random_policy(CART_POLE)))
    with pytest.raises(ParameterError, match="is for joints cart, pole; expected one joint"):
        make_controller("policy", load_plant("dfki"), 0.01, {"policy": path})
    one = random_policy(load_plant("dfki"))
    with pytest.raises(ParameterError, match="trained on a plant of one joint, and this one is a cart_pole"):
        controller(tmp_path, one)
    with pytest.raises(ParameterError, match="policy is empty; expected the path of a policy file"):
        make_controller("policy", CART_POLE, 0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": ["pole", "cart"]}, r"joints are \['pole', 'cart'\]; expected cart, pole, as plant 'cart_pole'"),
        ({"joints": ["cart"]}, r"joints are \['cart'\]; expected cart, pole"),
        ({"model": "rigid_pendulum"}, "model is 'rigid_pendulum'; its plant is 'mechanism'"),
        ({"model": ["mechanism"]}, r"model is \['mechanism'\]; expected 'rigid_pendulum' or 'mechanism'"),
        ({"effort_limit": [10.0, 10.0]}, r"expected 1 value\(s\) > 0, one for each driven joint"),
        ({"angle_box": [0.5]}, r"angle_box is \[0\.5\] rad; expected 2 value\(s\) > 0, one for each joint"),
        ({"ranges": {"mast": [1, 2]}}, "range of mast is 1.0 to 2.0; expected a parameter whose value lies in it"),
        ({"signals": ["cos", "sin", "velocity", "effort"]}, "network takes 18 values and gives 1; expected 15"),
        ({"plant": lambda plant: {**plant, "model": "unicycle"}}, "is no description of plants"),
        ({"plant": lambda plant: {**plant, "joints": plant["joints"][:1]}}, "6 values and 1 joints; expected 6 and 2"),
        ({"plant": lambda plant: {**plant, "values": [9.0, *plant["values"][1:]]}}, "fingerprint is"),
        ({"plant": lambda plant: {**plant, "values": "many"}}, "is no description of plants"),
        ({"plant": lambda plant: {**plant, "joints": [7, 8]}}, "is no description of plants"),
    ],
)
def test_a_header_that_does_not_go_together_is_refused_in_a_sentence(changes, message):
    with pytest.raises(DataError, match=message) as refusal:
        loads_policy(with_header(GOOD, **changes))
    assert str(refusal.value).startswith("policy is refused: ")
    assert "\n" not in str(refusal.value)


def test_positions_are_no_signal_of_a_pendulum():
    with pytest.raises(DataError, match="signals hold 'position', which none of the joints pendulum_joint has"):
        random_policy(load_plant("dfki"), signals=("position", "velocity"))


@given(st.integers(0, len(GOOD) - 1))
@settings(deadline=None, max_examples=30)
def test_a_file_of_several_joints_that_is_cut_anywhere_is_refused_in_a_sentence(length):
    with pytest.raises(DataError, match=r"policy is refused: it is no whole \.npz archive"):
        loads_policy(GOOD[:length])
