"""The Gymnasium environments: the library's own checks, the plant's own numbers, and pictures."""

from __future__ import annotations

import dataclasses
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
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_sim.environments.environment import IDS, PlantEnv, PlantVectorEnv
from pendulum_sim.pictures import drawing
from pendulum_sim.pictures.plant_picture import PlantPicture
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_testing.joint_plants import without_friction

PENDULUM = "PendulumX59-v0"
MECHANISMS = [name for name in IDS if name != PENDULUM]
THESIS_GAIN = np.array([33.345265, 0.158993])


@pytest.mark.parametrize(
    ("name", "kwargs"),
    [(PENDULUM, {}), (PENDULUM, {"plant": "x5_9"}), (PENDULUM, {"plant": "dfki", "start": "random"})]
    + [(name, {"render_mode": "rgb_array", "screen_size": (120, 120)}) for name in MECHANISMS],
)
def test_gymnasium_checks_pass_for_every_plant(name: str, kwargs: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # they draw a window, too
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name, **kwargs).unwrapped)
    # The action is a torque in N m, not a number in [-1, 1]; an elastic drive or no friction has no speed limit.
    told = [str(w.message) for w in caught if "WARN" in str(w.message)]
    assert [text for text in told if "infinity" not in text and "symmetric and normalized" not in text] == []


@pytest.mark.parametrize("dt", [2e-3, 5e-3, 0.01])
@pytest.mark.parametrize("plant", ["thesis", "x5_9"])
def test_it_registers_with_module_syntax_and_truncates_after_five_seconds_at_any_step(plant: str, dt: float) -> None:
    env = gymnasium.make(f"pendulum_sim.environments.environment:{PENDULUM}", dt=dt, plant=plant)
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

    assert length(gymnasium.make(PENDULUM, max_episode_steps=100)) == 100
    assert length(gymnasium.make(PENDULUM, episode_time=6.0, dt=0.01)) == 600
    assert length(PlantEnv(dt=0.01, episode_time=0.3)) == 30
    assert length(PlantEnv(dt=0.01, episode_time=math.inf)) == 0
    vector = gymnasium.make_vec(PENDULUM, num_envs=2, vectorization_mode="vector_entry_point", dt=0.01)
    vector.reset(seed=0)
    truncated = [vector.step(np.zeros((2, 1)))[3].all() for _ in range(500)]
    assert truncated == [False] * 499 + [True]


def test_observations_are_those_of_the_plant_in_the_controllers_convention() -> None:
    env = PlantEnv(disturbance=2.5, hold=5)
    x, _ = env.reset(seed=11, options={"state": [0.2, -0.1]})
    twin = RigidPlant(load_plant("thesis"), 2e-3)
    state = twin.reset(math.pi + 0.2, -0.1)
    key = int(env._motion.keys[0, 0])
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
        env = PlantEnv(start="random", disturbance=1.0)
        rows = [env.reset(seed=seed)[0]]
        rows += [env.step(np.array([0.1], dtype=np.float32))[0] for _ in range(50)]
        return np.array(rows)

    assert np.array_equal(run(5), run(5))
    assert not np.array_equal(run(5), run(6))


@pytest.mark.parametrize(("start", "angle"), [("top", 0.0), ("bottom", -math.pi)])
def test_it_starts_at_the_given_place(start: str, angle: float) -> None:
    x, _ = PlantEnv().reset(seed=0, options={"start": start})
    assert x.tolist() == [angle, 0.0]


def test_other_plants_go_through_the_full_model() -> None:
    env = PlantEnv("x5_9", start="bottom")
    env.reset(seed=0)
    for _ in range(200):
        x, *_ = env.step(np.array([0.15], dtype=np.float32))
    # 0.15 N m is below what the motor's friction holds.
    assert abs(x[0] + math.pi) < 1e-6


def test_the_vector_environment_equals_single_ones_and_restarts_by_itself() -> None:
    vector = PlantVectorEnv(300, start="random", max_episode_steps=20)
    x, _ = vector.reset(seed=3)
    singles = []
    for row in x[:3]:
        env = PlantEnv()
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
    vector = gymnasium.make_vec(PENDULUM, num_envs=4, vectorization_mode="vector_entry_point")
    assert isinstance(vector.unwrapped, PlantVectorEnv)
    assert vector.action_space.shape == (4, 1)


