"""Gymnasium environment ``PendulumX59-v0``: the pendulum of the thesis for learning libraries.

Observation: x = [wrap(theta - pi), theta_dot] [rad, rad/s], as controllers see it: 0 is upright.
Action: torque u [N m], Box of shape (1,), clamped to the effort limit.
Reward: -(q_1 x_1^2 + q_2 x_2^2 + r u^2) at the state in which the action was chosen.
Episodes never terminate; they are truncated after 5 s by default, whatever the step.

Importing ``pendulum_sim.environments.environment`` registers it, and so does
``gymnasium.make("pendulum_sim.environments.environment:PendulumX59-v0")``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.environments.environment_arguments import (
    Array,
    check_disturbance,
    check_reset_options,
    check_start_name,
    check_weights,
    episode_steps,
)
from pendulum_sim.environments.environment_kernel import is_smooth, lane_table, step_kernel
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import check_start, check_step
from pendulum_sim.stepping.plants import make_plant

__all__ = [
    "ENVIRONMENT_ID",
    "EPISODE_TIME",
    "PendulumEnv",
    "action_space",
    "check_arguments",
    "draw_start",
    "observation_space",
    "register",
]

ENVIRONMENT_ID = "PendulumX59-v0"
EPISODE_TIME = 5.0
"""Time after which an episode is truncated: the length of the thesis's runs [s]."""
_WINDOW_FPS = 50.0
"""Pictures a second in a window, which follows real time; a picture of each step would be ten times too many."""
THESIS_Q = (100.0, 0.01)
THESIS_R = 0.1


