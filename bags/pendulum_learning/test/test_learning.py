"""Training of policies: its pieces against independent ones, and what becomes of a training that is interrupted."""

from __future__ import annotations

import errno
import math
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from pendulum_learning import evaluation, training
from pendulum_learning.environment import SwingUp
from pendulum_learning.evaluation import Trial, run_trial
from pendulum_learning.network import Adam, Mlp
from pendulum_learning.pendulum_v1 import PendulumV1
from pendulum_learning.ppo import Ppo, PpoSettings
from pendulum_learning.task import SwingUpTask, ranges_of
from pendulum_learning.train_cli import main
from pendulum_learning.training import Training, checkpoint_path, train
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import DataError, FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_testing.policies import random_policy

DFKI = load_plant("dfki")
FEW_TRIALS, FEW_EPISODES = 3, 2
QUIET = SwingUpTask(delay=0.0, jitter=0.0, angle_noise=0.0, velocity_noise=0.0, offset=0.0, kick=0.0, kick_rate=0.0)
SMALL = Training(
    plant=DFKI, ppo=PpoSettings(hidden=(8, 8), horizon=8, epochs=2, batches=2), environments=16, updates=12, seed=3
)


@pytest.fixture(autouse=True)
def _few_trials(monkeypatch):
    monkeypatch.setattr(training, "TRIALS", FEW_TRIALS)
    monkeypatch.setattr(training, "EPISODES", FEW_EPISODES)


def test_the_derivatives_of_a_network_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    # Two layers of one width, whose arrays are not to be one.
    network = Mlp((3, 5, 5, 2), rng)
    network.parameters = [each.astype(np.float64) for each in network.parameters]
    x, towards = rng.normal(size=(7, 3)), rng.normal(size=(7, 2))
    network.forward(x)
    gradients = network.backward(towards)
    for parameter, gradient in zip(network.parameters, gradients, strict=True):
        for index in np.ndindex(parameter.shape):
            was, step = parameter[index], 1e-6
            parameter[index] = was + step
            above = float(np.sum(network.forward(x) * towards))
            parameter[index] = was - step
            below = float(np.sum(network.forward(x) * towards))
            parameter[index] = was
            assert gradient[index] == pytest.approx((above - below) / (2.0 * step), abs=1e-7)


def test_adam_takes_the_steps_that_its_paper_gives():
    value = np.array([1.0, -2.0], dtype=np.float32)
    adam = Adam([value], longest=1e9)
    m = v = np.zeros(2)
    expected = value.astype(np.float64)
    for t in range(1, 6):
        g = 2.0 * expected
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        expected = expected - 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        adam.step([2.0 * value], 0.01)
    np.testing.assert_allclose(value, expected, rtol=1e-4)


def test_pendulum_v1_moves_as_gymnasium_s_own():
    ours = PendulumV1(1, np.random.default_rng(0))
    theirs = gymnasium.make("Pendulum-v1").unwrapped
    theirs.reset(seed=0)
    theirs.state = np.array([ours.angle[0], ours.velocity[0]])
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, 300).astype(np.float32)
    for action in actions:
        seen, reward, *_ = theirs.step(np.array([2.0 * action], dtype=np.float32))
        rewards, _ = ours.step(np.array([[action]], dtype=np.float32))
        assert rewards[0] == pytest.approx(0.1 * reward, abs=1e-4)
        np.testing.assert_allclose(ours.observe()[0][0], [seen[0], seen[1], seen[2] / 8.0], atol=1e-4)


def test_what_a_policy_sees_and_does_in_training_is_what_it_sees_and_does_as_a_controller():
    env = SwingUp(1, DFKI, {}, QUIET, np.random.default_rng(2))
    env.motion[0] = (-math.pi + 0.4, 0.3, 0.0, 0.0, 0.0, 0.0)
    env.effort[:] = 0.0
    first = [math.cos(env.motion[0, 0]), math.sin(env.motion[0, 0]), 0.3 / env.scale[0], 0.0]
    env._samples[:] = np.tile(first, 3)
    rate = 2.0 * DFKI.effort_limit / QUIET.rate_time
    policy = random_policy(DFKI, seed=5, effort_rate=(rate,), velocity_scale=(env.scale[0],), velocity_box=(50.0,))
    # The same integrator as in training, at its step.
    rows, notice = run_trial(policy, Trial(DFKI, (0.4,), (0.3,), np.zeros((300, 1))), start_time=0.0)
    assert notice == ""
    for k in range(300):
        x = (env.motion[0, 0] + math.pi) % (2.0 * math.pi) - math.pi
        assert math.cos(x - rows[0, k]) == pytest.approx(1.0, abs=1e-7)
        assert env.motion[0, 1] == pytest.approx(rows[1, k], abs=2e-4)
        env.step(policy.network.forward(env.observe()[0]))
        assert env.effort[0] == pytest.approx(rows[2, k], abs=2e-4)


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.01, 0.013, 0.02])
def test_a_torque_acts_after_the_delay_as_in_the_simulator(delay):
    plant = DFKI.with_values(transport_delay=delay, coulomb_friction=0.0, static_friction=0.0)
    ours = SwingUp(1, plant, {}, QUIET, np.random.default_rng(0))
    ours.motion[0] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ours.effort[:], ours.delay[:] = 0.0, delay
    ours.step_limit[:] = math.inf
    simulated = make_pendulum(plant, QUIET.period, substeps=8)
    simulated.reset(math.pi, 0.0)
    for effort in np.random.default_rng(1).uniform(-1.5, 1.5, 30):
        ours.step(np.array([[effort / 1.5]], dtype=np.float32))
        state = simulated.step(float(np.float32(effort / 1.5)) * 1.5)
        assert ours.motion[0, 0] + math.pi == pytest.approx(state.theta, abs=1e-6)


