"""Gymnasium environments of a plant, single and vector: ``PendulumX59-v0``, ``PendulumAcrobot-v0`` and others.

Observation: x = [deviation of each joint from upright, wrapped if it turns; velocity of each joint]. Action: one effort
per driven joint [N m or N], or voltage of its motor [V], clamped to its limit. Reward: -(x' Q x + u' R u) at the state
of the action, with the plant's weights by default. Episodes never terminate; they are truncated after 5 s, or 10 s for
a swing-up.

Importing this module registers them, and so does ``gymnasium.make("pendulum_sim.environments.environment:ID")``.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.environments.environment_motion import Lanes, make_motion
from pendulum_sim.environments.environment_task import Array, EnvironmentTask, check_reset_options

__all__ = ["IDS", "PlantEnv", "PlantVectorEnv", "register"]

_SWING_UP = {"start": "bottom", "episode_time": 10.0}
IDS: dict[str, dict[str, Any]] = {
    "PendulumX59-v0": {"plant": "thesis"},
    "PendulumCartPole-v0": {"plant": "cart_pole", **_SWING_UP},
    "PendulumAcrobot-v0": {"plant": "acrobot", **_SWING_UP},
    "PendulumPendubot-v0": {"plant": "pendubot", **_SWING_UP},
    "PendulumDouble-v0": {"plant": "double_pendulum", **_SWING_UP},
    "PendulumFuruta-v0": {"plant": "furuta", **_SWING_UP},
}
"""Environments with their default arguments."""
_WINDOW_FPS = 50.0
"""Pictures a second in a window, which follows real time."""


class PlantEnv(gymnasium.Env[Array, Array]):
    """One plant.

    Args:
        plant: Preset, path of a plant file, or parameters.
        dt: Step over which an action is held [s].
        method: Integrator; ``auto`` chooses by the plant.
        substeps: Integration steps in a step.
        start: ``bottom``, ``top`` or ``random``; ``reset(options={"state": x})`` overrides it.
        disturbance: Half width of uniform noise on each driven joint [N m or N].
        hold: Steps for which a noise sample is held.
        q: Weights of deviations and velocities; None for the mechanism's.
        r: Weight of the efforts; None for the mechanism's.
        render_mode: None, ``human`` or ``rgb_array``.
        screen_size: Width and height of the picture [px].
        episode_time: Time after which an episode is truncated, inf for never [s]; ``max_episode_steps`` of
            ``gymnasium.make`` can only shorten it.

    Raises:
        ParameterError: An argument is outside its domain.
    """

    # For 2 ms; each environment sets the rate of its own steps, so that videos run in real time.
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 500}  # noqa: RUF012  # gymnasium's

    def __init__(
        self,
        plant: str | PlantParameters = "thesis",
        *,
        render_mode: str | None = None,
        screen_size: tuple[int, int] = (600, 600),
        **arguments: Any,
    ) -> None:
        self._task = task = EnvironmentTask(plant, **arguments)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(f"render_mode is {render_mode!r}; expected None, human or rgb_array")
        self.parameters = task.parameters
        self.dt = dt = task.dt
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / dt))}
        self.render_mode = render_mode
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self._motion = make_motion(task, 1)
        self._limit, self._size = task.last, len(task.limits)
        self._steps = 0
        self._steps_a_picture = max(1, round(1.0 / (_WINDOW_FPS * dt)))
        self._screen_size = screen_size
        self._picture: Any = None
        self._window: Any = None
        self._kernel: Any = None
        if isinstance(self._motion, Lanes):
            motion, self._rewards = self._motion, np.zeros(1)
            # Bound once: looking up six attributes takes a tenth of a step.
            self._kernel = partial(
                motion.kernel, motion.w[0], motion.keys[0], motion.counts[0], task.hold, motion.h, task.substeps
            )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode; return the observation, shape (2n,), and an empty dict.

        Args:
            seed: Seed of starts and noise.
            options: ``state``: the start x, as observed; ``start``: one of ``STARTS``.
        """
        super().reset(seed=seed)
        known = options or {}
        check_reset_options(known, ("state", "start"))
        self._motion.place(
            np.zeros(1, np.intp), *self._task.begin(known, self.np_random, 1, self._task.given(known, 1))
        )
        self._steps = 0
        if self.render_mode == "human":
            self.render()
        return self._motion.observe()[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold efforts u, shape (m,), for one step [N m or N].

        Returns:
            Observation (2n,), reward, terminated (never), truncated (time over), and an empty dict.
        """
        if type(action) is not np.ndarray:
            action = np.asarray(action, dtype=np.float32)
        if action.size != self._size:
            raise ParameterError(f"action has shape {action.shape}; expected ({self._size},)")
        self._steps += 1
        if self._kernel is not None:
            observation = np.empty(2)
            self._kernel(action if action.ndim == 1 else action.reshape(1), observation, self._rewards)
            reward: float = self._rewards.item()
            if math.isnan(reward):
                raise ParameterError(f"action is {action.tolist()}; expected finite numbers")
        else:
            observations, rewards = self._motion.step(action.reshape(1, -1))
            observation, reward = observations[0], rewards.item()
        if self.render_mode == "human" and self._steps % self._steps_a_picture == 0:
            self.render()
        return observation, reward, False, self._steps >= self._limit, {}

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the state into a window, or return an array of shape (height, width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() was called, but render_mode is None; expected human or rgb_array")
            return None
        # Imported late: training needs no pictures.
        from pendulum_sim.pictures.drawing import Window
        from pendulum_sim.pictures.plant_picture import PlantPicture

        if self._picture is None:
            self._picture = PlantPicture(self.parameters, self._screen_size)
            self._window = Window(self._picture.size) if self.render_mode == "human" else None
        position, velocity = (tuple(rows[0].tolist()) for rows in self._motion.state)
        effort = dict(
            zip(
                self.parameters.coordinates.driven_names,
                self.parameters.stall_efforts(self._motion.effort.tolist()),
                strict=True,
            )
        )
        self._picture.draw(position, velocity=velocity, effort=effort, time=self._steps * self.dt)
        if self._window is not None:
            self._window.show(self._picture, fps=round(1.0 / (self._steps_a_picture * self.dt)))
            return None
        picture: NDArray[np.uint8] = self._picture.array()
        return picture

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
        self._window = self._picture = None


class PlantVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """``num_envs`` equal plants: smooth pendulums in one compiled step, smooth mechanisms as arrays, others in turn.

    Smooth plants have no dry friction, stops, lag, delay or drivetrain. With a list of seeds, plant i equals a single
    environment of seed i. An episode is truncated after ``max_episode_steps``, or else ``episode_time``, and restarts
    with the next step. All other arguments are those of :class:`PlantEnv`.

    Raises:
        ParameterError: An argument is outside its domain.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        plant: str | PlantParameters = "thesis",
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        self._task = task = EnvironmentTask(plant, **arguments)
        self._last = task.last if max_episode_steps is None else max_episode_steps
        if num_envs < 1 or self._last < 1:
            raise ParameterError(
                f"num_envs is {num_envs} and max_episode_steps {max_episode_steps}; expected both >= 1"
            )
        if render_mode is not None:
            raise ParameterError(f"render_mode is {render_mode!r}; expected None: draw one PlantEnv instead")
        self.parameters, self.num_envs = task.parameters, num_envs
        self.single_observation_space, self.single_action_space = task.observation_space, task.action_space
        self.observation_space = batch_space(task.observation_space, num_envs)
        self.action_space = batch_space(task.action_space, num_envs)
        self._actions = (num_envs, len(task.limits))
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self._generators: list[np.random.Generator] | None = None
        self._motion = make_motion(task, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes, or some; return observations, shape (N, 2n), and an empty dict.

        Args:
            seed: One seed, of a shared generator, or one for each plant; None keeps its generator.
            options: ``start``: one of ``STARTS``; ``state``: starts x, shape (2n,) or (N, 2n), as observed;
                ``reset_mask``: which to start, shape (N,).

        Raises:
            ParameterError: An option is unknown, or has another shape.
        """
        known, n = options or {}, self.num_envs
        check_reset_options(known, ("state", "start", "reset_mask"))
        self._take_seeds(seed)
        mask = np.asarray(known.get("reset_mask", np.ones(n, dtype=np.bool_)))
        if mask.shape != (n,) or mask.dtype != np.bool_:
            raise ParameterError(f"reset_mask has shape {mask.shape} of {mask.dtype}; expected ({n},) of bool")
        self._restart(np.flatnonzero(mask), known, self._task.given(known, n))
        self._done[mask] = False
        return self._motion.observe(), {}

    def step(self, actions: Array) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold efforts, shape (N, m), for one step [N m or N].

        Returns:
            Observations (N, 2n), rewards (N,), terminated (N,), truncated (N,), and an empty dict.
        """
        if np.size(actions) != self._actions[0] * self._actions[1]:
            raise ParameterError(f"actions have shape {np.shape(actions)}; expected {self._actions}")
        observations, rewards = self._motion.step(np.reshape(actions, self._actions))
        restart = np.flatnonzero(self._done)
        if restart.size:
            # gymnasium's NEXT_STEP: this step starts their next episodes and ignores their actions.
            self._restart(restart, {})
            observations[restart] = self._motion.observe()[restart]
            rewards[restart] = 0.0
        self._done = truncated = self._motion.steps >= self._last
        return observations, rewards, np.zeros(self.num_envs, dtype=np.bool_), truncated, {}

    def _restart(self, which: NDArray[np.intp], options: dict[str, Any], state: Array | None = None) -> None:
        begin = self._task.begin
        if self._generators is None:
            self._motion.place(
                which, *begin(options, self.np_random, which.size, None if state is None else state[which])
            )
            return
        for index in which.tolist():
            # In the order of the single environment: the start, then the noise.
            own = None if state is None else state[[index]]
            self._motion.place(np.array([index]), *begin(options, self._generators[index], 1, own))

    def _take_seeds(self, seed: int | list[int | None] | None) -> None:
        if isinstance(seed, (list, tuple, np.ndarray)):
            if len(seed) != self.num_envs:
                raise ParameterError(f"seed has {len(seed)} entries; expected one for each of {self.num_envs} plants")
            before = self._generators
            self._generators = [
                before[index]
                if given is None and before is not None
                else seeding.np_random(None if given is None else int(given))[0]
                for index, given in enumerate(seed)
            ]
        elif seed is not None:
            super().reset(seed=seed)
            self._generators = None


def register() -> None:
    """Register the environments with gymnasium; done on import, and repeatable."""
    for name, arguments in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="pendulum_sim.environments.environment:PlantEnv",
                vector_entry_point="pendulum_sim.environments.environment:PlantVectorEnv",
                kwargs=arguments,
            )


register()