def test_a_mask_starts_those_it_names_and_leaves_the_others_where_they_are() -> None:
    vector = PlantVectorEnv(4, start="random")
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
    vector = PlantVectorEnv(3, start="random", disturbance=2.0, max_episode_steps=15)
    x, _ = vector.reset(seed=seeds)
    singles = [PlantEnv(start="random", disturbance=2.0) for _ in seeds]
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
        (None, {"state": [math.nan, 0.0]}, "expected 2 finite numbers, or 3 rows of them"),
        (None, {"reset_mask": [True]}, r"reset_mask has shape \(1,\) of bool; expected \(3,\) of bool"),
        (None, {"reset_mask": [0, 1, 2]}, r"expected \(3,\) of bool"),
        ([1, 2], None, "seed has 2 entries; expected one for each of 3 plants"),
    ],
)
def test_a_reset_of_many_refuses_what_it_would_not_heed(seed: object, options: dict | None, message: str) -> None:
    vector = PlantVectorEnv(3)
    with pytest.raises(ParameterError, match=message):
        vector.reset(seed=seed, options=options)  # type: ignore[arg-type]


def test_an_action_of_another_shape_is_refused_and_reads_nothing_beyond_it() -> None:
    for plant in ("thesis", "x5_9"):
        env = PlantEnv(plant)
        env.reset(seed=0)
        for action in (np.empty(0, dtype=np.float32), np.zeros(2, dtype=np.float32)):
            with pytest.raises(ParameterError, match=r"action has shape \(\d,\); expected \(1,\)"):
                env.step(action)
        # One number is one torque, in whatever brackets.
        env.step(np.array(0.5))
        env.step(np.array([[0.5]]))
    vector = PlantVectorEnv(3)
    vector.reset(seed=0)
    with pytest.raises(ParameterError, match=r"actions have shape \(2, 1\); expected \(3, 1\)"):
        vector.step(np.zeros((2, 1)))


