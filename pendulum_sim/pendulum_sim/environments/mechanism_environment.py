"""Gymnasium environments of plants of several joints: ``PendulumAcrobot-v0`` and its sisters, single and vector.

Observation: x = [deviation of each joint from upright, velocity of each], what turns wrapped: 0 is upright.
Action: one effort per driven joint [N m or N], clamped to its limit.
Reward: -(x' Q x + u' R u) dt at the state in which the action was chosen, with the mechanism's weights.
Episodes never terminate; they are truncated after 10 s by default, whatever the step.

Importing this module registers them, and so does
``gymnasium.make("pendulum_sim.environments.mechanism_environment:ID")``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters
from pendulum_sim.environments.environment_arguments import Array, PlantVectorEnv, check_reset_options
from pendulum_sim.environments.mechanism_task import MechanismTask
from pendulum_sim.stepping.mechanism_plant import MechanismPlant, is_smooth_mechanism

__all__ = ["IDS", "MechanismEnv", "MechanismVectorEnv", "register"]

IDS = {
    "PendulumCartPole-v0": "cart_pole",
    "PendulumAcrobot-v0": "acrobot",
    "PendulumPendubot-v0": "pendubot",
    "PendulumDouble-v0": "double_pendulum",
    "PendulumFuruta-v0": "furuta",
}
"""Environments and the presets that they run where none is given."""
EPISODE_TIME = 10.0


class MechanismEnv(gymnasium.Env[Array, Array]):
    """One plant of several joints.

    Args:
        plant: Preset, path of a plant file, or parameters.
        dt: Step over which an action is held [s].
        substeps: Integration steps in a step.
        start: ``bottom``, ``top`` or ``random``; ``reset(options={"state": x})`` overrides it.
        disturbance: Half width of uniform noise on each driven joint [N m or N].
        q: Weights of each deviation and velocity in the reward; None for the mechanism's.
        r: Weight of the efforts; None for the mechanism's.
        render_mode: None or ``rgb_array``.
        screen_size: Width and height of the picture [px].
        episode_time: Time after which an episode is truncated, inf for never [s].

    Raises:
        ParameterError: An argument is outside its domain.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 500}  # noqa: RUF012  # gymnasium's

    def __init__(
        self,
        plant: str | MechanismParameters = "acrobot",
        *,
        dt: float = 2e-3,
        substeps: int = 1,
        start: str = "bottom",
        disturbance: float = 0.0,
        q: Sequence[float] | None = None,
        r: float | None = None,
        render_mode: str | None = None,
        screen_size: tuple[int, int] = (600, 600),
        episode_time: float = EPISODE_TIME,
    ) -> None:
        if render_mode not in {None, "rgb_array"}:
            raise ParameterError(f"render_mode is {render_mode!r}; expected None or rgb_array")
        self._task = MechanismTask(plant, dt, start, disturbance, q, r, episode_time)
        self.parameters = self._task.parameters
        self._plant = MechanismPlant(self.parameters, dt, substeps=substeps)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / dt))}
        self.render_mode = render_mode
        self.observation_space = self._task.observation_space
        self.action_space = self._task.action_space
        self._screen_size = screen_size
        self._picture: Any = None
        self._key = 0
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of starts and noise.
            options: ``state``: the start x in the observation's convention; ``start``: one of ``STARTS``.

        Returns:
            Observation, shape (2n,), and an empty dict.
        """
        super().reset(seed=seed)
        known = options or {}
        check_reset_options(known)
        position, velocity, self._key = self._task.begin(known, self.np_random)
        self._steps = 0
        self._plant.reset(tuple(position.tolist()), tuple(velocity.tolist()))
        return self._observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold efforts for one step.

        Args:
            action: u, shape (m,) [N m or N].

        Returns:
            Observation (2n,), reward, terminated (never), truncated (when its time is over), and an empty dict.
        """
        action = np.asarray(action)
        if action.shape != self._task.limits.shape:
            raise ParameterError(f"action has shape {action.shape}; expected {self._task.limits.shape}")
        effort = self._task.efforts(action)
        reward = float(self._task.reward(self._observe(), effort))
        disturbed = effort
        if self._task.disturbance > 0.0:
            disturbed = effort + self._task.noise(self._key, self._steps)
        self._plant.step(tuple(disturbed.tolist()))
        self._steps += 1
        return self._observe(), reward, False, self._steps >= self._task.last, {}

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the present state as an array of shape (height, width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() was called, but render_mode is None; expected rgb_array")
            return None
        # Imported late: training runs without pictures.
        from pendulum_sim.pictures.mechanism_drawing import MechanismPicture

        if self._picture is None:
            self._picture = MechanismPicture(self.parameters, self._screen_size)
        state = self._plant.state
        self._picture.draw(state.position, time=state.time)
        picture: NDArray[np.uint8] = self._picture.array()
        return picture

    def _observe(self) -> Array:
        state = self._plant.state
        return self._task.observe(np.array(state.position), np.array(state.velocity))


class MechanismVectorEnv(PlantVectorEnv):
    """Many equal plants of several joints; those without friction, stops, lag and delay all in one step of arrays.

    Plant i, reset with a list of seeds, starts and is disturbed as a single environment reset with seed i.

    There are ``num_envs`` of them, >= 1. An episode is truncated after ``max_episode_steps``, or ``episode_time`` where
    that is None, and restarts with the step after that. All other arguments are those of :class:`MechanismEnv`.

    Raises:
        ParameterError: An argument is outside its domain.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        plant: str | MechanismParameters = "acrobot",
        dt: float = 2e-3,
        start: str = "bottom",
        disturbance: float = 0.0,
        q: Sequence[float] | None = None,
        r: float | None = None,
        render_mode: str | None = None,
        episode_time: float = EPISODE_TIME,
    ) -> None:
        self._task = task = MechanismTask(plant, dt, start, disturbance, q, r, episode_time)
        super().__init__(
            num_envs,
            task.observation_space,
            task.action_space,
            task.last,
            max_episode_steps,
            render_mode,
            "MechanismEnv",
        )
        self.parameters = task.parameters
        smooth = is_smooth_mechanism(task.parameters)
        self._plants = [] if smooth else [MechanismPlant(task.parameters, dt) for _ in range(num_envs)]
        self._forward = in_arithmetic(task.parameters.mechanism.forward, np)
        self._along = along_functions(task.joints)
        self._position = np.zeros((num_envs, task.joints))
        self._velocity = np.zeros((num_envs, task.joints))
        self._keys = [0] * num_envs
        self._counts = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes.

        Args:
            seed: One seed for all, whose plants then share a generator, or one for each.
            options: ``start``: one of ``STARTS``; ``state``: the start x of all.

        Returns:
            Observations, shape (N, 2n), and an empty dict.
        """
        known = options or {}
        check_reset_options(known)
        self._take_seeds(seed)
        for index in range(self.num_envs):
            self._restart(index, known)
        self._done[:] = False
        return self._observe(), {}

    def step(self, actions: Array) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold efforts for one step.

        Args:
            actions: Shape (N, m) [N m or N].

        Returns:
            Observations (N, 2n), rewards (N,), terminated (N,), truncated (N,), and an empty dict.
        """
        task = self._task
        if np.shape(actions) != (self.num_envs, len(task.limits)):
            raise ParameterError(
                f"actions have shape {np.shape(actions)}; expected ({self.num_envs}, {len(task.limits)})"
            )
        effort = task.efforts(actions)
        reward = task.reward(self._observe(), effort)
        if task.disturbance > 0.0:
            effort = effort + [task.noise(*each) for each in zip(self._keys, self._counts.tolist(), strict=True)]
        if self._plants:
            for index, plant in enumerate(self._plants):
                state = plant.step(tuple(effort[index].tolist()))
                self._position[index], self._velocity[index] = state.position, state.velocity
        else:
            self._advance(np.clip(effort, -task.limits, task.limits))
        self._counts += 1
        # By gymnasium's rule for NEXT_STEP this step starts the next episodes of those that ended; its action counts
        # for nothing.
        for index in np.flatnonzero(self._done):
            self._restart(int(index), {})
            reward[index] = 0.0
        truncated = self._counts >= self._last
        self._done = truncated
        return self._observe(), reward, np.zeros(self.num_envs, dtype=np.bool_), truncated.copy(), {}

    def _advance(self, effort: Array) -> None:
        torque = np.zeros_like(self._position)
        torque[:, list(self._task.parameters.coordinates.driven)] = effort
        q, v, tau = (tuple(each.T) for each in (self._position, self._velocity, torque))
        p = self._task.parameters.packed
        q, v = rk4_joints(self._forward, self._along, q, v, tau, tau, tau, self._task.dt, p)
        self._position, self._velocity = np.stack(q, axis=1), np.stack(v, axis=1)

    def _restart(self, index: int, options: dict[str, Any]) -> None:
        generator = self.np_random if self._generators is None else self._generators[index]
        position, velocity, self._keys[index] = self._task.begin(options, generator)
        self._counts[index] = 0
        self._position[index], self._velocity[index] = position, velocity
        if self._plants:
            self._plants[index].reset(tuple(position.tolist()), tuple(velocity.tolist()))

    def _observe(self) -> Array:
        return self._task.observe(self._position, self._velocity)


def register() -> None:
    """Register the environments with gymnasium; done on import, and harmless twice."""
    for name, plant in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="pendulum_sim.environments.mechanism_environment:MechanismEnv",
                vector_entry_point="pendulum_sim.environments.mechanism_environment:MechanismVectorEnv",
                kwargs={"plant": plant},
            )


register()
