"""What the environments of several joints have in common: plant, spaces, reward, starts and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism
from pendulum_sim.environments.environment_arguments import (
    Array,
    check_disturbance,
    check_start_name,
    check_weights,
    episode_steps,
)
from pendulum_sim.stepping.mechanism_plant import check_stable_step
from pendulum_sim.stepping.plant import check_step

__all__ = ["MechanismTask"]


class MechanismTask:
    """What a single environment and a vector of them share: plant, spaces, reward, starts and noise."""

    def __init__(
        self,
        plant: str | MechanismParameters,
        dt: float,
        start: str,
        disturbance: float,
        q: Sequence[float] | None,
        r: float | None,
        episode_time: float,
    ) -> None:
        parameters = plant if isinstance(plant, MechanismParameters) else load_mechanism(plant)
        check_step(dt, 1)
        check_stable_step(parameters, dt)
        if not parameters.coordinates.driven:
            raise ParameterError(f"plant {parameters.name!r} has no driven joint; expected an actuator at one of them")
        check_start_name(start)
        check_disturbance(disturbance, "N m or N")
        n = len(parameters.joints)
        weights, cost = parameters.mechanism.weights
        given, self.r = weights if q is None else q, float(cost if r is None else r)
        check_weights(given, self.r, 2 * n, f"{2 * n} finite numbers >= 0, of each joint and of each velocity")
        self.q = np.asarray(given, dtype=np.float64)
        self.parameters, self.dt, self.start, self.disturbance = parameters, dt, start, disturbance
        self.joints = n
        self.last = episode_steps(episode_time, dt)
        self.limits = np.array(parameters.effort_limits)
        self.goal = np.array(parameters.coordinates.goal)
        if start != "random":
            parameters.check_start(tuple(self.goal) if start == "top" else (0.0,) * n)
        self.turns = np.array([joint.turns for joint in parameters.mechanism.joints])
        high = np.full(2 * n, np.inf)
        high[:n][self.turns] = np.pi
        self.observation_space = spaces.Box(-high, high, dtype=np.float64)
        limits = self.limits.astype(np.float32)
        self.action_space = spaces.Box(-limits, limits, dtype=np.float32)

    def observe(self, position: Array, velocity: Array) -> Array:
        """Return x of shape (..., 2n)."""
        deviation = position - self.goal
        wrapped = np.where(self.turns, (deviation + np.pi) % (2.0 * np.pi) - np.pi, deviation)
        return np.concatenate([wrapped, velocity], axis=-1)

    def reward(self, x: Array, effort: Array) -> Array:
        """Return the rewards of states (..., 2n) and efforts (..., m)."""
        cost: Array = (x * x) @ self.q + self.r * (effort * effort).sum(axis=-1)
        return -self.dt * cost

    def begin(self, options: Mapping[str, Any], generator: np.random.Generator) -> tuple[Array, Array, int]:
        """Return positions, velocities and the key of the noise of an episode.

        Args:
            options: ``state``, the start in the observation's convention, or ``start``, one of ``STARTS``.
            generator: Of starts and noise.
        """
        state = options.get("state")
        if state is None:
            position, velocity = self._draw(options.get("start", self.start), generator)
        else:
            position, velocity = self._given(state)
        return position, velocity, noise.stream_key(int(generator.integers(2**63)))

    def _draw(self, start: object, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return positions and velocities of a start: hanging, upright, or anywhere with up to 1 rad/s or m/s."""
        check_start_name(start)
        position, velocity = (self.goal.copy() if start == "top" else np.zeros(self.joints)), np.zeros(self.joints)
        if start == "random":
            position = generator.uniform(-math.pi, math.pi, self.joints)
            for i, own in enumerate(self.parameters.joints):
                # Without a stop on one side, half a turn or 1 m from the other, or from 0.
                reach = math.pi if self.turns[i] else 1.0
                low, high = own.lower_stop, own.upper_stop
                if low is None:
                    low = -reach if high is None else min(-reach, high - reach)
                if high is None:
                    high = max(reach, low + reach)
                middle, half = 0.5 * (low + high), 0.5 * (high - low)
                if own.lower_stop is not None or own.upper_stop is not None:
                    half *= 0.9
                position[i] = middle + half * position[i] / math.pi
            velocity = generator.uniform(-1.0, 1.0, self.joints)
        return position, velocity

    def _given(self, state: object) -> tuple[Array, Array]:
        """Return positions and velocities of a state in the observation's convention."""
        x = np.asarray(state, dtype=np.float64)
        if x.shape != (2 * self.joints,) or not np.isfinite(x).all():
            raise ParameterError(f"start state has shape {x.shape}; expected {2 * self.joints} finite numbers")
        return x[: self.joints] + self.goal, x[self.joints :]

    def efforts(self, actions: Array) -> Array:
        """Return clamped actions (..., m)."""
        if not np.isfinite(actions).all():
            raise ParameterError(f"action is {np.asarray(actions).tolist()}; expected finite numbers")
        return np.clip(np.asarray(actions, dtype=np.float64), -self.limits, self.limits)

    def noise(self, key: int, count: int) -> list[float]:
        """Return the disturbance of each driven joint in a step, as a batch of plants draws it."""
        m = len(self.limits)
        return [self.disturbance * noise.unit_interval(noise.scramble(key, count * m + i)) for i in range(m)]
