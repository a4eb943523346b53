"""A learned policy as a controller: its file, its answers, and where it gives up."""

import io
import json
import math
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.policy import LearnedPolicy
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.policies.policy import Network, fingerprint
from pendulum_lqr.policies.policy_file import LARGEST_FILE, dumps_policy, load_policy, loads_policy, write_policy
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_testing.policies import linear_policy, random_policy

DFKI = load_plant("dfki")
THESIS = load_plant("thesis")


def controller(tmp_path, learned, plant=DFKI, period=0.01, **values):
    """Return the controller of a policy, with all of its torque from the start unless told otherwise."""
    path = write_policy(tmp_path / "policy.npz", learned)
    return make_controller("policy", plant, period, {"policy": str(path), "start_time": 0.0, **values})


def entries(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(parts, compression=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def with_header(content, **changes):
    parts = entries(content)
    header = json.loads(np.load(io.BytesIO(parts["header.npy"])).tobytes())
    header.update(changes)
    parts["header.npy"] = npy(np.frombuffer(json.dumps(header).encode(), dtype=np.uint8))
    return archive_of(parts)


def taken(content):
    """Return the policy, or None where it is refused in one sentence."""
    problem = ""
    try:
        return loads_policy(content)
    except DataError as error:
        problem = str(error)
    assert problem.startswith("policy is refused: ")
    assert "\n" not in problem
    assert len(problem) < 700
    return None


@pytest.mark.parametrize("output", ["clip", "tanh"])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_a_policy_comes_back_from_its_file_to_the_last_bit(tmp_path, activation, output):
    policy = random_policy(
        DFKI,
        activation=activation,
        output=output,
        ranges={"inertia": (0.1, 0.2)},
        effort_rate=(60.0,),
        provenance={"seed": 7},
    )
    back = load_policy(write_policy(tmp_path / "a.npz", policy))
    for ours, theirs in zip(policy.network.weights, back.network.weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert back.plant == DFKI
    assert (back.ranges, back.effort_rate, back.provenance) == ({"inertia": (0.1, 0.2)}, (60.0,), {"seed": 7})
    assert dumps_policy(back) == dumps_policy(policy)


def test_a_policy_is_the_same_law_as_its_network(tmp_path, simulate):
    policy = linear_policy(DFKI, 30.0, 3.0)
    learned = controller(tmp_path, policy)
    x = (0.01, -0.02)
    assert learned.command(0.0, x) == pytest.approx(-(30.0 * math.sin(0.01) - 3.0 * 0.02), rel=1e-5)
    run = simulate(DFKI, controller(tmp_path, policy), theta=math.pi + 0.1, duration=4.0)
    assert abs(run.angle[-1]) < 0.02
    network = random_policy(DFKI, history=2, seed=3)
    learned = controller(tmp_path, network)
    first, second = (learned.command(0.01 * k, x) for k, x in enumerate([(0.3, 1.0), (0.31, -1.0)]))
    row = [[math.cos(0.3), math.sin(0.3), 1.0, 0.0], [math.cos(0.31), math.sin(0.31), -1.0, first / 1.5]]
    whole = np.array([[*row[0], *row[0]], [*row[0], *row[1]]], dtype=np.float32)
    expected = 1.5 * network.network.forward(whole)[:, 0]
    assert (first, second) == (pytest.approx(expected[0], abs=1e-5), pytest.approx(expected[1], abs=1e-5))


def test_answers_change_no_faster_than_the_policy_was_trained_for(tmp_path):
    policy = random_policy(DFKI, effort_rate=(30.0,), seed=1)
    learned = controller(tmp_path, policy)
    rng = np.random.default_rng(0)
    efforts = [0.0] + [learned.command(0.01 * k, tuple(rng.uniform(-3.0, 3.0, 2))) for k in range(200)]
    steps = np.abs(np.diff(efforts))
    assert steps.max() == pytest.approx(0.3)
    tight = controller(tmp_path, policy, effort_limit=0.4)
    assert max(abs(tight.command(0.01 * k, tuple(rng.uniform(-3.0, 3.0, 2)))) for k in range(200)) <= 0.4


@pytest.mark.parametrize("period", [0.01, 0.002])
@pytest.mark.parametrize("gain", [100.0, -100.0])
def test_torque_begins_at_zero_and_rises_to_the_limit_in_its_start_time(tmp_path, gain, period):
    own = controller(tmp_path, linear_policy(THESIS, gain, 0.0), THESIS, period, start_time=0.2)
    times = period * np.arange(round(0.5 / period))
    for _ in range(2):  # a restart begins anew
        efforts = np.array([own.command(t, (1.0, 0.0)) for t in times])
        assert efforts[0] == 0.0
        assert np.all(np.abs(efforts) <= THESIS.effort_limit * np.minimum(1.0, times / 0.2) + 1e-12)
        assert abs(efforts[times <= 0.02][-1]) <= 2.0  # a bridge lets a first command in up to here
        np.testing.assert_allclose(efforts[times > 0.215], -np.sign(gain) * THESIS.effort_limit)
        own.reset()


def test_a_fallback_begins_at_zero_torque_too(tmp_path):
    own = controller(
        tmp_path, linear_policy(DFKI, 1.0, 0.0, velocity_box=(1.0,)), fallback="energy_swing_up", start_time=0.2
    )
    efforts = [own.command(0.01 * k, (3.0, 2.0)) for k in range(30)]
    assert "gave up after 0.000 s" in own.notice
    assert efforts[0] == 0.0
    assert abs(efforts[1]) <= 0.05 * DFKI.effort_limit + 1e-12
    assert abs(efforts[-1]) == pytest.approx(DFKI.effort_limit)


def test_faster_states_get_each_answer_as_often_and_other_periods_are_refused(tmp_path):
    policy = random_policy(DFKI, seed=2)
    fast = controller(tmp_path, policy, period=0.002)
    states = [(0.01 * k, 0.1 * k) for k in range(20)]
    efforts = [fast.command(0.002 * k, x) for k, x in enumerate(states)]
    slow = controller(tmp_path, policy)
    assert efforts[::5] == [slow.command(0.01 * k, x) for k, x in enumerate(states[::5])]
    assert all(len(set(efforts[k : k + 5])) == 1 for k in range(0, 20, 5))
    for period in (0.004, 0.02, 0.015):
        with pytest.raises(ParameterError, match=rf"period of 0\.01 s and states come every {period}"):
            controller(tmp_path, policy, period=period)
    # As long as nobody knows the period, nothing is refused for it.
    path = str(write_policy(tmp_path / "slow.npz", random_policy(DFKI, period=0.003)))
    make_controller("policy", DFKI, 0.01, {"policy": path}, checked=False)


@pytest.mark.parametrize("x", [(0.1, 21.0), (0.1, -21.0), (math.nan, 0.0), (0.1, math.inf), (0.1, math.nan)])
def test_outside_of_its_box_it_gives_up_for_good_and_says_so(tmp_path, x):
    learned = controller(tmp_path, random_policy(DFKI, seed=4))
    assert learned.command(0.0, (0.1, 0.0)) != 0.0
    assert learned.notice == ""
    assert learned.command(0.01, x) == 0.0
    assert learned.command(0.02, (0.1, 0.0)) == 0.0
    assert learned.notice.startswith("gave up after 0.010 s: angle")
    assert learned.notice in learned.describe()
    learned.reset()
    assert learned.notice == ""
    assert learned.command(0.0, (0.1, 0.0)) != 0.0


@pytest.mark.parametrize("period", [0.002, 0.02, 0.0125, 0.0])
def test_states_at_another_rate_than_said_make_it_give_up(tmp_path, period):
    learned = controller(tmp_path, random_policy(DFKI, seed=4))
    efforts = [learned.command(period * k, (0.1, 0.0)) for k in range(40)]
    assert efforts[0] != 0.0
    assert efforts[-1] == 0.0
    assert f"states come every {period:g} s; the policy expects 0.01 s" in learned.notice
    # A state that is late, or lost, now and then is no other rate.
    learned.reset()
    for k in range(200):
        learned.command(0.01 * k + (0.004 if k % 3 == 0 else 0.0) + 0.01 * (k // 10), (0.1, 0.0))
    assert learned.notice == ""


def test_a_chosen_fallback_answers_after_it_gave_up(tmp_path):
    learned = controller(tmp_path, random_policy(DFKI, seed=4, velocity_box=(2.0,)), fallback="energy_swing_up")
    learned.command(0.0, (0.1, 2.5))
    own = make_controller("energy_swing_up", DFKI, 0.01)
    own.command(0.0, (0.1, 2.5))
    for k, x in enumerate([(0.05, 1.0), (3.0, -1.0), (-2.0, 4.0)]):
        assert learned.command(0.01 + 0.01 * k, x) == own.command(0.01 + 0.01 * k, x) != 0.0


@pytest.mark.parametrize("fallback", ["lqr", "pd_gravity", "energy_swing_up"])
def test_a_fallback_answers_a_state_that_is_no_number_with_no_torque(tmp_path, fallback):
    learned = controller(tmp_path, random_policy(DFKI, velocity_box=(2.0,)), fallback=fallback)
    assert learned.command(0.0, (0.1, 2.5)) != 0.0
    for x in ((math.nan, 0.0), (3.0, math.inf), (0.1, math.nan)):
        assert learned.command(0.01, x) == 0.0
    assert learned.command(0.02, (0.1, 2.5)) != 0.0


def test_a_network_that_overflows_gives_up_and_never_answers_nan(tmp_path):
    weight = np.full((8, 4), 3e38, dtype=np.float32)
    out = np.array([[1.0, -1.0] * 4], dtype=np.float32)
    network = Network((weight, out), (np.zeros(8, dtype=np.float32), np.zeros(1, dtype=np.float32)), "relu", "tanh")
    policy = random_policy(DFKI, history=1)
    learned = LearnedPolicy(type(policy)(**{**policy.__dict__, "network": network}), 1, (1.5,))
    assert learned.command(0.0, (0.3, 2.0)) == 0.0
    assert "its network returned" in learned.notice
    with pytest.raises(DataError, match="test vectors come out wrong"):
        loads_policy(dumps_policy(learned.policy))


@given(
    st.lists(st.tuples(st.floats(-math.pi, math.pi), st.floats(allow_nan=True, allow_infinity=True)), max_size=20),
    st.integers(0, 3),
)
@settings(deadline=None, max_examples=50)
def test_whatever_the_states_the_answer_is_a_torque_within_the_limit(states, seed):
    learned = LearnedPolicy(random_policy(DFKI, seed=seed, effort_rate=(20.0,)), 1, (1.0,))
    for k, x in enumerate(states):
        effort = learned.command(0.01 * k, x)
        assert isinstance(effort, float)
        assert abs(effort) <= 1.0


def test_a_change_while_it_runs_does_not_forget_the_past(tmp_path):
    policy = random_policy(DFKI, effort_rate=(20.0,), seed=5)
    first, second = (controller(tmp_path, policy) for _ in range(2))
    for k in range(5):
        first.command(0.01 * k, (0.1 * k, 1.0))
    second.carry_over(first)
    assert second.command(0.05, (0.5, 1.0)) == first.command(0.05, (0.5, 1.0))
    first.command(0.06, (0.5, 99.0))
    second.carry_over(first)
    assert second.command(0.07, (0.5, 1.0)) == 0.0


def test_a_lower_limit_holds_for_the_answer_that_is_taken_over_too():
    policy = linear_policy(DFKI, 1000.0, 0.0)
    strong = LearnedPolicy(policy, 5, DFKI.effort_limits, start_time=0.0)
    assert strong.command(0.0, (1.0, 0.0)) == -DFKI.effort_limit
    weak, quick = LearnedPolicy(policy, 5, (0.3,), start_time=0.0), LearnedPolicy(policy, 1, (1.5,), start_time=0.0)
    for each in (weak, quick):
        each.carry_over(strong)
    assert weak.command(0.002, (1.0, 0.0)) == -0.3
    # One answer a state does not wait for the four that were left of the other's.
    quick.command(0.002, (1.0, 0.0))
    assert quick.command(0.012, (-1.0, 0.0)) == DFKI.effort_limit


def test_a_fallback_is_reset_and_taken_over_with_its_policy():
    class Fallback(Controller):
        heard: list[object]

        def reset(self):
            self.heard = ["reset"]

        def carry_over(self, previous):
            self.heard = [previous]

    first, second = (LearnedPolicy(random_policy(DFKI), 1, (1.5,), Fallback((1.5,))) for _ in range(2))
    first.reset()
    second.carry_over(first)
    assert first.fallback.heard == ["reset"]
    assert second.fallback.heard == [first.fallback]


def test_a_fallback_that_is_unstable_at_the_period_is_refused(tmp_path):
    slow = random_policy(DFKI, period=0.5)
    with pytest.raises(DesignError, match=r"the fallback makes the loop unstable with a period of 0\.5 s"):
        controller(tmp_path, slow, period=0.5, fallback="lqr")
    assert controller(tmp_path, slow, period=0.5).command(0.0, (0.1, 99.0)) == 0.0


def test_a_weight_that_changes_answers_by_a_thousandth_and_numbers_beyond_all_bounds_are_refused():
    content = dumps_policy(random_policy(DFKI))
    parts = entries(content)
    bias = np.load(io.BytesIO(parts["bias_2.npy"]))
    with pytest.raises(DataError, match=r"its test vectors come out wrong by 0\.001"):
        loads_policy(archive_of({**parts, "bias_2.npy": npy(bias + np.float32(1e-3))}))
    # As many bytes as before: the array keeps its shape.
    header = parts["header.npy"].replace(b'"velocity_box": [20.0]', b'"velocity_box":[1e999]')
    assert header != parts["header.npy"]
    with pytest.raises(DataError, match=r"velocity_box is .*; expected finite numbers"):
        loads_policy(archive_of({**parts, "header.npy": header}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inertia": 0.19}, r"inertia is 0\.19 kg m\^2, trained 0\.1495; expected a plant within"),
        ({"gravity": 2.0}, r"gravity is 2 N m, trained 2\.2 to 3\.7"),
        ({"effort_limit": 1.0}, r"effort_limit is 1 N m, trained 1\.5"),
        ({"drivetrain": "x5_9"}, "trained on a plant that is rigid, and this one is series elastic"),
    ],
)
def test_another_plant_is_refused_with_what_differs(tmp_path, changes, message):
    if "drivetrain" in changes:
        changes = {"drivetrain": load_plant("x5_9").drivetrain}
    policy = random_policy(DFKI, ranges={"gravity": (2.2, 3.7)})
    with pytest.raises(ParameterError, match=message):
        controller(tmp_path, policy, DFKI.with_values(**changes))
    # Within what was trained, and with a stronger motor, it is the same policy, which keeps its own limit.
    near = controller(tmp_path, policy, DFKI.with_values(gravity=2.3, effort_limit=5.0))
    assert near.effort_limits == (1.5,)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"policy": ""}, "policy is empty; expected the path of a policy file"),
        ({"policy": "missing.npz"}, r"policy file missing\.npz does not exist"),
        ({"set_point": 0.2}, r"set_point is 0\.2 rad; a policy holds upright alone"),
        ({"fallback": "hope"}, "fallback is 'hope'; expected one of zero"),
    ],
)
def test_a_bad_parameter_is_refused_in_a_sentence(tmp_path, values, message):
    with pytest.raises((ParameterError, DataError), match=message):
        controller(tmp_path, random_policy(DFKI), **values)


GOOD = dumps_policy(random_policy(DFKI, hidden=(4,)))


@given(st.integers(0, len(GOOD) - 1))
@settings(deadline=None, max_examples=60)
def test_a_file_cut_anywhere_is_refused_in_a_sentence(length):
    with pytest.raises(DataError, match=r"policy is refused: it is no whole \.npz archive"):
        loads_policy(GOOD[:length])


@given(st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), min_size=1, max_size=20))
@settings(deadline=None, max_examples=150)
def test_a_file_with_changed_bytes_is_the_same_policy_or_refused_in_a_sentence(changes):
    content = bytearray(GOOD)
    for where, value in changes:
        content[where] = value
    back = taken(bytes(content))
    assert back is None or dumps_policy(back) == GOOD