def test_no_torque_acts_before_its_answer_and_each_episode_has_a_zero_angle_of_its_own():
    task = replace(QUIET, jitter=0.005, offset=0.01)
    env = SwingUp(200, DFKI, {}, task, np.random.default_rng(0))
    late, advance = [], env.body.advance

    def watched(motion, parameters, efforts, delays, *rest):
        late.append(delays.copy())
        advance(motion, parameters, efforts, delays, *rest)

    env.body = replace(env.body, advance=watched)
    errors = []
    for _ in range(3):
        env.step(np.zeros((200, 1), dtype=np.float32))
        seen = env.observe()[0][:, -4:]
        errors.append(wrap(np.arctan2(seen[:, 1], seen[:, 0]) - env.motion[:, 0]))
    assert np.min(late) == 0.0 < np.max(late)
    np.testing.assert_allclose(errors[0], errors[2], atol=1e-6)
    assert 0.009 < np.abs(errors[0]).max() <= 0.0101


def test_a_policy_s_file_tells_the_fastest_motion_of_the_whole_training_and_its_rate(tmp_path, monkeypatch):
    speeds = iter([1.0, 5.0, 2.0])

    def update(self, remaining):
        self.environment.motion[:, 1] = -next(speeds)
        return {"reward": 0.0, "divergence": 0.0, "spread": 0.1}

    monkeypatch.setattr(training.Ppo, "update", update)
    policy, _ = train(replace(SMALL, updates=3), tmp_path / "policy.npz")
    assert policy.velocity_box == pytest.approx((1.1 * 5.0,))
    # From limit to limit in the time that training allowed.
    assert policy.effort_rate == pytest.approx((2.0 * DFKI.effort_limit / SMALL.swing_up.rate_time,))


def test_plants_are_drawn_from_the_ranges_and_wider_intervals_of_the_plant_file_count():
    ranges = ranges_of(DFKI, 0.25, {"inertia": [0.05, 0.16]})
    assert ranges["inertia"] == (0.05, pytest.approx(0.1869, abs=1e-4))
    assert ranges["gravity"] == (pytest.approx(2.2477, abs=1e-4), pytest.approx(3.7462, abs=1e-4))
    assert ranges["static_friction"] == ranges["coulomb_friction"]
    env = SwingUp(2000, DFKI, ranges, SwingUpTask(), np.random.default_rng(0))
    for column, name in enumerate(("inertia", "damping", "gravity", "coulomb_friction", "static_friction")):
        drawn = env.parameters[:, column]
        low, high = ranges[name]
        assert low <= drawn.min() < low + 0.01 * (high - low)
        assert high >= drawn.max() > high - 0.01 * (high - low)
    np.testing.assert_array_equal(env.parameters[:, 3], env.parameters[:, 4])


def test_half_of_the_parameters_of_one_joint_lie_at_an_end_of_their_range():
    ranges = ranges_of(DFKI, 0.25, {})
    env = SwingUp(4000, DFKI, ranges, SwingUpTask(), np.random.default_rng(0))
    for name in ("inertia", "gravity"):
        drawn = env.parameters[:, env.body.columns[name]]
        for end in ranges[name]:
            assert np.mean(drawn == end) == pytest.approx(0.25, abs=0.03)


def test_some_of_one_joint_start_spinning_and_some_where_their_effort_holds_them_on_both_sides():
    env = SwingUp(4000, DFKI, ranges_of(DFKI, 0.25, {}), QUIET, np.random.default_rng(0))
    spinning = np.abs(env.motion[:, 1]) > 2.5 * env.scale[0]
    assert np.mean(spinning) == pytest.approx(0.1 / 6.0, abs=0.01)
    held = env.effort[:, 0] != 0.0
    assert np.mean(held) == pytest.approx(0.1, abs=0.02)
    before = env.motion[held, 0].copy()
    assert min(np.sum(np.cos(before) > 0.1), np.sum(np.cos(before) < -0.1)) > 100
    assert np.mean(np.abs(env.effort[held, 0]) == env.limit[0]) == pytest.approx(1.0 / 3.0, abs=0.1)
    for _ in range(3):
        env.step((env.effort / env.limit).astype(np.float32))
    np.testing.assert_allclose(env.motion[held, 0], before, atol=1e-6)


