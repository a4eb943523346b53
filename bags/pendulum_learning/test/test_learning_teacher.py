"""Imitation of a stored swing-up: the teacher as a law of the state, and what a network learns from it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pendulum_bags.studies.mechanism_benchmark import benchmark_plant
from pendulum_bags.studies.mechanism_benchmark_runs import make_stepper, swing_up
from pendulum_learning import training
from pendulum_learning.environment import SwingUp
from pendulum_learning.evaluation import trials_of
from pendulum_learning.imitation import Imitation
from pendulum_learning.ppo import PpoSettings
from pendulum_learning.task import SwingUpTask
from pendulum_learning.teacher import Teacher
from pendulum_learning.train_cli import main
from pendulum_learning.training import Training, checkpoint_path, train
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_lqr.swing_up.catch import deviation_of
from pendulum_testing.policies import random_policy

PENDUBOT = benchmark_plant("pendubot")
TASK = SwingUpTask(period=0.004, share=0.0, delay=0.0, jitter=0.0, offset=0.0, kick=0.0, episode=0.4)
SMALL = Training(
    plant=PENDUBOT, swing_up=TASK, ppo=PpoSettings(hidden=(16, 16), horizon=16), environments=32, updates=11, seed=3,
    teacher="tvlqr",
)  # fmt: skip


@pytest.fixture(scope="module")
def teacher():
    return Teacher(PENDUBOT, 0.004)


class Asked:
    """The teacher as a controller of states every 2 ms."""

    def __init__(self, teacher, plant):
        self.teacher, self.plant = teacher, plant

    def reset(self):
        self.count = 0

    def efforts(self, _t, position, velocity):
        if self.count % 2 == 0:
            x = deviation_of(self.plant.coordinates, position + velocity)
            self.held = tuple(self.teacher.output(x[None]).efforts[0])
        self.count += 1
        return self.held


@pytest.mark.parametrize(("name", "least"), [("acrobot", 0.687), ("pendubot", 0.685)])
def test_a_teacher_that_knows_the_state_alone_scores_as_the_swing_up_that_knows_the_time(name, least):
    plant = benchmark_plant(name)
    _, _, score = swing_up(plant, make_stepper(plant, compiled=False), Asked(Teacher(plant, 0.004), plant))
    assert score == pytest.approx(least, abs=1e-3)


def test_on_its_way_a_teacher_answers_with_the_swing_up_s_efforts_however_often_a_joint_has_turned(teacher):
    turned = teacher.states + np.array([2.0 * math.pi, -4.0 * math.pi, 0.0, 0.0])
    for states in (teacher.states, turned):
        found = teacher.output(states)
        np.testing.assert_allclose(found.efforts, np.clip(teacher.efforts, -6.0, 6.0), atol=1e-6)
        np.testing.assert_allclose(found.cost, 0.0, atol=1e-9)
    np.testing.assert_array_equal(teacher.output(np.zeros((1, 4))).efforts, 0.0)
    far = teacher.output(np.random.default_rng(0).normal(0.0, 5.0, (200, 4)))
    assert np.median(far.cost) > 6.0
    assert np.abs(far.efforts).max() == 6.0


def test_states_around_the_way_are_as_near_as_was_asked_for(teacher):
    nodes = np.arange(len(teacher.states))
    states, efforts = teacher.around(nodes, 0.5, np.random.default_rng(0))
    # Another node may be nearer still.
    cost = teacher.output(states).cost
    assert 0.2 < cost.max() <= 0.5 + 1e-9
    np.testing.assert_array_equal(efforts[1:], teacher.efforts[:-1])
    np.testing.assert_array_equal(efforts[0], 0.0)


def test_a_network_learns_what_its_teacher_does_and_starts_along_its_way(teacher):
    env = SwingUp(64, PENDUBOT, {}, TASK, np.random.default_rng(0))
    learner = Imitation(env, PpoSettings(hidden=(32, 32), horizon=16), np.random.default_rng(1), teacher)
    assert teacher.output(env.states).cost.max() <= 2.0 + 1e-9
    # From 0.8 on nobody is led any more: all errors are those on the pupil's own states.
    errors = [learner.update(0.8 - number / 50)["divergence"] for number in range(40)]
    assert np.mean(errors[-5:]) < 0.5 * np.mean(errors[:5])


def test_episodes_start_at_hanging_upright_and_on_the_way_and_who_strays_starts_anew(teacher):
    env = SwingUp(400, PENDUBOT, {}, TASK, np.random.default_rng(0))
    learner = Imitation(env, PpoSettings(hidden=(8, 8), horizon=2), np.random.default_rng(1), teacher)
    ends = [np.mean(np.abs(env.states[:, :2]).max(axis=1) < 0.02), np.mean(np.abs(env.states[:, 0] + math.pi) < 0.02)]
    assert all(0.03 < share < 0.3 for share in ends)
    astray = np.tile([2.0, 2.0, 0.0, 0.0], (400, 1))
    env.start_at(np.arange(400), astray, np.zeros((400, 1)))
    assert teacher.output(env.states).cost.min() > 6.0
    learner.update()
    assert teacher.output(env.states).cost.max() < 6.0


def test_an_episode_that_starts_elsewhere_knows_the_effort_that_acts_there():
    env = SwingUp(3, PENDUBOT, {}, TASK, np.random.default_rng(0))
    states = np.array([[0.1, -0.2, 1.0, 2.0], [0.0, 0.0, 0.0, 0.0]])
    env.start_at(np.array([0, 2]), states, np.array([[3.0], [-1.5]]))
    np.testing.assert_array_equal(env.states[[0, 2]], states)
    np.testing.assert_array_equal(env.effort[[0, 2], 0], [3.0, -1.5])
    np.testing.assert_array_equal(env.motion[[0, 2], 4], [3.0, -1.5])
    np.testing.assert_allclose(env.observe()[0][[0, 2]].reshape(2, 3, -1)[:, :, -1], [[0.5] * 3, [-0.25] * 3])


def test_an_answer_beyond_a_limit_that_is_asked_for_is_right(teacher, monkeypatch):
    env = SwingUp(4, PENDUBOT, {}, TASK, np.random.default_rng(0))
    learner = Imitation(env, PpoSettings(hidden=(8, 8), horizon=8), np.random.default_rng(1), teacher)
    learner.actor.parameters[-1][...] = 3.0
    seen = np.zeros((48, env.observation_size), dtype=np.float32)
    for right, error in ((1.0, 0.0), (-1.0, 16.0)):
        monkeypatch.setattr(learner, "_gather", lambda _led, right=right: (seen, np.full((48, 1), right, "f4"), 0.0))
        assert learner.update()["divergence"] == pytest.approx(error, rel=0.1)


def test_one_seed_is_one_file_also_when_an_imitation_was_interrupted(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "TRIALS", 2)
    whole, parts = tmp_path / "whole.npz", tmp_path / "parts.npz"
    train(SMALL, whole)

    def interrupt(done, _measured):
        if done == 11:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(SMALL, parts, on_update=interrupt)
    assert checkpoint_path(parts).exists()
    train(SMALL, parts)
    assert parts.read_bytes() == whole.read_bytes()
    told = load_policy(whole).provenance
    assert told["training"]["teacher"] == "tvlqr"
    assert told["evaluation"]["start"] == "hanging"
    assert "teacher" not in replace(SMALL, teacher="none").to_json()


def test_trials_of_one_way_up_start_hanging_at_rest_without_kicks():
    policy = random_policy(PENDUBOT)
    for trial in trials_of(policy, SwingUpTask(), 3, 0, hanging=True):
        assert trial.position == trial.velocity == (0.0, 0.0)
        assert not trial.kicks.any()
    assert any(trial.kicks.any() and any(trial.position) for trial in trials_of(policy, SwingUpTask(), 3, 0))


def test_the_command_takes_ranges_and_noise_of_a_teacher_where_none_are_given(tmp_path, monkeypatch):
    seen: list[Training] = []

    def trained(settings, _out, **_how):
        seen.append(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "train", trained)
    taught = ["--plant", "pendubot_frictionless", "--teacher", "tvlqr"]
    for arguments in ([*taught, "--kick", "0.7", "--period", "0.01"], [*taught], ["--plant", "pendubot"]):
        assert main([*arguments, "--out", str(tmp_path / "policy.npz")]) == 130
    found = [(each.swing_up.period, each.swing_up.kick, each.swing_up.share, each.updates) for each in seen]
    assert found == [(0.01, 0.7, 0.05, 300), (0.004, 0.05, 0.05, 300), (0.01, 0.7, 0.25, 1500)]
    assert [each.swing_up.offset for each in seen] == [0.001, 0.001, SwingUpTask().offset]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--teacher", "hope"], "teacher is 'hope'; expected one of none, tvlqr"),
        (["--teacher", "tvlqr"], "teacher is 'tvlqr', and plant 'dfki' has one joint; expected one of several"),
        (
            ["--teacher", "tvlqr", "--plant", "cart_pole"],
            "no swing-up is stored for plant 'cart_pole'; expected one of",
        ),
        (["--teacher", "tvlqr", "--task", "pendulum_v1"], "--teacher is given, but the task pendulum_v1"),
    ],
)
def test_a_teacher_that_cannot_teach_is_refused_in_a_sentence(tmp_path, capsys, arguments, message):
    assert main(["--out", str(tmp_path / "policy.npz"), *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())
