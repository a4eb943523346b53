"""The Gymnasium environments: the library's own checks, the plant's own numbers, and pictures."""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.environments.environment import ENVIRONMENT_ID, PendulumEnv
from pendulum_sim.environments.vector_environment import PendulumVectorEnv
from pendulum_sim.pictures import drawing
from pendulum_sim.stepping.plant import RigidPlant

THESIS_GAIN = np.array([33.345265, 0.158993])


@pytest.mark.parametrize("kwargs", [{}, {"plant": "x5_9"}, {"plant": "dfki", "start": "random"}])
def test_gymnasium_checks_pass_for_every_plant(kwargs: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # they draw a window, too
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(ENVIRONMENT_ID, **kwargs).unwrapped)
    # The action is a torque in N m, not a number in [-1, 1]; an elastic drive or no friction has no speed limit.
    told = [str(w.message) for w in caught if "WARN" in str(w.message)]
    assert [text for text in told if "infinity" not in text and "symmetric and normalized" not in text] == []


@pytest.mark.parametrize("dt", [2e-3, 5e-3, 0.01])
@pytest.mark.parametrize("plant", ["thesis", "x5_9"])
def test_it_registers_with_module_syntax_and_truncates_after_five_seconds_at_any_step(plant: str, dt: float) -> None:
    env = gymnasium.make(f"pendulum_sim.environments.environment:{ENVIRONMENT_ID}", dt=dt, plant=plant)
    action = np.zeros(1, dtype=np.float32)
    for _ in range(2):
        env.reset(seed=0)
        flags = [env.step(action)[2:4] for _ in range(round(5.0 / dt))]
        assert flags[-1] == (False, True)
        assert not any(truncated for _, truncated in flags[:-1])


def test_who_asks_for_another_length_gets_it() -> None:
    def length(env: gymnasium.Env) -> int:
        env.reset(seed=0)
        steps = (k for k in range(1, 700) if env.step(np.zeros(1, dtype=np.float32))[3])
        return next(steps, 0)

    assert length(gymnasium.make(ENVIRONMENT_ID, max_episode_steps=100)) == 100
    assert length(gymnasium.make(ENVIRONMENT_ID, episode_time=6.0, dt=0.01)) == 600
    assert length(PendulumEnv(dt=0.01, episode_time=0.3)) == 30
    assert length(PendulumEnv(dt=0.01, episode_time=math.inf)) == 0
    vector = gymnasium.make_vec(ENVIRONMENT_ID, num_envs=2, vectorization_mode="vector_entry_point", dt=0.01)
    vector.reset(seed=0)
    truncated = [vector.step(np.zeros((2, 1)))[3].all() for _ in range(500)]
    assert truncated == [False] * 499 + [True]


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
        expected_reward = -(100.0 * (state.theta - math.pi) ** 2 + 0.01 * state.theta_dot**2 + 0.1 * action[0] ** 2)
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
    assert isinstance(vector.unwrapped, PendulumVectorEnv)
    assert vector.action_space.shape == (4, 1)


def test_a_mask_starts_those_it_names_and_leaves_the_others_where_they_are() -> None:
    vector = PendulumVectorEnv(4, start="random")
    vector.reset(seed=1)
    for _ in range(30):
        before, *_ = vector.step(np.full((4, 1), 0.5))
    mask = np.array([True, False, False, True])
    x, _ = vector.reset(options={"reset_mask": mask, "state": [0.1, -0.2]})
    assert x[mask] == pytest.approx(np.array([[0.1, -0.2]] * 2))
    assert np.array_equal(x[~mask], before[~mask])
    x, _ = vector.reset(options={"reset_mask": ~mask, "start": "bottom"})
    assert x[~mask].tolist() == [[-math.pi, 0.0]] * 2
    assert x[mask] == pytest.approx(np.array([[0.1, -0.2]] * 2))


def test_a_list_of_seeds_gives_each_pendulum_its_own_episode() -> None:
    seeds = [5, 6, 5]
    vector = PendulumVectorEnv(3, start="random", disturbance=2.0, max_episode_steps=15)
    x, _ = vector.reset(seed=seeds)
    singles = [PendulumEnv(start="random", disturbance=2.0) for _ in seeds]
    for row, env, seed in zip(x, singles, seeds, strict=True):
        assert row == pytest.approx(env.reset(seed=seed)[0], abs=0.0)
    for _ in range(15):
        x, *_ = vector.step(np.full((3, 1), 0.3))
        rows = np.array([env.step(np.array([0.3], dtype=np.float32))[0] for env in singles])
        assert x == pytest.approx(rows, abs=1e-8)
    assert np.array_equal(x[0], x[2])
    assert not np.array_equal(x[0], x[1])
    # The episodes after it go on from each pendulum's own generator.
    x, *_ = vector.step(np.zeros((3, 1)))
    assert np.array_equal(x[0], x[2])
    assert x[1] == pytest.approx(singles[1].reset()[0], abs=0.0)