@pytest.mark.parametrize("kind", [PlantEnv, PlantVectorEnv])
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"q": (1.0,)}, r"q is \(1.0,\); expected 2 finite numbers"),
        ({"q": (1.0, 2.0, 3.0)}, "expected 2 finite numbers"),
        ({"q": (1.0, math.nan)}, "expected 2 finite numbers"),
        ({"r": math.inf}, "r is inf; expected a finite number >= 0"),
        ({"r": -0.1}, "r is -0.1; expected a finite number >= 0"),
        ({"q": (1.0, -1.0)}, r"q is \(1.0, -1.0\); expected 2 finite numbers >= 0"),
        ({"episode_time": 0.0}, "episode_time is 0.0 s; expected > 0"),
        ({"episode_time": math.nan}, "episode_time is nan s; expected > 0"),
    ],
)
def test_weights_and_lengths_that_are_none_are_refused(kind: type, kwargs: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        kind(**kwargs)


def test_pictures_have_the_size_asked_for_and_show_the_angle() -> None:
    env = PlantEnv(render_mode="rgb_array", screen_size=(320, 240))
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
    draw, show = PlantPicture.draw, drawing.Window.show

    def note(picture: PlantPicture, position: Vector, **more: Any) -> None:
        drawn.append((position[0], more["time"]))
        draw(picture, position, **more)

    def watch(window: drawing.Window, picture: PlantPicture, *, fps: int) -> None:
        shown.append((*drawn[-1], fps))
        show(window, picture)

    monkeypatch.setattr(PlantPicture, "draw", note)
    monkeypatch.setattr(drawing.Window, "show", watch)
    env = PlantEnv(render_mode="human", screen_size=(200, 200), dt=dt, episode_time=math.inf)
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
        assert PlantEnv(dt=dt).metadata["render_fps"] == round(1.0 / dt)
    assert PlantEnv.metadata["render_fps"] == 500


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
        PlantEnv(**kwargs)


def test_an_action_that_is_not_finite_is_refused() -> None:
    env = PlantEnv()
    env.reset(seed=0)
    for bad in (math.nan, math.inf):
        with pytest.raises(ParameterError, match="expected finite numbers"):
            env.step(np.array([bad], dtype=np.float32))
    vector = PlantVectorEnv(3)
    vector.reset(seed=0)
    with pytest.raises(ParameterError, match="action 1 is not a finite number of N m"):
        vector.step(np.array([[0.0], [math.nan], [0.0]], dtype=np.float32))


@pytest.mark.parametrize("name", IDS)
def test_a_vector_of_them_moves_as_the_single_ones_do(name: str) -> None:
    # Without friction all in one step, of arrays or compiled; with it one after another.
    for plant in (load_mechanism(IDS[name]["plant"]), without_friction(load_mechanism(IDS[name]["plant"]))):
        seeds = [3, 4, 5]
        vector = gymnasium.make_vec(
            name, num_envs=3, vectorization_mode="vector_entry_point", plant=plant, start="random", disturbance=0.01
        )
        singles = [PlantEnv(plant, start="random", disturbance=0.01) for _ in seeds]
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
    vector = PlantVectorEnv(2, plant="furuta", start="random")
    vector.reset(seed=[3, 4])
    observations, _ = vector.reset(seed=[3, None])
    singles = [PlantEnv("furuta", start="random") for _ in range(2)]
    for env, seed in zip(singles, (3, 4), strict=True):
        env.reset(seed=seed)
    np.testing.assert_array_equal(observations, [singles[0].reset(seed=3)[0], singles[1].reset()[0]])


def test_an_environment_is_the_plant_with_its_noise_clamped() -> None:
    env = PlantEnv("pendubot", disturbance=0.5, hold=3)
    x, _ = env.reset(seed=1, options={"state": [0.1, -0.2, 0.3, 0.4]})
    np.testing.assert_allclose(x, [0.1, -0.2, 0.3, 0.4], atol=1e-12)
    plant = MechanismPlant(load_mechanism("pendubot"), 2e-3)
    plant.reset((0.1 + math.pi, -0.2), (0.3, 0.4))
    (key,) = env._motion._keys
    q, r = plant.parameters.mechanism.weights
    for k in range(10):
        before = x
        x, reward, terminated, truncated, _ = env.step(np.array([100.0], dtype=np.float32))
        state = plant.step((6.0 + 0.5 * noise.unit_interval(noise.scramble(key, k // 3)),))
    np.testing.assert_allclose(x, [*plant.parameters.coordinates.deviation(state.position), *state.velocity], atol=1e-9)
    assert reward == pytest.approx(-(np.array(q) @ before**2 + r * 36.0))
    assert not terminated
    assert not truncated


def test_a_pendulum_with_an_end_stop_out_of_reach_is_the_same_environment_by_the_equations_of_any_joints() -> None:
    plant = load_plant("dfki").with_values(coulomb_friction=0.0)
    arguments: dict[str, Any] = {"disturbance": 0.3, "hold": 2, "substeps": 2, "episode_time": 0.2}
    one = PlantEnv(plant, method="rk4", **arguments)
    other = PlantEnv(plant.with_values(upper_stop=1e3), **arguments)
    for env in (one, other):
        env.reset(seed=4)
    for k in range(100):
        first, second = (env.step(np.array([np.sin(0.1 * k)])) for env in (one, other))
        np.testing.assert_allclose(first[0], second[0], atol=1e-9)
        assert first[1] == pytest.approx(second[1], abs=1e-9)
        assert first[2:4] == second[2:4] == (False, k == 99)


def test_episodes_end_after_their_time_and_start_again_with_the_next_step() -> None:
    vector = PlantVectorEnv(2, plant="furuta", episode_time=0.01, start="bottom")
    vector.reset(seed=0)
    action = np.full((2, 1), 0.05)
    flags = [vector.step(action)[3].all() for _ in range(5)]
    assert flags == [False] * 4 + [True]
    x, rewards, *_ = vector.step(action)
    np.testing.assert_array_equal(x[:, 2:], 0.0)
    assert (rewards == 0.0).all()


def test_arguments_of_several_joints_are_refused_in_their_units() -> None:
    for kind in (PlantEnv, PlantVectorEnv):
        with pytest.raises(ParameterError, match=r"q is \(1.0, 1.0\); expected 4 finite numbers"):
            kind(plant="furuta", q=(1.0, 1.0))
        with pytest.raises(ParameterError, match=r"disturbance is -1.0 N; expected a finite number >= 0"):
            kind(plant="cart_pole", disturbance=-1.0)
        with pytest.raises(ParameterError, match="method is 'etd4'; expected auto: plant 'furuta' has several joints"):
            kind(plant="furuta", method="etd4")


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
    env = PlantEnv(plant, start="random")
    for seed in range(20):
        env.reset(seed=seed)
    if stops != (-1.0, 0.5):
        with pytest.raises(ParameterError, match=f"initial {own} is 0.0 "):
            PlantVectorEnv(2, plant=plant, start="bottom")


def test_actions_and_starts_of_another_shape_are_refused() -> None:
    env = PlantEnv("double_pendulum")
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
    picture = PlantPicture(plant, (200, 200))
    seen = []
    for q in ((0.0, 0.0), plant.coordinates.goal):
        picture.draw(q)
        seen.append(picture.array())
    assert seen[0].shape == (200, 200, 3)
    red = [(image[:, :, 0].astype(int) - image[:, :, 2] > 80).nonzero()[0].mean() for image in seen]
    # The last link is red; upright it is in the upper half.
    assert red[1] < red[0]
    with pytest.raises(ParameterError, match="expected two numbers from 120 to 4096"):
        PlantPicture(plant, (10, 10))