def test_who_falls_in_the_last_second_is_not_up(monkeypatch):
    policy = random_policy(DFKI)
    trials = [Trial(DFKI, (0.0,), (0.0,), np.zeros((300, 1))) for _ in range(3)]
    down = iter([(0, 150), (200, 201), (199, 200)])  # until 1.5 s, once in the last second, once just before it

    def run(*_):
        rows = np.zeros((3, 300))
        rows[0, slice(*next(down))] = 1.0
        return rows, ""

    monkeypatch.setattr(evaluation, "run_trial", run)
    told = evaluation.measured_success(policy, trials)
    assert (told["up"], told["median_time"]) == (2, pytest.approx(1.75))


def test_the_time_that_is_over_is_no_end_the_value_of_where_it_got_to_counts():
    class Counting:
        """Its state counts steps, and an episode begins anew at 3."""

        count, observation_size, privileged_size, action_size = 1, 1, 0, 1
        at = 0.0

        def observe(self):
            return np.array([[self.at]], dtype=np.float32), np.zeros((1, 0), dtype=np.float32)

        def step(self, _actions):
            self.at += 1.0
            return np.zeros(1, dtype=np.float32), np.array([self.at == 3.0])

        def restart(self, which):
            self.at = 0.0 if which[0] else self.at

    settings = PpoSettings(hidden=(4, 4), horizon=8, discount=1.0, trace=0.0)
    learner = Ppo(Counting(), settings, np.random.default_rng(0))
    learner.critic.forward = lambda x: x
    (seen, _, _, advantages, _), _ = learner._gather()
    assert seen[:, 0].tolist() == [0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 0.0, 1.0]
    np.testing.assert_array_equal(advantages, 1.0)


def test_learning_improves_a_policy():
    generator = np.random.default_rng(0)
    learner = Ppo(
        PendulumV1(64, generator), PpoSettings(hidden=(32, 32), discount=0.95, epochs=6, batches=4), generator
    )
    rewards = [learner.update()["reward"] for _ in range(40)]
    assert np.mean(rewards[-5:]) > 0.6 * np.mean(rewards[:5])


def test_one_seed_is_one_file_also_when_the_training_was_interrupted(tmp_path):
    whole = tmp_path / "whole.npz"
    train(SMALL, whole)
    assert not checkpoint_path(whole).exists()

    class Interrupted(KeyboardInterrupt):
        pass

    def interrupt(done, measured):
        if done == 11:
            raise Interrupted

    parts = tmp_path / "parts.npz"
    with pytest.raises(Interrupted):
        train(SMALL, parts, on_update=interrupt)
    assert not parts.exists()
    assert checkpoint_path(parts).exists()
    done: list[int] = []
    train(SMALL, parts, on_update=lambda number, _: done.append(number))
    assert done == [10, 11, 12]
    assert parts.read_bytes() == whole.read_bytes()
    policy = load_policy(parts)
    assert policy.provenance["training"]["seed"] == 3
    assert policy.provenance["evaluation"]["trials"] == FEW_TRIALS


def test_a_checkpoint_of_other_settings_or_of_nothing_is_refused(tmp_path):
    out = tmp_path / "policy.npz"
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, out, on_update=_interrupt_at(11))
    with pytest.raises(ParameterError, match="is of a training with other settings"):
        train(Training(**{**SMALL.__dict__, "seed": 4}), out)
    content = checkpoint_path(out).read_bytes()
    for damaged in (content[: len(content) // 2], b"nonsense"):
        checkpoint_path(out).write_bytes(damaged)
        with pytest.raises(DataError, match=r"cannot be read \(\w+\); expected one of ours, or none"):
            train(SMALL, out)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    out = tmp_path_factory.mktemp("checkpoint") / "policy.npz"
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, out, on_update=_interrupt_at(11))
    with np.load(checkpoint_path(out)) as kept:
        return dict(kept)


_ACTOR = "learner/actor_0"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (_ACTOR, lambda each: each[:1], rf"{_ACTOR} has shape \(1, \d+\) of float32; expected \(\d+, \d+\) of float32"),
        ("environment/motion", lambda each: each[:1], r"motion has shape \(1, \d+\) of float64; expected \(\d+, \d+\)"),
        (_ACTOR, lambda each: each.astype(complex), r"of complex64|of complex128; expected .* of float32"),
        ("fastest", lambda _: np.array(["a"]), r"fastest has shape \(1,\) of <U1; expected \(1,\) of float64"),
        ("fastest", lambda each: each * np.inf, "fastest holds a number that is not finite"),
        (_ACTOR, lambda each: each * np.float32(np.nan), f"{_ACTOR} holds a number that is not finite"),
        (_ACTOR, None, f"lacks {_ACTOR}; expected a whole one"),
        ("environment/astray", None, "lacks environment/astray; expected a whole one"),
        ("curves", lambda each: np.repeat(each, 2, axis=0), "has done 20 updates; expected 1 to 12"),
        ("curves", lambda each: each[:0], "has done 0 updates; expected 1 to 12"),
    ],
)
def test_a_checkpoint_that_lacks_an_array_or_holds_another_is_refused(tmp_path, checkpoint, name, change, message):
    arrays = {key: each for key, each in checkpoint.items() if key != name}
    if change is not None:
        arrays[name] = change(checkpoint[name])
    out = tmp_path / "policy.npz"
    np.savez(checkpoint_path(out), **arrays)
    with pytest.raises(DataError, match=message):
        train(SMALL, out)
    assert not out.exists()


