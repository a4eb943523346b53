"""Policies to ONNX and from Stable-Baselines3, beside what the libraries themselves make and answer.

The files in ``imported`` come from the libraries: Stable-Baselines3 and sb3-contrib 2.9.2 on torch 2.13.0 (CPU) saved
untrained networks of a few neurons by ``model.save``, the last layer times 3, for PPO 60, so that bounds are reached:
``sac.zip`` (3-4-3-1, relu) and ``tqc.zip`` (3-5-1, tanh) on Gymnasium's Pendulum-v1, and ``ppo.zip`` (2-4-3-1, relu)
on an environment with the spaces of ``PendulumX59-v0`` for ``dfki``. Of each archive the members ``data``,
``policy.pth`` and ``_stable_baselines3_version`` were packed again, compressed. ``*_answers.npz`` is what
``model.predict`` answers, without exploration; ``*_graph.bin`` is the graph that onnx 1.23.2
(``onnx.helper.make_graph``) makes of the same networks.
"""

import base64
import io
import json
import os
import pickle
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.policies.convert_policy_cli import main
from pendulum_lqr.policies.onnx_file import dumps_onnx, observation_names
from pendulum_lqr.policies.policy_file import header_of, load_policy, write_policy
from pendulum_lqr.policies.policy_import import ActorSpec, policy_of_actor
from pendulum_lqr.policies.sb3_archive import LARGEST_ARCHIVE, load_actor
from pendulum_lqr.policies.torch_state import read_state
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant, write_plant
from pendulum_testing.policies import random_policy

IMPORTED = Path(__file__).with_name("imported")
PENDULUM_V1 = pendulum_plant(inertia=1.0 / 3.0, damping=0.0, gravity=5.0, effort_limit=2.0, name="Pendulum-v1")
PLANTS = {"ppo": load_plant("dfki"), "sac": PENDULUM_V1, "tqc": PENDULUM_V1}


def imported(name, **changes):
    told = {"plant": PLANTS[name], "period": 0.05, **changes}
    return policy_of_actor(load_actor(IMPORTED / f"{name}.zip"), ActorSpec(**told), name=name, provenance={})


def members(name="sac"):
    with zipfile.ZipFile(IMPORTED / f"{name}.zip") as archive:
        return {part: archive.read(part) for part in archive.namelist()}


def packed(parts):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def with_data(name="sac", **changes):
    parts = members(name)
    parts["data"] = json.dumps({**json.loads(parts["data"]), **changes}).encode()
    return packed(parts)


def with_weights(change):
    """Return an archive whose weights file was changed: ``change`` gets its members by name."""
    parts = members()
    with zipfile.ZipFile(io.BytesIO(parts["policy.pth"])) as archive:
        inner = {part: archive.read(part) for part in archive.namelist()}
    change(inner)
    parts["policy.pth"] = packed(inner)
    return packed(parts)


