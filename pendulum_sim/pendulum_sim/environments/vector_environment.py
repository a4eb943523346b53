"""The vectorised environment: many pendulums of ``PendulumX59-v0`` in one compiled step."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.environments.environment import (
    EPISODE_TIME,
    THESIS_Q,
    THESIS_R,
    action_space,
    check_arguments,
    draw_start,
    observation_space,
)
from pendulum_sim.environments.environment_arguments import Array, PlantVectorEnv, check_reset_options, episode_steps
from pendulum_sim.environments.environment_kernel import is_smooth, lane_table, step_kernel

__all__ = ["PendulumVectorEnv"]

_LANES = 256


class PendulumVectorEnv(PlantVectorEnv):
    """Many equal pendulums in one compiled step, for learning libraries; rigid plants without dry friction or lag.

    There are ``num_envs`` of them, >= 1. An episode is truncated after ``max_episode_steps``, or ``episode_time`` where
    that is None, and restarts with the step after that. All other arguments are those of ``PendulumEnv``.

    Raises:
        ParameterError: An argument is outside its domain.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        plant: str | PlantParameters = "thesis",
        dt: float = 2e-3,
        method: str = "auto",
        substeps: int = 1,
        start: str = "top",
        disturbance: float = 0.0,
        hold: int = 1,
        q: tuple[float, float] = THESIS_Q,
        r: float = THESIS_R,
        render_mode: str | None = None,
        episode_time: float = EPISODE_TIME,
    ) -> None:
        parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
        check_arguments(dt, substeps, start, disturbance, hold, method, q, r)
        if not is_smooth(parameters):
            raise ParameterError(
                f"plant {parameters.name!r} has dry friction, lag, delay or a drivetrain; expected none of them here: "
                "use gymnasium's SyncVectorEnv with it"
            )
        method = "etd4" if method == "auto" else method
        if method == "adaptive":
            raise ParameterError("method is 'adaptive'; expected a compiled one, such as etd4")
        super().__init__(
            num_envs,
            observation_space(parameters, disturbance),
            action_space(parameters),
            episode_steps(episode_time, dt),
            max_episode_steps,
            render_mode,
            "PendulumEnv",
        )
        self.parameters = parameters
        self._start = start
        self._hold = hold
        self._h, self._substeps = dt / substeps, substeps
        blocks = -(-num_envs // _LANES)
        table = lane_table(parameters, method, self._h, _LANES, disturbance, q, r)
        self._w = np.repeat(table.reshape(1, -1), blocks, axis=0)
        self._keys = np.zeros((blocks, _LANES), dtype=np.uint64)
        self._counts = np.zeros((blocks, _LANES), dtype=np.int64)
        self._actions = np.zeros((blocks, _LANES))
        self._kernel = step_kernel(method, _LANES)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes, or some.

        Args:
            seed: One seed for all, whose pendulums then share a generator, or one for each: pendulum i then starts and
                is disturbed as a single environment reset with that seed; where one is None, its generator stays.
            options: ``start``: one of ``STARTS``; ``state``: starts [x_1, x_2], shape (2,) or (N, 2), in the
                observation's convention; ``reset_mask``: which to start, shape (N,).

        Returns:
            Observations, shape (N, 2), and an empty dict.

        Raises:
            ParameterError: An option is unknown, or has another shape.
        """
        options = options or {}
        check_reset_options(options, ("state", "start", "reset_mask"))
        n = self.num_envs
        self._take_seeds(seed)
        mask = np.asarray(options.get("reset_mask", np.ones(n, dtype=np.bool_)))
        if mask.shape != (n,) or mask.dtype != np.bool_:
            raise ParameterError(f"reset_mask has shape {mask.shape} of {mask.dtype}; expected ({n},) of bool")
        which = np.flatnonzero(mask)
        state = options.get("state")
        starts = None
        if state is not None:
            starts = np.asarray(state, dtype=np.float64)
            if starts.shape not in {(2,), (n, 2)} or not np.isfinite(starts).all():
                raise ParameterError(
                    f"start state has shape {starts.shape}; expected finite numbers of shape (2,) or ({n}, 2)"
                )
            starts = np.broadcast_to(starts, (n, 2))[which]
        self._restart(which, options.get("start", self._start), starts)
        self._done[which] = False
        return self._observe(), {}

    def step(self, actions: Array) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold a torque each for one step.

        Args:
            actions: Shape (N, 1) [N m].

        Returns:
            Observations (N, 2), rewards (N,), terminated (N,), truncated (N,), and an empty dict.
        """
        n = self.num_envs
        if np.size(actions) != n:
            raise ParameterError(f"actions have shape {np.shape(actions)}; expected ({n}, 1)")
        self._actions.reshape(-1)[:n] = np.reshape(actions, n)
        observations = np.empty((self._w.shape[0], 2 * _LANES))
        rewards = np.empty((self._w.shape[0], _LANES))
        restart = np.flatnonzero(self._done)
        for block in range(self._w.shape[0]):
            self._kernel(
                self._w[block],
                self._keys[block],
                self._counts[block],
                self._hold,
                self._h,
                self._substeps,
                self._actions[block],
                observations[block],
                rewards[block],
            )
        result = observations.reshape(-1, 2)[:n]
        reward = rewards.reshape(-1)[:n]
        if not np.isfinite(reward).all():
            raise ParameterError(f"action {int(np.argmin(np.isfinite(reward)))} is not a finite number of N m")
        if restart.size:
            # By gymnasium's rule for NEXT_STEP this step starts their next episodes; its action is ignored.
            self._restart(restart, self._start)
            result[restart] = self._observe()[restart]
            reward[restart] = 0.0
        truncated = self._counts.reshape(-1)[:n] >= self._last
        self._done = truncated
        return result, reward, np.zeros(n, dtype=np.bool_), truncated, {}

    def _restart(self, which: NDArray[np.intp], start: str, starts: Array | None = None) -> None:
        if self._generators is None:
            drawn = draw_start(start, self.np_random, which.size) if starts is None else starts
            seeds = self.np_random.integers(2**63, size=which.size)
        else:
            # In the order of the single environment: the start, then the noise.
            own = [self._generators[index] for index in which]
            each = [draw_start(start, generator, 1)[0] for generator in own] if starts is None else starts
            drawn = np.reshape(each, (which.size, 2))
            seeds = np.array([generator.integers(2**63) for generator in own], dtype=np.int64)
        starts = drawn
        block, lane = which // _LANES, which % _LANES
        self._w[block, lane] = starts[:, 0] + UPRIGHT
        self._w[block, _LANES + lane] = starts[:, 1]
        self._keys[block, lane] = [noise.stream_key(int(seed)) for seed in seeds]
        self._counts[block, lane] = 0

    def _observe(self) -> Array:
        theta = self._w[:, :_LANES].reshape(-1)[: self.num_envs]
        theta_dot = self._w[:, _LANES : 2 * _LANES].reshape(-1)[: self.num_envs]
        return np.stack([from_upright(theta), theta_dot], axis=1)