def test_ctrl_c_while_a_checkpoint_is_written_leaves_no_half_of_it(tmp_path, monkeypatch):
    def interrupted(path, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_the_checkpoint_before_it(tmp_path, monkeypatch):
    out = tmp_path / "policy.npz"
    replace = Path.replace
    kept: list[bytes] = []

    def full(path, target):
        if kept:
            raise OSError(errno.ENOSPC, "No space left on device")
        kept.append(path.read_bytes())
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(DataError, match=r"checkpoint .* cannot be written: No space left on device; the one before"):
        train(SMALL, out)
    assert checkpoint_path(out).read_bytes() == kept[0]
    assert [path.name for path in tmp_path.iterdir()] == ["policy.checkpoint.npz"]
    with pytest.raises(DataError, match="No space left on device; nothing was written"):
        train(SMALL, tmp_path / "other.npz")


def test_a_training_that_diverges_says_so_and_writes_no_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(training.SwingUp, "step", _reward_of_nothing)
    with pytest.raises(FaultError, match="training diverged: a weight is no longer finite"):
        train(SMALL, tmp_path / "policy.npz")
    assert not list(tmp_path.iterdir())


def test_ctrl_c_is_one_sentence(tmp_path, monkeypatch, capsys):
    def interrupted(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "train", interrupted)
    assert main(["--out", str(tmp_path / "policy.npz")]) == 130
    assert "interrupted: nothing was written" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "juggle"], "task is 'juggle'; expected one of swing_up, pendulum_v1"),
        (["--plant", "x5_9"], "is series elastic; expected a rigid one"),
        (["--delay", "0.5"], "delay is 0.5 s with a jitter of 0.001 s; expected two periods, 0.02 s, at most"),
        (["--jitter", "0.004"], "delay is 0.008 s with a jitter of 0.004 s; expected two periods"),
        (["--share", "1.5"], "share is 1.5; expected less than 1"),
        (["--hidden", "64", "0"], "hidden is 64 0; expected widths of 1 to 512"),
        (["--history", "0"], "history is 0; expected 1 to 50 samples"),
        (["--plant", "cart_pole", "--travel", "0"], "travel is 0.0; expected a finite number >= 0 (> 0 for times and"),
        (["--plant", "double_pendulum", "--share", "nan"], "share is nan; expected a finite number"),
        (
            ["--task", "pendulum_v1", "--plant", "thesis"],
            "--plant is given, but the task pendulum_v1 is Gymnasium's own",
        ),
        (["--task", "pendulum_v1", "--angle-noise", "0"], "--angle-noise is given, but the task pendulum_v1"),
        (["--period", "nan"], "period is nan; expected a finite number"),
    ],
)
def test_settings_that_cannot_be_trained_are_refused_in_a_sentence(tmp_path, capsys, arguments, message):
    assert main(["--out", str(tmp_path / "policy.npz"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_command_writes_policy_and_curves_and_does_not_overwrite(tmp_path, capsys):
    out = tmp_path / "policy.npz"
    command = ["--out", str(out), "--updates", "1", "--task", "pendulum_v1", "--hidden", "8", "8"]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert f"over {FEW_EPISODES} episodes" in told
    assert (tmp_path / "policy_training.png").stat().st_size > 1000
    assert load_policy(out).signals == ("cos", "sin", "velocity")
    assert main(command) == 2
    assert "exists; expected a new one" in capsys.readouterr().err


def _interrupt_at(update):
    def interrupt(done, _measured):
        if done == update:
            raise KeyboardInterrupt

    return interrupt


def _reward_of_nothing(self, actions):
    return np.full(self.count, np.nan, dtype=np.float32), np.zeros(self.count, dtype=np.bool_)