def refused(tmp_path, content, words):
    path = tmp_path / "archive.zip"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words) as caught:
        load_actor(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700


@pytest.mark.parametrize("name", ["ppo", "sac", "tqc"])
def test_a_converted_policy_runner_as_the_library_that_trained_it(tmp_path, name):
    path = write_policy(tmp_path / "policy.npz", imported(name))
    controller = make_controller("policy", PLANTS[name], 0.05, {"policy": str(path), "start_time": 0.0})
    with np.load(IMPORTED / f"{name}_answers.npz") as answers:
        assert np.std(answers["action"]) > 0.3
        for angle, velocity, action in zip(*(answers[key] for key in ("theta", "velocity", "action")), strict=True):
            controller.reset()
            assert controller.command(0.0, (float(angle), float(velocity))) == pytest.approx(float(action), abs=1e-6)


def test_a_cosine_from_hanging_another_order_and_stacked_samples_come_out_the_same():
    actor = load_actor(IMPORTED / "sac.zip")
    told = ActorSpec(
        PENDULUM_V1, 0.05, observation="velocity,-cos,-sin", history=1, velocity_scale=8.0, velocity_box=8.0
    )
    # The bounds say where the velocity is.
    with pytest.raises(ParameterError, match="observation says cos and its value lies in -8 to 8") as caught:
        policy_of_actor(actor, ActorSpec(PENDULUM_V1, 0.05, observation="sin,velocity,cos"), name="x", provenance={})
    assert "expected -1 to 1" in str(caught.value)
    free = type(actor.observations)(np.full(3, -np.inf), np.full(3, np.inf))
    unbound = type(actor)(actor.network, free, actor.actions, actor.algorithm, "", None, "")
    policy = policy_of_actor(unbound, told, name="x", provenance={})
    theirs = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)).astype(np.float32)
    ours = np.stack([-theirs[:, 1], -theirs[:, 2], theirs[:, 0]], axis=1)
    np.testing.assert_allclose(policy.network.forward(ours), actor.network.forward(theirs), atol=1e-6)
    stacked = policy_of_actor(
        unbound,
        ActorSpec(PENDULUM_V1, 0.05, observation="velocity", history=3, velocity_box=8.0),
        name="x",
        provenance={},
    )
    np.testing.assert_array_equal(stacked.network.forward(theirs), actor.network.forward(theirs))


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("sac", {"observation": "cos,sin"}, "has 2 values and the actor sees 3"),
        ("sac", {"observation": "cos,sin,speed"}, "'cos,sin,speed'; expected some of angle, cos"),
        ("sac", {"observation": "cos,sin,cos"}, "each signal once"),
        ("sac", {"history": 3}, "expected --observation"),
        ("sac", {"velocity_box": 20.0}, "velocity_box is 20 rad/s and the actor's space ends at 8 rad/s"),
        ("sac", {"plant": load_plant("thesis")}, "the largest action is 2 and plant 'thesis' has .* --effort-limit"),
        ("sac", {"effort_limit": 2.5}, "effort_limit is 2.5 N m and plant 'Pendulum-v1' has 2 N m"),
        ("sac", {"observation": "angle,sin,velocity"}, None),
    ],
)
def test_what_was_declared_has_to_agree_with_the_spaces(name, changes, words):
    if words is None:  # bounds of +-1 rad are those of a pendulum that is held within them
        assert imported(name, **changes).angle_box == (1.0,)
        return
    with pytest.raises(ParameterError, match=words):
        imported(name, **changes)


def test_spaces_of_no_known_environment_must_be_declared(tmp_path):
    content = with_data(
        observation_space={
            **json.loads(members()["data"])["observation_space"],
            "high": "[1. 1. inf]",
            "low": "[-1. -1. -inf]",
        }
    )
    path = tmp_path / "archive.zip"
    path.write_bytes(content)
    actor = load_actor(path)
    with pytest.raises(ParameterError, match=r"sees 3 values up to 1, 1, inf.*expected --observation"):
        policy_of_actor(actor, ActorSpec(PENDULUM_V1, 0.05), name="x", provenance={})
    with pytest.raises(ParameterError, match="expected --velocity-box"):
        policy_of_actor(actor, ActorSpec(PENDULUM_V1, 0.05, "cos,sin,velocity"), name="x", provenance={})
    policy = policy_of_actor(
        actor, ActorSpec(PENDULUM_V1, 0.05, "cos,sin,velocity", velocity_box=9.0), name="x", provenance={}
    )
    assert policy.velocity_box == (9.0,)


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_nothing_in_an_archive_is_executed(tmp_path, protocol):
    mark = tmp_path / "executed"
    bomb = pickle.dumps({"actor.mu.weight": Bomb(mark)}, protocol=protocol)
    refused(
        tmp_path, with_weights(lambda inner: inner.update({"archive/data.pkl": bomb})), "data.pkl (names|has the op)"
    )
    assert not mark.exists()
    # The pickles in ``data`` are never looked at: the archive is as good as before.
    text = base64.b64encode(pickle.dumps(Bomb(mark))).decode()
    data = json.loads(members()["data"])
    changed = {
        key: {**value, ":serialized:": text}
        for key, value in data.items()
        if isinstance(value, dict) and ":serialized:" in value
    }
    assert len(changed) > 5
    path = tmp_path / "archive.zip"
    path.write_bytes(with_data(**changed))
    np.testing.assert_array_equal(
        load_actor(path).network.weights[0], load_actor(IMPORTED / "sac.zip").network.weights[0]
    )
    assert not mark.exists()


