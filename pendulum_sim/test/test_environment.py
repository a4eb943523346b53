"""The Gymnasium environments: the library's own checks, the plant's own numbers, and pictures."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.environment import ENVIRONMENT_ID, PendulumEnv
from pendulum_sim.plant import RigidPlant
from pendulum_sim.vector_environment import PendulumVectorEnv

THESIS_GAIN = np.array([33.345265, 0.158993])


@pytest.mark.parametrize("kwargs", [{}, {"plant": "x5_9"}, {"plant": "dfki", "start": "random"}])
def test_gymnasium_checks_pass_for_every_plant(kwargs: dict) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(ENVIRONMENT_ID, **kwargs).unwrapped)
    # The action is a torque in N m, not a number in [-1, 1]; an elastic drive or no friction has no speed limit.
    told = [str(w.message) for w in caught if "WARN" in str(w.message)]
    assert [text for text in told if "infinity" not in text and "symmetric and normalized" not in text] == []


def test_it_registers_with_module_syntax_and_truncates_after_five_seconds() -> None:
    env = gymnasium.make(f"pendulum_sim.environment:{ENVIRONMENT_ID}")
    env.reset(seed=0)
    action = np.zeros(1, dtype=np.float32)
    flags = [env.step(action)[2:4] for _ in range(2500)]
    assert flags[-1] == (False, True)
    assert not any(truncated for _, truncated in flags[:-1])


def test_observations_are_those_of_the_plant_in_the_controllers_convention() -> None:
    env = PendulumEnv(disturbance=2.5, hold=5)
    x, _ = env.reset(seed=11, options={"state": [0.2, -0.1]})
    twin = RigidPlant(load_plant("thesis"), 2e-3)
    state = twin.reset(math.pi + 0.2, -0.1)
    key = int(env._keys[0])
    for k in range(500):
        u = float(-THESIS_GAIN @ x)
        disturbance = 2.5 * noise.unit_interval(noise.scramble(key, k // 5))
        action = np.array([u])
        x, reward, terminated, truncated, _ = env.step(action)
        expected_reward = -(
            100.0 * (state.theta - math.pi) ** 2 + 0.01 * state.theta_dot**2 + 0.1 * action[0] ** 2
        )
        assert reward == pytest.approx(expected_reward, abs=1e-12)
        state = twin.step(u + disturbance)
        assert x == pytest.approx([state.theta - math.pi, state.theta_dot], abs=1e-12)
        assert not terminated
        assert not truncated


def test_one_seed_gives_one_episode_and_another_seed_another() -> None:
    def run(seed: int) -> np.ndarray:
        env = PendulumEnv(start="random", disturbance=1.0)
        rows = [env.reset(seed=seed)[0]]
        rows += [env.step(np.array([0.1], dtype=np.float32))[0] for _ in range(50)]
        return np.array(rows)

    assert np.array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


@pytest.mark.parametrize(("start", "angle"), [("top", 0.0), ("bottom", -math.pi)])
def test_it_starts_where_it_is_told(start: str, angle: float) -> None:
    x, _ = PendulumEnv().reset(seed=0, options={"start": start})
    assert x.tolist() == [angle, 0.0]


def test_other_plants_go_through_the_full_model() -> None:
    env = PendulumEnv("x5_9", start="bottom")
    env.reset(seed=0)
    for _ in range(200):
        x, *_ = env.step(np.array([0.15], dtype=np.float32))
    # 0.15 N m is below what the motor's friction holds.
    assert abs(x[0] + math.pi) < 1e-6


def test_the_vector_environment_equals_single_ones_and_restarts_by_itself() -> None:
    vector = PendulumVectorEnv(300, start="random", max_episode_steps=20)
    x, _ = vector.reset(seed=3)
    singles = []
    for row in x[:3]:
        env = PendulumEnv()
        env.reset(options={"state": row})
        singles.append(env)
    actions = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 300, 1)).astype(np.float32)
    for k in range(20):
        x, rewards, terminated, truncated, _ = vector.step(actions[k])
        assert x.shape == (300, 2)
        assert not terminated.any()
        assert truncated.all() == (k == 19)
        for i, env in enumerate(singles):
            single, reward, *_ = env.step(actions[k, i])
            assert x[i] == pytest.approx(single, abs=1e-12)
            assert rewards[i] == pytest.approx(reward, abs=1e-12)
    before = x
    x, rewards, _, truncated, _ = vector.step(actions[0])
    assert not np.array_equal(x, before)
    assert not rewards.any()
    assert not truncated.any()


def test_make_vec_gives_the_compiled_vector_environment() -> None:
    vector = gymnasium.make_vec(ENVIRONMENT_ID, num_envs=4, vectorization_mode="vector_entry_point")
    x, _ = vector.reset(seed=1, options={"reset_mask": np.ones(4, dtype=bool)})
    assert x.shape == (4, 2)
    assert vector.action_space.shape == (4, 1)


def test_pictures_have_the_size_asked_for_and_show_the_angle() -> None:
    env = PendulumEnv(render_mode="rgb_array", screen_size=(320, 240))
    env.reset(options={"state": [0.0, 0.0]})
    up = env.render()
    env.reset(options={"state": [-math.pi, 0.0]})
    down = env.render()
    assert up is not None
    assert down is not None
    assert up.shape == down.shape == (240, 320, 3)
    red = np.array([208, 84, 58])

    def height_of_bob(picture: np.ndarray) -> float:
        return float(np.argwhere(np.abs(picture.astype(int) - red).sum(axis=2) < 12)[:, 0].mean())

    assert height_of_bob(up) < 100
    assert height_of_bob(down) > 140
    env.close()


def test_a_window_can_be_opened_on_a_virtual_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = PendulumEnv(render_mode="human", screen_size=(200, 200))
    env.reset(seed=0)
    env.step(np.array([1.0], dtype=np.float32))
    env.close()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"start": "left"}, "start is 'left'; expected one of bottom, top, random"),
        ({"dt": -1.0}, "dt is -1.0 s; expected a finite number > 0"),
        ({"disturbance": -2.0}, "disturbance is -2.0 N m; expected a finite number >= 0"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi'; expected None, human or rgb_array"),
        ({"method": "heun"}, "method is 'heun'; expected one of"),
        ({"hold": 0}, "hold is 0 steps; expected >= 1"),
    ],
)
def test_arguments_outside_their_domain_are_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        PendulumEnv(**kwargs)


def test_an_action_that_is_not_finite_is_refused() -> None:
    env = PendulumEnv()
    env.reset(seed=0)
    for bad in (math.nan, math.inf):
        with pytest.raises(ParameterError, match="expected a finite number"):
            env.step(np.array([bad], dtype=np.float32))
    vector = PendulumVectorEnv(3)
    vector.reset(seed=0)
    with pytest.raises(ParameterError, match="action 1 is not a finite number of N m"):
        vector.step(np.array([[0.0], [math.nan], [0.0]], dtype=np.float32))


def test_the_vector_environment_says_which_plants_it_takes() -> None:
    with pytest.raises(ParameterError, match="plant 'x5_9' has dry friction, lag, delay or a drivetrain"):
        PendulumVectorEnv(2, plant="x5_9")