@pytest.mark.parametrize(
    ("seed", "options", "message"),
    [
        (None, {"strat": "top"}, "reset option 'strat' is unknown; expected state, start or reset_mask"),
        (None, {"start": "left"}, "start is 'left'; expected one of bottom, top, random"),
        (None, {"state": [1.0]}, r"start state has shape \(1,\)"),
        (None, {"state": [math.nan, 0.0]}, "expected finite numbers"),
        (None, {"reset_mask": [True]}, r"reset_mask has shape \(1,\) of bool; expected \(3,\) of bool"),
        (None, {"reset_mask": [0, 1, 2]}, r"expected \(3,\) of bool"),
        ([1, 2], None, "seed has 2 entries; expected one for each of 3 plants"),
    ],
)
def test_a_reset_of_many_refuses_what_it_would_not_heed(seed: object, options: dict | None, message: str) -> None:
    vector = PendulumVectorEnv(3)
    with pytest.raises(ParameterError, match=message):
        vector.reset(seed=seed, options=options)  # type: ignore[arg-type]


def test_an_action_of_another_shape_is_refused_and_reads_nothing_beyond_it() -> None:
    for plant in ("thesis", "x5_9"):
        env = PendulumEnv(plant)
        env.reset(seed=0)
        for action in (np.empty(0, dtype=np.float32), np.zeros(2, dtype=np.float32)):
            with pytest.raises(ParameterError, match=r"action has shape \(\d,\); expected \(1,\)"):
                env.step(action)
        # One number is one torque, in whatever brackets.
        env.step(np.array(0.5))
        env.step(np.array([[0.5]]))
    vector = PendulumVectorEnv(3)
    vector.reset(seed=0)
    with pytest.raises(ParameterError, match=r"actions have shape \(2, 1\); expected \(3, 1\)"):
        vector.step(np.zeros((2, 1)))


@pytest.mark.parametrize("kind", [PendulumEnv, PendulumVectorEnv])
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"q": (1.0,)}, r"q is \(1.0,\); expected two finite numbers"),
        ({"q": (1.0, 2.0, 3.0)}, "expected two finite numbers"),
        ({"q": (1.0, math.nan)}, "expected two finite numbers"),
        ({"r": math.inf}, "r is inf; expected a finite number >= 0"),
        ({"r": -0.1}, "r is -0.1; expected a finite number >= 0"),
        ({"q": (1.0, -1.0)}, r"q is \(1.0, -1.0\); expected two finite numbers >= 0"),
        ({"episode_time": 0.0}, "episode_time is 0.0 s; expected > 0"),
        ({"episode_time": math.nan}, "episode_time is nan s; expected > 0"),
    ],
)
def test_weights_and_lengths_that_are_none_are_refused(kind: type, kwargs: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        kind(**kwargs)


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


@pytest.mark.parametrize(("dt", "pictures"), [(2e-3, 10), (0.02, 100), (0.1, 100)])
def test_a_window_follows_real_time_with_at_most_50_pictures_a_second(
    monkeypatch: pytest.MonkeyPatch, dt: float, pictures: int
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    drawn: list[tuple[float, float]] = []
    shown: list[tuple[float, float, int]] = []
    draw, show = drawing.PendulumPicture.draw, drawing.Window.show

    def note(picture: drawing.PendulumPicture, theta: float, *rest: float, **more: Any) -> None:
        drawn.append((theta, more["time"]))
        draw(picture, theta, *rest, **more)

    def watch(window: drawing.Window, picture: drawing.PendulumPicture, *, fps: int) -> None:
        shown.append((*drawn[-1], fps))
        show(window, picture)

    monkeypatch.setattr(drawing.PendulumPicture, "draw", note)
    monkeypatch.setattr(drawing.Window, "show", watch)
    env = PendulumEnv(render_mode="human", screen_size=(200, 200), dt=dt, episode_time=math.inf)
    env.reset(seed=0)
    for _ in range(100):
        env.step(np.array([1.0], dtype=np.float32))
    assert pygame.display.get_surface().get_size() == (200, 200)
    env.close()
    assert not pygame.display.get_init()
    # The first is that of the reset; then one for each 20 ms, or for each step where steps are longer.
    assert len(shown) == 1 + pictures
    for (theta, time, fps), (later_theta, later, _) in itertools.pairwise(shown):
        assert later - time == pytest.approx(1.0 / fps)
        assert later_theta != theta


def test_a_video_of_a_frame_each_step_runs_in_real_time() -> None:
    for dt in (2e-3, 0.01, 0.05):
        assert PendulumEnv(dt=dt).metadata["render_fps"] == round(1.0 / dt)
    assert PendulumEnv.metadata["render_fps"] == 500


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