def test_damaged_foreign_and_huge_archives_are_refused_in_a_sentence(tmp_path):
    whole = (IMPORTED / "sac.zip").read_bytes()
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        refused(tmp_path, whole[:length], "it is no whole Stable-Baselines3 archive")
    refused(tmp_path, b"%PDF-1.4" + bytes(1000), "no whole Stable-Baselines3 archive")
    refused(tmp_path, members()["policy.pth"], "expected data and policy.pth, each once")
    refused(tmp_path, packed({"data": b"{}", "policy.pth": b""}), "its policy is of None; expected an MlpPolicy")
    refused(
        tmp_path, packed({"data": bytes(30_000_000), "policy.pth": b""}), "data has 30000000 bytes; expected at most"
    )
    refused(tmp_path, packed({"data": b"[1]", "policy.pth": b""}), "data is a list")
    with (tmp_path / "huge.zip").open("wb") as file:
        file.truncate(LARGEST_ARCHIVE + 1)
    with pytest.raises(DataError, match="expected at most 40000000"):
        load_actor(tmp_path / "huge.zip")
    with pytest.raises(DataError, match="is a folder"):
        load_actor(tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        load_actor(tmp_path / "none.zip")
    refused(tmp_path, with_weights(lambda inner: inner.update({"archive/data/0": bytes(4)})), "needs 48 bytes")
    refused(tmp_path, with_weights(lambda inner: inner.update({"archive/byteorder": b"big"})), "byte order")
    nan = np.full(12, np.nan, dtype="<f4").tobytes()
    refused(tmp_path, with_weights(lambda inner: inner.update({"archive/data/0": nan})), "a value that is not finite")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"policy_class": {"__module__": "stable_baselines3.td3.policies"}}, "td3.policies'; expected an MlpPolicy"),
        ({"policy_class": {"__module__": "__main__"}}, "is of '__main__'"),
        ({"policy_class": {"__module__": "stable_baselines3.common.policies"}}, "the layers of a plain MlpPolicy"),
        ({"use_sde": True}, "state-dependent noise"),
        ({"policy_kwargs": {"activation_fn": "<class 'torch.nn.ELU'>"}}, "ELU.*expected Tanh or ReLU"),
        ({"policy_kwargs": {"activation_fn": ["a"]}}, "expected Tanh or ReLU"),
        ({"policy_kwargs": {"features_extractor_class": "<class 'my.Extractor'>"}}, "expected a plain MlpPolicy"),
        ({"policy_kwargs": 3}, "expected a mapping"),
        ({"action_space": {":type:": "<class 'gymnasium.spaces.discrete.Discrete'>", "n": "2"}}, "expected a Box"),
        ({"action_space": {":type:": ["a"]}}, "expected a Box"),
        ({"action_space": {":type:": "<class 'gymnasium.spaces.box.Box'>", "_shape": [1], "low": "[-1.]",
                           "high": "[2.]"}}, "zero in its middle"),
        ({"observation_space": {":type:": "<class 'gymnasium.spaces.box.Box'>", "_shape": [4], "low": "[0. 0. 0. 0.]",
                                "high": "[1. 1. 1. 1.]"}}, "takes 3 values and gives 1, its spaces have 4 and 1"),
        ({"observation_space": {":type:": "<class 'gymnasium.spaces.box.Box'>", "_shape": [2000], "low": "[0. ... 0.]",
                                "high": "[1. ... 1.]"}}, "expected a vector and its bounds"),
    ],
)  # fmt: skip
def test_an_actor_of_another_kind_is_refused_in_a_sentence(tmp_path, changes, words):
    refused(tmp_path, with_data(**changes), words)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=6))
def test_changed_bytes_of_a_pickle_never_pass_unseen_or_raise_anything_else(changes):
    weights = members()["policy.pth"]
    with zipfile.ZipFile(io.BytesIO(weights)) as archive:
        inner = {part: archive.read(part) for part in archive.namelist()}
    pickled = bytearray(inner["archive/data.pkl"])
    for place, value in changes:
        pickled[place % len(pickled)] = value
    inner["archive/data.pkl"] = bytes(pickled)
    try:
        state = read_state(packed(inner))
    except DataError as error:
        assert "\n" not in str(error)  # noqa: PT017 (it may well be refused)
    else:
        assert all(np.isfinite(each).all() for each in state.values())


