"""Gymnasium's Pendulum-v1, many at once: its own equations, step and reward.

Source: gymnasium/envs/classic_control/pendulum.py, ``PendulumEnv.step``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Floats
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.plants.plant_parameters import pendulum_plant

__all__ = ["EPISODE", "PLANT", "STEP", "PendulumV1"]

STEP = 0.05
"""Period [s]."""
EPISODE = 200
_G, _M, _L, _MOST_SPEED, _MOST_TORQUE = 10.0, 1.0, 1.0, 8.0, 2.0
_REWARD = 0.1
"""Factor on the reward, so that returns are of the order of one to ten."""
PLANT = pendulum_plant(
    inertia=_M * _L * _L / 3.0, damping=0.0, gravity=0.5 * _M * _G * _L, effort_limit=_MOST_TORQUE, name="Pendulum-v1"
)
"""The same plant in this project's parameters."""


class PendulumV1:
    """``count`` pendulums; episodes begin at any angle and up to 1 rad/s, and last 200 steps."""

    observation_size, privileged_size, action_size = 3, 0, 1

    def __init__(self, count: int, generator: np.random.Generator) -> None:
        self.count = count
        self._generator = generator
        self.angle, self.velocity = np.zeros(count), np.zeros(count)
        self._left = np.zeros(count, dtype=np.int64)
        self.restart(np.ones(count, dtype=np.bool_))
        # Episodes must not all end at once.
        self._left[:] = generator.integers(1, EPISODE + 1, count)

    def observe(self) -> tuple[Floats, Floats]:
        """Return cosine, sine and velocity in units of 8 rad/s, shape (N, 3), and nothing privileged."""
        seen = np.stack([np.cos(self.angle), np.sin(self.angle), self.velocity / _MOST_SPEED], axis=1)
        return seen.astype(np.float32), np.empty((self.count, 0), dtype=np.float32)

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Take a step; return rewards and finished episodes."""
        torque = _MOST_TORQUE * actions[:, 0].astype(np.float64)
        cost = wrap(self.angle) ** 2 + 0.1 * self.velocity**2 + 0.001 * torque**2
        acceleration = 3.0 * _G / (2.0 * _L) * np.sin(self.angle) + 3.0 / (_M * _L**2) * torque
        self.velocity = np.clip(self.velocity + acceleration * STEP, -_MOST_SPEED, _MOST_SPEED)
        self.angle = self.angle + self.velocity * STEP
        self._left -= 1
        return (-_REWARD * cost).astype(np.float32), self._left <= 0

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Start new episodes."""
        number = int(which.sum())
        self.angle[which] = self._generator.uniform(-math.pi, math.pi, number)
        self.velocity[which] = self._generator.uniform(-1.0, 1.0, number)
        self._left[which] = EPISODE

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {"angle": self.angle, "velocity": self.velocity, "left": self._left}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Resume from a checkpoint."""
        self.angle, self.velocity = state["angle"].copy(), state["velocity"].copy()
        self._left = state["left"].copy()
