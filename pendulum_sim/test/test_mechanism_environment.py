"""Gymnasium environments of plants of several joints: the library's own checks, the plant's own numbers, pictures."""

from __future__ import annotations

import dataclasses
import math
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism
from pendulum_sim.environments.mechanism_environment import IDS, MechanismEnv, MechanismVectorEnv
from pendulum_sim.pictures.mechanism_drawing import MechanismPicture
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_testing.joint_plants import without_friction


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_checks_pass_for_every_plant(name: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name, render_mode="rgb_array", screen_size=(120, 120)).unwrapped)
    # The action is an effort, not a number in [-1, 1], and speeds have no limit.
    told = [str(w.message) for w in caught if "WARN" in str(w.message)]
    assert [text for text in told if "infinity" not in text and "symmetric and normalized" not in text] == []


@pytest.mark.parametrize("name", IDS)
def test_a_vector_of_them_moves_as_the_single_ones_do(name: str) -> None:
    # Of plants without friction all in one step of arrays, of others one after another.
    for plant in (load_mechanism(IDS[name]), without_friction(load_mechanism(IDS[name]))):
        seeds = [3, 4, 5]
        vector = gymnasium.make_vec(
            name, num_envs=3, vectorization_mode="vector_entry_point", plant=plant, start="random", disturbance=0.01
        )
        singles = [MechanismEnv(plant, start="random", disturbance=0.01) for _ in seeds]
        observations, _ = vector.reset(seed=seeds)
        np.testing.assert_array_equal(
            observations, [env.reset(seed=seed)[0] for env, seed in zip(singles, seeds, strict=True)]
        )
        vector.action_space.seed(1)
        for _ in range(20):
            actions = vector.action_space.sample()
            results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
            observations, rewards, *_ = vector.step(actions)
            np.testing.assert_allclose(observations, [result[0] for result in results], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(rewards, [result[1] for result in results], rtol=1e-9)


def test_a_plant_without_a_new_seed_goes_on_drawing_from_its_own() -> None:
    vector = MechanismVectorEnv(2, plant="furuta", start="random")
    vector.reset(seed=[3, 4])
    observations, _ = vector.reset(seed=[3, None])
    singles = [MechanismEnv("furuta", start="random") for _ in range(2)]
    for env, seed in zip(singles, (3, 4), strict=True):
        env.reset(seed=seed)
    np.testing.assert_array_equal(observations, [singles[0].reset(seed=3)[0], singles[1].reset()[0]])


def test_an_environment_is_the_plant_with_its_noise_clamped() -> None:
    env = MechanismEnv("pendubot", disturbance=0.0)
    x, _ = env.reset(seed=1, options={"state": [0.1, -0.2, 0.3, 0.4]})
    np.testing.assert_allclose(x, [0.1, -0.2, 0.3, 0.4], atol=1e-12)
    plant = MechanismPlant(load_mechanism("pendubot"), 2e-3)
    plant.reset((0.1 + math.pi, -0.2), (0.3, 0.4))
    for _ in range(10):
        x, reward, terminated, truncated, _ = env.step(np.array([100.0], dtype=np.float32))
        state = plant.step((6.0,))
    np.testing.assert_allclose(x, [*plant.parameters.coordinates.deviation(state.position), *state.velocity], atol=1e-9)
    assert reward < 0.0
    assert not terminated
    assert not truncated


def test_episodes_end_after_their_time_and_start_again_with_the_next_step() -> None:
    vector = MechanismVectorEnv(2, plant="furuta", episode_time=0.01, start="bottom")
    vector.reset(seed=0)
    action = np.full((2, 1), 0.05)
    flags = [vector.step(action)[3].all() for _ in range(5)]
    assert flags == [False] * 4 + [True]
    x, rewards, *_ = vector.step(action)
    np.testing.assert_array_equal(x[:, 2:], 0.0)
    assert (rewards == 0.0).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": "side"}, "start is 'side'; expected one of bottom, top, random"),
        ({"q": (1.0, 1.0)}, r"q is \(1.0, 1.0\); expected 4 finite numbers"),
        ({"disturbance": -1.0}, "disturbance is -1.0 N m or N; expected a finite number >= 0"),
        ({"episode_time": 0.0}, "episode_time is 0.0 s; expected > 0"),
        ({"render_mode": "ascii"}, "render_mode is 'ascii'; expected None"),
    ],
)
def test_arguments_that_make_no_environment_are_refused(arguments: dict, message: str) -> None:
    for kind in (MechanismEnv, MechanismVectorEnv):
        with pytest.raises(ParameterError, match=message):
            kind(**arguments)


@pytest.mark.parametrize("stops", [(-1.0, 0.5), (0.5, 1.0), (-4.0, -3.5), (None, -2.0), (4.0, None)])
@pytest.mark.parametrize("joint", ["cart_pole.cart", "cart_pole.pole"])
def test_random_starts_lie_between_the_stops_and_others_beyond_them_are_refused_at_once(
    joint: str, stops: tuple
) -> None:
    name, _, own = joint.partition(".")
    plant = load_mechanism(name)
    joints = [
        dataclasses.replace(each, lower_stop=stops[0], upper_stop=stops[1]) if known == own else each
        for known, each in zip(plant.coordinates.names, plant.joints, strict=True)
    ]
    plant = dataclasses.replace(plant, joints=tuple(joints))
    env = MechanismEnv(plant, start="random")
    for seed in range(20):
        env.reset(seed=seed)
    if stops != (-1.0, 0.5):
        with pytest.raises(ParameterError, match=f"initial {own} is 0.0 "):
            MechanismVectorEnv(2, plant=plant, start="bottom")


def test_actions_and_starts_of_another_shape_are_refused() -> None:
    env = MechanismEnv("double_pendulum")
    env.reset(seed=0)
    with pytest.raises(ParameterError, match=r"action has shape \(1,\); expected \(2,\)"):
        env.step(np.zeros(1))
    with pytest.raises(ParameterError, match=r"action is \[nan, 0.0\]; expected finite numbers"):
        env.step(np.array([math.nan, 0.0]))
    with pytest.raises(ParameterError, match=r"start state has shape \(2,\); expected 4 finite numbers"):
        env.reset(options={"state": [0.0, 0.0]})
    with pytest.raises(ParameterError, match="reset option 'at' is unknown; expected state or start"):
        env.reset(options={"at": 1})


@pytest.mark.parametrize("name", ["pendubot", "cart_pole", "furuta"])
def test_a_picture_shows_where_the_plant_is(name: str) -> None:
    plant = load_mechanism(name)
    picture = MechanismPicture(plant, (200, 200))
    seen = []
    for q in ((0.0, 0.0), plant.coordinates.goal):
        picture.draw(q)
        seen.append(picture.array())
    assert seen[0].shape == (200, 200, 3)
    red = [(image[:, :, 0].astype(int) - image[:, :, 2] > 80).nonzero()[0].mean() for image in seen]
    # The last link is red; upright it is in the upper half.
    assert red[1] < red[0]
    with pytest.raises(ParameterError, match="expected two numbers from 120 to 4096"):
        MechanismPicture(plant, (10, 10))