class PendulumEnv(gymnasium.Env[Array, Array]):
    """One pendulum.

    Args:
        plant: Preset, path of a plant file, or parameters; any plant, series elastic too.
        dt: Step over which an action is held [s].
        method: Integrator; ``auto`` chooses by the plant.
        substeps: Integration steps in a step.
        start: ``bottom``, ``top`` or ``random``; ``reset(options={"state": [x_1, x_2]})`` overrides it.
        disturbance: Half width of uniform noise on the torque [N m].
        hold: Steps for which a noise sample is held.
        q: Weights of angle and velocity in the reward.
        r: Weight of the torque.
        render_mode: None, ``human`` or ``rgb_array``.
        screen_size: Width and height of the picture [px].
        episode_time: Time after which an episode is truncated, inf for never [s]; ``max_episode_steps`` of
            ``gymnasium.make`` can only make it shorter.

    Raises:
        ParameterError: An argument is outside its domain.
    """

    # The class's for 2 ms; each environment has the rate of its own steps, a frame each, so that videos are in time.
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 500}  # noqa: RUF012  # gymnasium's

    def __init__(
        self,
        plant: str | PlantParameters = "thesis",
        *,
        dt: float = 2e-3,
        method: str = "auto",
        substeps: int = 1,
        start: str = "top",
        disturbance: float = 0.0,
        hold: int = 1,
        q: tuple[float, float] = THESIS_Q,
        r: float = THESIS_R,
        render_mode: str | None = None,
        screen_size: tuple[int, int] = (600, 600),
        episode_time: float = EPISODE_TIME,
    ) -> None:
        parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
        check_arguments(dt, substeps, start, disturbance, hold, method, q, r)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(f"render_mode is {render_mode!r}; expected None, human or rgb_array")
        self.parameters = parameters
        self.dt = dt
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / dt))}
        self.render_mode = render_mode
        self._steps = 0
        self._limit = episode_steps(episode_time, dt)
        self._steps_a_picture = max(1, round(1.0 / (_WINDOW_FPS * dt)))
        self.observation_space = observation_space(parameters, disturbance)
        self.action_space = action_space(parameters)
        self._start = start
        self._amplitude = float(disturbance)
        self._hold = hold
        self._q, self._r = q, r
        self._keys = np.zeros(1, dtype=np.uint64)
        self._counts = np.zeros(1, dtype=np.int64)
        self._rewards = np.zeros(1)
        self._kernel: Any = None
        self._plant: Any = None
        self._screen_size = screen_size
        self._picture: Any = None
        self._window: Any = None
        self.effort = 0.0
        if is_smooth(parameters) and method != "adaptive":
            method = "etd4" if method == "auto" else method
            self._h, self._substeps = dt / substeps, substeps
            self._w = lane_table(parameters, method, self._h, 1, self._amplitude, q, r).reshape(-1)
            self._kernel = step_kernel(method, 1)
        else:
            self._plant = make_plant(parameters, dt, method=method, substeps=substeps if substeps > 1 else None)

    @property
    def theta(self) -> float:
        """Angle, 0 hanging, not wrapped [rad]."""
        return float(self._w[0] if self._plant is None else self._plant.state.theta)

    @property
    def theta_dot(self) -> float:
        """Velocity [rad/s]."""
        return float(self._w[1] if self._plant is None else self._plant.state.theta_dot)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of starts and noise.
            options: ``state``: the start [x_1, x_2] in the observation's convention; ``start``: one of ``STARTS``.

        Returns:
            Observation, shape (2,), and an empty dict.
        """
        super().reset(seed=seed)
        options = options or {}
        check_reset_options(options)
        self._steps = 0
        state = options.get("state")
        if state is None:
            x = draw_start(options.get("start", self._start), self.np_random, 1)[0]
        else:
            x = np.asarray(state, dtype=np.float64)
            if x.shape != (2,):
                raise ParameterError(f"start state has shape {x.shape}; expected (2,)")
        theta, theta_dot = float(x[0]) + UPRIGHT, float(x[1])
        check_start(theta, theta_dot)
        self._keys[0] = noise.stream_key(int(self.np_random.integers(2**63)))
        self._counts[0] = 0
        self.effort = 0.0
        if self._plant is None:
            self._w[0], self._w[1] = theta, theta_dot
        else:
            self._plant.reset(theta, theta_dot)
        if self.render_mode == "human":
            self.render()
        return np.array([from_upright(theta), theta_dot]), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold a torque for one step.

        Args:
            action: u, shape (1,) [N m].

        Returns:
            Observation (2,), reward, terminated (never), truncated (when its time is over), and an empty dict.
        """
        if type(action) is not np.ndarray:
            action = np.asarray(action, dtype=np.float32)
        if action.size != 1:
            raise ParameterError(f"action has shape {action.shape}; expected (1,)")
        self._steps += 1
        if self._plant is None:
            observation = np.empty(2)
            self._kernel(
                self._w,
                self._keys,
                self._counts,
                self._hold,
                self._h,
                self._substeps,
                action if action.ndim == 1 else action.reshape(1),
                observation,
                self._rewards,
            )
            reward = float(self._rewards[0])
            if math.isnan(reward):
                raise ParameterError(f"action is {action} N m; expected a finite number")
            if self.render_mode == "human":
                self._show()
            return observation, reward, False, self._steps >= self._limit, {}
        return self._step_any(float(action.reshape(-1)[0]))

    def _step_any(self, action: float) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        if not math.isfinite(action):
            raise ParameterError(f"action is {action} N m; expected a finite number")
        limit = self.parameters.effort_limit
        self.effort = min(limit, max(-limit, action))
        disturbance = self._amplitude * noise.unit_interval(
            noise.scramble(int(self._keys[0]), int(self._counts[0]) // self._hold)
        )
        self._counts[0] += 1
        before = self._plant.state
        deviation = from_upright(before.theta)
        reward = -(self._q[0] * deviation**2 + self._q[1] * before.theta_dot**2 + self._r * self.effort**2)
        state = self._plant.step(self.effort + disturbance)
        if self.render_mode == "human":
            self._show()
        observation = np.array([from_upright(state.theta), state.theta_dot])
        return observation, reward, False, self._steps >= self._limit, {}

    def _show(self) -> None:
        """Show a step in the window, where a picture is due."""
        if self._steps % self._steps_a_picture == 0:
            self.render()

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the present state: into a window, or as an array of shape (height, width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() was called, but render_mode is None; expected human or rgb_array")
            return None
        # Imported late: training runs without pictures.
        from pendulum_sim.pictures.drawing import PendulumPicture, Window

        if self._picture is None:
            self._picture = PendulumPicture(self._screen_size, self.parameters.effort_limit)
            self._window = Window(self._picture.size) if self.render_mode == "human" else None
        torque = self.effort if self._plant is not None else float(self._w[2])
        time = int(self._counts[0]) * self.dt
        self._picture.draw(self.theta, self.theta_dot, torque, time=time)
        if self._window is not None:
            self._window.show(self._picture, fps=round(1.0 / (self._steps_a_picture * self.dt)))
            return None
        picture: NDArray[np.uint8] = self._picture.array()
        return picture

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
        self._window = self._picture = None


def observation_space(parameters: PlantParameters, disturbance: float) -> spaces.Box:
    """Return the space of x; the speed is bounded where friction bounds it."""
    speed = math.inf
    if parameters.drivetrain is None and parameters.damping > 0.0:
        # b |theta'| cannot exceed the sum of all other torques for long: beyond that speed it only slows down.
        torques = parameters.effort_limit + parameters.gravity + abs(parameters.torque_offset) + disturbance
        speed = max(20.0, 1.1 * torques / parameters.damping)
    high = np.array([math.pi, speed])
    return spaces.Box(-high, high, dtype=np.float64)


def action_space(parameters: PlantParameters) -> spaces.Box:
    """Return the space of u."""
    limit = parameters.effort_limit
    return spaces.Box(-limit, limit, shape=(1,), dtype=np.float32)


def draw_start(start: str, generator: np.random.Generator, count: int) -> Array:
    """Return starts x of shape (count, 2): at the bottom or top, or at a random angle and up to 1 rad/s."""
    check_start_name(start)
    x = np.zeros((count, 2))
    if start == "bottom":
        x[:, 0] = -math.pi
    elif start == "random":
        x[:] = generator.uniform([-math.pi, -1.0], [math.pi, 1.0], (count, 2))
    return x


def register() -> None:
    """Register ``PendulumX59-v0`` with gymnasium; done on import, and harmless twice."""
    if ENVIRONMENT_ID not in gymnasium.registry:
        gymnasium.register(
            ENVIRONMENT_ID,
            entry_point="pendulum_sim.environments.environment:PendulumEnv",
            vector_entry_point="pendulum_sim.environments.vector_environment:PendulumVectorEnv",
        )


def check_arguments(
    dt: float,
    substeps: int,
    start: str,
    disturbance: float,
    hold: int,
    method: str,
    q: Sequence[float],
    r: float,
) -> None:
    """Refuse arguments that make no environment."""
    check_weights(q, r, 2, "two finite numbers >= 0, the weights of angle and velocity")
    check_step(dt, substeps)
    if method != "auto":
        get_integrator(method)
    check_start_name(start)
    check_disturbance(disturbance, "N m")
    if hold < 1:
        raise ParameterError(f"hold is {hold} steps; expected >= 1")


register()
