"""Imitation of a teacher on the states that the pupil itself visits (DAgger without memory of earlier rounds).

Source: Ross, Gordon and Bagnell, A reduction of imitation learning and structured prediction to no-regret online
learning, 2011, algorithm 3.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_learning.environment import SwingUp
from pendulum_learning.network import Adam, Mlp
from pendulum_learning.ppo import PpoSettings, finite_or_diverged
from pendulum_learning.teacher import Teacher

__all__ = ["Imitation"]

_FIRST_RATE, _LAST_RATE = 2e-3, 2e-5
_PASSES, _PARTS = 2, 12
_LED = 0.2
"""Share of the training in which the teacher leads a falling number of the plants instead of the pupil."""
_NEAR, _LOST = 2.0, 6.0
"""Costs of a deviation up to which an episode starts, and from which it is aborted for lack of a path."""
_AT_ENDS = 0.15
"""Share of the episodes that start at the first node, and at rest upright; the others on the way."""
_NOISE = 0.02
"""Standard deviation of the noise on commands, as a share of the limit, which visits states off the trajectory."""


class Imitation:
    """A learner like :class:`pendulum_learning.ppo.Ppo` that fits a teacher's commands along its swing-up."""

    def __init__(
        self, environment: SwingUp, settings: PpoSettings, generator: np.random.Generator, teacher: Teacher
    ) -> None:
        self.environment, self.settings, self.teacher = environment, settings, teacher
        self.generator = generator
        sizes = (environment.observation_size, *settings.hidden, environment.action_size)
        self.actor = Mlp(sizes, generator, last=0.1)
        self._adam = Adam(self.actor.parameters)
        self._restart(np.ones(environment.count, dtype=np.bool_))

    def update(self, remaining: float = 1.0) -> dict[str, float]:
        """Gather states with the present policy and fit it to the teacher's commands there.

        ``remaining`` is the remaining share of the training. Returns mean reward per step, mean squared command error
        as ``divergence``, no spread, or raises a FaultError for a parameter that is not finite.
        """
        seen, taught, reward = self._gather(max(0.0, 1.0 - (1.0 - remaining) / _LED))
        rate = _LAST_RATE + (_FIRST_RATE - _LAST_RATE) * remaining
        size = len(seen) // _PARTS
        losses = []
        for _ in range(_PASSES):
            order = self.generator.permutation(len(seen))
            for part in range(_PARTS):
                rows = order[part * size : (part + 1) * size]
                answers, right = self.actor.forward(seen[rows]), taught[rows]
                enough = (np.abs(right) >= 1.0) & (answers * right >= 1.0)
                error = np.where(enough, np.float32(0.0), answers - right)
                losses.append(float(np.mean(error * error)))
                self._adam.step(self.actor.backward(error / np.float32(size)), rate)
        finite_or_diverged(self.actor.parameters)
        return {"reward": reward, "divergence": float(np.mean(losses)), "spread": 0.0}

    def _gather(self, led: float) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        env, draw = self.environment, self.generator
        follows = draw.random(env.count) < led
        seen, taught, rewards = [], [], []
        for _ in range(self.settings.horizon):
            observed, _ = env.observe()
            efforts, cost = self.teacher.output(env.states)
            right = (efforts / env.limit).astype(np.float32)
            near = cost < _LOST
            seen.append(observed[near])
            taught.append(right[near])
            noise = _NOISE * draw.standard_normal(right.shape, dtype=np.float32)
            answers = np.where(follows[:, None], right, self.actor.forward(observed)) + noise
            reward, over = env.step(np.clip(answers, -1.0, 1.0).astype(np.float32))
            rewards.append(float(reward.mean()))
            self._restart(over | ~near)
        return np.concatenate(seen), np.concatenate(taught), float(np.mean(rewards))

    def _restart(self, which: NDArray[np.bool_]) -> None:
        rows = np.flatnonzero(which)
        if not rows.size:
            return
        self.environment.restart(which)
        last = len(self.teacher.states) - 1
        nodes = self.generator.integers(0, self.teacher.moving, rows.size)
        kind = self.generator.random(rows.size)
        nodes[kind < _AT_ENDS], nodes[kind > 1.0 - _AT_ENDS] = 0, last
        self.environment.start_at(rows, *self.teacher.around(nodes, _NEAR, self.generator))

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        state: dict[str, NDArray[Any]] = {f"actor_{k}": each for k, each in enumerate(self.actor.parameters)}
        return state | {f"adam_{key}": each for key, each in self._adam.state().items()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Resume from a checkpoint."""
        for k, each in enumerate(self.actor.parameters):
            each[...] = state[f"actor_{k}"]
        self._adam.restore({key.removeprefix("adam_"): each for key, each in state.items() if key.startswith("adam_")})
