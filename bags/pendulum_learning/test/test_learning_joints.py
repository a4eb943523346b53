"""Training for plants of several joints: against the simulator, what is drawn, what is judged, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pendulum_learning import training
from pendulum_learning.body import kicks_of, travel_of, velocity_scales
from pendulum_learning.environment import SwingUp
from pendulum_learning.evaluation import Trial, is_up, run_trial, trials_of
from pendulum_learning.ppo import PpoSettings
from pendulum_learning.task import SwingUpTask, ranges_of
from pendulum_learning.train_cli import main
from pendulum_learning.training import Training, checkpoint_path, train
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, write_plant
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.policies import random_policy

CART_POLE, DOUBLE = load_mechanism("cart_pole"), load_mechanism("double_pendulum")
QUIET = SwingUpTask(delay=0.0, jitter=0.0, angle_noise=0.0, velocity_noise=0.0, offset=0.0, kick=0.0, kick_rate=0.0)
SMALL = Training(
    plant=CART_POLE, ppo=PpoSettings(hidden=(8, 8), horizon=8, epochs=2, batches=2), environments=16, updates=11, seed=3
)


@pytest.mark.parametrize("plant", [CART_POLE, DOUBLE], ids=lambda plant: plant.name)
def test_several_joints_move_in_training_as_in_the_simulator_with_kicks_and_late_efforts(plant):
    delay, rng = 0.013, np.random.default_rng(1)
    joints = plant.coordinates.driven_names
    simulated = MechanismPlant(
        plant.with_values({f"{name}.transport_delay": delay for name in joints}), 0.01, substeps=20
    )
    ours = SwingUp(1, plant, {}, replace(QUIET, travel=1.0), np.random.default_rng(0))
    q, v = (0.1, 2.0), (0.3, -1.0)
    simulated.reset(q, v)
    ours.motion[0] = 0.0
    ours.motion[0, :4] = *(np.array(q) - plant.coordinates.goal), *v
    ours.effort[:], ours.delay[:] = 0.0, delay
    ours.step_limit[:] = math.inf
    ours._kick = lambda: None
    for _ in range(40):
        actions = rng.uniform(-1.0, 1.0, (1, len(joints))).astype(np.float32)
        ours.push[0] = rng.uniform(-0.5, 0.5, 2)
        ours.step(actions)
        efforts = tuple((actions[0].astype(float) * plant.effort_limits).tolist())
        state = simulated.step(efforts, tuple(ours.push[0]))
        assert ours.motion[0, :2] + plant.coordinates.goal == pytest.approx(state.position, abs=2e-5)
        assert ours.motion[0, 2:4] == pytest.approx(state.velocity, abs=2e-3)


def test_what_a_policy_of_several_joints_sees_in_training_is_what_it_sees_as_a_controller():
    env = SwingUp(1, CART_POLE, {}, QUIET, np.random.default_rng(2))
    env.motion[0] = 0.0
    env.motion[0, :4] = 0.1, 2.0 - math.pi, 0.2, 0.3
    env.effort[:] = 0.0
    env._samples[:] = np.tile(env._measure(slice(None)), 3)
    policy = random_policy(
        CART_POLE, seed=5, effort_rate=(400.0,), velocity_scale=tuple(env.scale), angle_box=tuple(env.reach)
    )
    rows, notice = run_trial(policy, Trial(CART_POLE, (0.1, 2.0), (0.2, 0.3), np.zeros((60, 2))), start_time=0.0)
    assert notice == ""
    for k in range(60):
        turned = env.motion[0, 1] - rows[1, k]
        assert math.remainder(turned, 2.0 * math.pi) == pytest.approx(0.0, abs=2e-3)
        assert env.motion[0, [0, 2, 3]] == pytest.approx(rows[[0, 2, 3], k], abs=2e-3)
        env.step(policy.network.forward(env.observe()[0]))
        assert env.effort[0] == pytest.approx(rows[4, k], abs=2e-2)


def test_plants_of_several_joints_are_drawn_from_the_ranges_and_are_plants():
    ranges = ranges_of(DOUBLE, 0.25, {"mass_1": [0.1, 0.6], "elbow.damping": [0.0, 0.01]})
    assert ranges["mass_1"] == (0.1, pytest.approx(0.6543, abs=1e-4))
    assert ranges["elbow.damping"] == (0.0, 0.01)
    assert "gravity" not in ranges
    assert not any("stop" in name or "effort_limit" in name for name in ranges)
    env = SwingUp(500, DOUBLE, ranges, SwingUpTask(), np.random.default_rng(0))
    names = [name for name in ranges if "." not in name]
    for name in names:
        low, high = ranges[name]
        drawn = env.parameters[:, env.body.columns[name]]
        assert low <= drawn.min() < drawn.max() <= high
    for row in env.parameters[::25]:
        own = {name: float(row[env.body.columns[name]]) for name in names}
        DOUBLE.with_values(own)
        assert own["inertia_2"] > own["mass_2"] * own["centre_2"] ** 2
    static = env.parameters[:, env.body.columns["elbow.static_friction"]]
    np.testing.assert_array_equal(static, env.parameters[:, env.body.columns["elbow.coulomb_friction"]])


def test_who_falls_or_leaves_its_travel_mostly_meets_the_same_plant_again_once_it_has_learned_to_swing_up():
    env = SwingUp(400, CART_POLE, ranges_of(CART_POLE, 0.25, {}), SwingUpTask(), np.random.default_rng(0))
    env.motion[:], env._astray[:] = 0.0, False
    up, down, gone = slice(0, 100), slice(100, 250), slice(250, 400)
    env.motion[down, 1] = -math.pi + 0.1
    env.motion[250, 0] = 0.45
    env.step(np.zeros((400, 1), dtype=np.float32))
    assert np.flatnonzero(env._astray).tolist() == [250]
    env._astray[gone] = True
    masses = env.parameters[:, env.body.columns["pole_mass"]]
    before, env.progress = masses.copy(), 0.6
    env.restart(np.ones(400, dtype=np.bool_))
    same = masses == before
    assert not same[up].any()
    for which in (down, gone):
        assert 0.6 < same[which].mean() < 0.9
    assert not env._astray.any()
    env.motion[:, 1], before, env.progress = -math.pi, masses.copy(), 0.59
    env.restart(np.ones(400, dtype=np.bool_))
    assert not (masses == before).any()


def test_with_a_motor_at_each_joint_every_episode_has_a_plant_of_its_own():
    env = SwingUp(50, DOUBLE, ranges_of(DOUBLE, 0.25, {}), SwingUpTask(), np.random.default_rng(0))
    env.motion[:, :2], env.progress = -math.pi, 1.0
    before = env.parameters[:, env.body.columns["mass_1"]].copy()
    env.restart(np.ones(50, dtype=np.bool_))
    assert not (env.parameters[:, env.body.columns["mass_1"]] == before).any()


def test_a_joint_that_slides_keeps_to_its_travel_and_to_the_plant_s_own_stops():
    assert travel_of(CART_POLE, 0.4) == (0.5, math.pi)
    assert travel_of(CART_POLE, 5.0) == (1.8, math.pi)
    aside = CART_POLE.with_values({"cart.lower_stop": -0.2})
    assert travel_of(aside, 0.4) == (0.2, math.pi)
    env = SwingUp(300, CART_POLE, {}, replace(SwingUpTask(), travel=0.2), np.random.default_rng(0))
    for _ in range(100):
        env.step(np.ones((300, 1), dtype=np.float32))
    assert np.abs(env.motion[:, 0]).max() == pytest.approx(0.25)
    assert env.motion[:, 0].max() == pytest.approx(0.25)


def test_at_an_end_of_the_travel_or_spinning_there_is_less_reward_than_at_rest_upright():
    env = SwingUp(5, CART_POLE, {}, QUIET, np.random.default_rng(0))
    env.motion[:] = 0.0
    env.motion[1, 0] = 0.45
    env.motion[2, 1] = math.pi
    env.motion[3, 3] = 12.0
    env.motion[4, 1], env.motion[4, 3] = math.pi, 2.0 * math.sqrt(0.1 * 9.81 * 0.5 * 30.0)
    rewards = env._reward(np.zeros((5, 1)))
    assert rewards[0] == pytest.approx(1.5)
    # Hanging at the speed with which it falls from upright, it has all of the energy that it needs.
    assert rewards[2] == pytest.approx(-1.0, abs=0.01)
    assert rewards[4] == pytest.approx(-0.5, abs=0.01)
    assert rewards[1] < 0.5
    assert rewards[3] < 0.5
    double = SwingUp(1, DOUBLE, {}, QUIET, np.random.default_rng(0))
    double.motion[:] = 0.0
    assert double._reward(np.zeros((1, 2))) == pytest.approx([0.5 + 2.0])


def test_what_slides_pays_by_the_square_then_for_the_outer_part_of_its_way_and_most_near_its_end_the_later_the_more():
    env = SwingUp(5, CART_POLE, {}, QUIET, np.random.default_rng(0))
    env.motion[:] = 0.0
    # Of the half metre to the stop, on either side.
    slid = np.array([0.0, 0.2, -0.6, 0.74, -1.0])
    env.motion[:, 0] = 0.5 * slid
    for progress, most in ((0.0, 2.0), (1.0 / 3.0, 2.0), (0.5, 3.5), (2.0 / 3.0, 5.0), (1.0, 5.0)):
        env.progress = progress
        paid = 0.5 + np.exp(-((slid / 0.5) ** 2)) - env._reward(np.zeros((5, 1)))
        assert paid == pytest.approx(
            [0.0, 0.1 * 0.04, 0.1 * 0.36 + 5.0 * 0.05, 0.1 * 0.74**2 + 5.0 * 0.19 + most, 0.1 + 5.0 * 0.45 + most]
        )


def test_a_training_tells_its_environment_how_far_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "TRIALS", 1)
    told = []

    class Watched(SwingUp):
        def observe(self):
            told.append(self.progress)
            return super().observe()

    monkeypatch.setattr(training, "SwingUp", Watched)
    train(replace(SMALL, updates=4), tmp_path / "policy.npz")
    assert sorted(set(told)) == [0.0, 0.25, 0.5, 0.75]


def test_scales_and_kicks_of_joints_without_a_motor_are_those_of_gravity():
    scales = velocity_scales(CART_POLE, 0.4)
    assert scales == pytest.approx((math.sqrt(0.5 * 10.0 * 0.4 / 1.1), math.sqrt(0.1 * 9.81 * 0.5 * 30.0)))
    np.testing.assert_allclose(kicks_of(CART_POLE), [10.0, 0.1 * 9.81 * 0.5], rtol=1e-5)


def test_a_trial_is_up_where_the_pole_is_and_the_cart_never_left_its_travel():
    policy = random_policy(CART_POLE)
    trial = Trial(CART_POLE, (0.0, 0.0), (0.0, 0.0), np.zeros((3, 2)), travel=0.4)
    rows = np.zeros((5, 3))
    rows[1] = 0.5, 0.2, -0.2
    assert is_up(policy, trial, rows).tolist() == [False, True, True]
    rows[0, 0] = -0.41
    assert not is_up(policy, trial, rows).any()


def test_trials_start_anywhere_within_the_travel_with_plants_and_delays_of_their_own():
    policy = random_policy(CART_POLE, ranges=ranges_of(CART_POLE, 0.25, {}))
    trials = trials_of(policy, SwingUpTask(), 50, 1, duration=2.0)
    starts = np.array([trial.position for trial in trials])
    assert 0.25 < np.abs(starts[:, 0]).max() < 0.4
    assert np.abs(starts[:, 1]).max() > 2.8
    assert len({trial.plant.value("pole_mass") for trial in trials}) == 50
    delays = [trial.plant.value("cart.transport_delay") for trial in trials]
    assert 0.0 <= min(delays) < 0.001
    assert 0.007 < max(delays) <= 0.008
    assert all(np.abs(trial.kicks).max(axis=0)[1] <= 0.7 * 0.4906 for trial in trials)


def test_one_seed_is_one_file_for_several_joints_also_when_it_was_interrupted(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "TRIALS", 3)

    def interrupt(done, _measured):
        if done == 11:
            raise KeyboardInterrupt

    whole, parts = tmp_path / "whole.npz", tmp_path / "parts.npz"
    train(SMALL, whole)
    with pytest.raises(KeyboardInterrupt):
        train(SMALL, parts, on_update=interrupt)
    assert checkpoint_path(parts).exists()
    train(SMALL, parts)
    assert parts.read_bytes() == whole.read_bytes()
    policy = load_policy(parts)
    assert policy.signals == ("cos", "sin", "position", "velocity", "effort")
    assert policy.angle_box == (0.5, math.pi)
    assert policy.provenance["training"]["swing_up"]["travel"] == 0.4


def test_a_plant_that_cannot_be_trained_is_refused_in_a_sentence(tmp_path, capsys):
    late = write_plant(tmp_path / "late.yaml", CART_POLE.with_values({"cart.transport_delay": 0.004}))
    loose = load_mechanism("cart_pole")
    loose = replace(loose, joints=(replace(loose.joints[0], actuator=None), loose.joints[1]))
    free = write_plant(tmp_path / "free.yaml", loose)
    for plant, told in (
        (late, "transport_delay of plant 'cart_pole' is 0.004 s; expected none in the plant: a training draws delays"),
        (free, "plant 'cart_pole' has no driven joint; expected an actuator at one of them"),
    ):
        assert main(["--plant", str(plant), "--out", str(tmp_path / "policy.npz")]) == 2
        assert told in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "policy.npz").exists()