@given(st.binary(max_size=400))
@settings(deadline=None, max_examples=60)
def test_bytes_that_are_no_policy_are_refused_in_a_sentence(content):
    with pytest.raises(DataError, match="refused"):
        loads_policy(content)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
_KEYS = sorted(json.loads(np.load(io.BytesIO(entries(GOOD)["header.npy"])).tobytes()))


@given(st.sampled_from(_KEYS), _JSON)
@settings(deadline=None, max_examples=80)
def test_any_value_in_the_header_is_taken_or_refused_in_a_sentence(key, value):
    back = taken(with_header(GOOD, **{key: value}))
    assert back is None or math.isfinite(LearnedPolicy(back, 1, (1.5,)).command(0.0, (0.1, 0.2)))


def test_hostile_archives_are_refused_before_they_take_memory():
    class Evil:
        def __reduce__(self):
            return (exec, ("raise SystemExit('a policy file ran code')",))

    parts = entries(GOOD)
    pickled = io.BytesIO()
    np.save(pickled, np.array([Evil()], dtype=object), allow_pickle=True)
    huge = npy(np.zeros(1, dtype=np.float32)).replace(b"(1,)", b"(9999999999,)"[:13])
    nan = np.load(io.BytesIO(parts["weight_0.npy"])).copy()
    nan[0, 0] = np.nan
    cases = {
        "weight_0.npy": [
            (pickled.getvalue(), "holds object; expected float32"),
            (huge, "no header that numpy reads|as many as its shape says"),
            (npy(nan), "layer 0 has a weight that is not finite"),
            (npy(np.load(io.BytesIO(parts["weight_0.npy"])).astype(np.float64)), "holds float64; expected float32"),
            (npy(np.ones((4, 3), np.float32)), "layers are"),
            (npy(np.ones((4, 12), np.float32)), "test vectors come out wrong"),
        ],
        "header.npy": [
            (npy(np.frombuffer(b"[" * 90_000, dtype=np.uint8)), "header is no JSON"),
            (npy(np.frombuffer(b"[1]", dtype=np.uint8)), "header is a list"),
            (npy(np.frombuffer(b'{"a": NaN}', dtype=np.uint8)), "header holds NaN"),
            (npy(np.frombuffer(b'{"a": 1, "a": 2}', dtype=np.uint8)), "given twice"),
        ],
    }
    tracemalloc.start()
    try:
        for name, contents in cases.items():
            for data, message in contents:
                with pytest.raises(DataError, match=message):
                    loads_policy(archive_of({**parts, name: data}))
        bomb = archive_of({**parts, "weight_0.npy": bytes(30_000_000)}, zipfile.ZIP_DEFLATED)
        tracemalloc.reset_peak()
        with pytest.raises(DataError, match="its arrays take 3000"):
            loads_policy(bomb)
        with pytest.raises(DataError, match="expected header, weight_k, bias_k"):
            loads_policy(archive_of({**parts, "more.npy": b""}))
        with pytest.raises(DataError, match=rf"expected at most {LARGEST_FILE}"):
            loads_policy(bytes(LARGEST_FILE + 1))
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_a_policy_of_another_format_model_or_plant_is_refused():
    for change, message in (
        ({"format": "pendulum_policy/9"}, r"format is 'pendulum_policy/9'; expected 'pendulum_policy/1'"),
        ({"model": "acrobot"}, "model is 'acrobot'; expected 'rigid_pendulum'"),
        ({"fingerprint": fingerprint(THESIS)}, "fingerprint is"),
        ({"period": 0.0}, r"period is 0\.0 s; expected > 0"),
        ({"joints": []}, r"joints are \[\]; expected one name or more"),
        ({"velocity_box": [-1.0]}, r"velocity_box is \[-1\.0\] rad/s; expected 1"),
        ({"surprise": 1}, "unknown key 'surprise'"),
        ({"ranges": {"inertia": [9.0, 10.0]}}, "range of inertia is 9.0 to 10.0"),
    ):
        with pytest.raises(DataError, match=message):
            loads_policy(with_header(GOOD, **change))


def test_files_that_are_no_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="is a folder; expected a file"):
        load_policy(tmp_path)
    with pytest.raises(DataError, match="is a device or a pipe"):
        load_policy("/dev/zero")
    (tmp_path / "huge.npz").touch()
    with (tmp_path / "huge.npz").open("r+b") as file:
        file.truncate(10**12)
    with pytest.raises(DataError, match="has 1000000000000 bytes"):
        load_policy(tmp_path / "huge.npz")
    with pytest.raises(DataError, match="cannot be written"):
        write_policy("/dev/null/policy.npz", random_policy(DFKI))