def test_a_small_pickle_that_means_much_is_refused_at_once():
    # Tuples of the tuple before, twice: printed, they would have 2**60 leaves.
    deep = b"\x80\x02" + b")" + b"q\x00h\x00\x86" * 60
    for tail in (b".", b"Q.", b"R.", b"}q\x01h\x00h\x00s."):
        inner = {"archive/data.pkl": deep + tail}
        with pytest.raises(DataError, match=r"data\.pkl"):
            read_state(packed(inner))


def fields(message):
    """Return the fields of a message of Protocol Buffers, as (number, content)."""
    found, at = [], 0

    def varint():
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        key = varint()
        if key & 7 == 0:
            found.append((key >> 3, varint()))
        else:
            size = varint()
            found.append((key >> 3, message[at : at + size]))
            at += size
    return found


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_a_model_has_the_graph_that_onnx_itself_writes(name):
    model = fields(dumps_onnx(imported(name)))
    assert [content for number, content in model if number == 7] == [(IMPORTED / f"{name}_graph.bin").read_bytes()]
    assert [content for number, content in model if number == 1] == [8]
    assert [fields(content) for number, content in model if number == 8] == [[(1, b""), (2, 13)]]


def test_a_model_says_what_it_sees_and_what_it_may_ask_for():
    policy = random_policy(load_plant("dfki"), effort_rate=(60.0,))
    props = [dict(fields(content)) for number, content in fields(dumps_onnx(policy)) if number == 14]
    told = {prop[1].decode(): json.loads(prop[2]) for prop in props}
    assert told.pop("observation") == observation_names(policy)
    assert told == header_of(policy)
    assert observation_names(policy)[0] == "pendulum_joint: cos, sample -2"
    assert observation_names(policy)[-1] == "pendulum_joint: effort, sample 0"
    assert len(observation_names(policy)) == policy.network.sizes[0]


def test_the_command_converts_both_ways_and_says_what_it_took(tmp_path, capsys):
    plant = write_plant(tmp_path / "v1.yaml", PENDULUM_V1)
    policy, model = tmp_path / "tqc.npz", tmp_path / "tqc.onnx"
    archive = str(IMPORTED / "tqc.zip")
    assert main([archive, "--plant", str(plant), "--period", "0.05", "--out", str(policy)]) == 0
    told = capsys.readouterr().out
    assert "TQC (3-5-1, tanh) sees cos,sin,velocity, from upright; torque within +-2 N m, every 0.05 s" in told
    assert load_policy(policy).provenance["archive"] == "tqc.zip"
    assert main([str(policy), "--out", str(model)]) == 0
    assert model.read_bytes() == dumps_onnx(load_policy(policy))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sac.zip", "--out", "a.npz"], "expected --plant, and a finite"),
        (["sac.zip", "--out", "a.npz", "--plant", "dfki", "--period", "nan"], "expected --plant, and a finite"),
        (["sac.zip", "--out", "a.onnx"], "policy file .*sac.zip is refused"),
        (["sac.zip", "--out", "a.onnx", "--plant", "dfki"], "--plant is given, and a policy file says it itself"),
        (["sac.zip", "--out", "a.bin"], "expected .npz to .onnx, or .zip to .npz"),
        (["sac.zip", "--out", "sac.zip"], "exists; expected a new one"),
        (["sac_answers.npz", "--out", "a.onnx"], "is refused: it holds"),
        (["sac.zip", "--out", "a.npz", "--plant", "dfki", "--period", "0.05"], "largest action is 2"),
        (["sac.zip", "--out", "a.npz", "--plant", "dfki", "--period", "inf"], "expected --plant, and a finite"),
        (
            ["sac.zip", "--out", "a.npz", "--plant", "dfki", "--period", "0.05", "--velocity-scale", "0"],
            "velocity_scale is 0",
        ),
    ],
)
def test_a_conversion_that_cannot_be_is_refused_and_leaves_nothing(tmp_path, capsys, monkeypatch, arguments, words):
    for name in ("sac.zip", "sac_answers.npz"):
        (tmp_path / name).write_bytes((IMPORTED / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert told.startswith("error: ")
    assert re.search(words, told)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sac.zip", "sac_answers.npz"]
