"""Proximal policy optimisation on a batch of environments.

The actor outputs the mean of a normal distribution; the critic also sees the true plant of the simulation. The learning
rate follows the distance between the old and the new policy.

Sources: Schulman et al., Proximal policy optimization algorithms, 2017, eq. 7; Schulman et al., High-dimensional
continuous control using generalized advantage estimation, 2016, eq. 16; Rudin et al., Learning to walk in minutes using
massively parallel deep reinforcement learning, 2022 (adaptive rate).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Floats
from pendulum_learning.network import Adam, Mlp
from pendulum_msgs_py.errors import FaultError

__all__ = ["BatchEnvironment", "Ppo", "PpoSettings", "finite_or_diverged"]


class BatchEnvironment(Protocol):
    """N environments that are stepped together."""

    count: int
    observation_size: int
    privileged_size: int
    action_size: int

    def observe(self) -> tuple[Floats, Floats]:
        """Return the policy's observations, shape (N, observations), and the critic's further ones, (N, privileged)."""

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Take actions of shape (N, actions), clipped to [-1, 1]; return rewards and finished episodes."""

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Start new episodes where ``which`` is true."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Resume from a checkpoint."""


@dataclass(frozen=True)
class PpoSettings:
    """Settings of the learner.

    Attributes:
        horizon: Steps of each environment between two updates.
        discount: Weight of a reward one step later.
        trace: Weight of longer returns (lambda).
        epochs: Passes over the data of an update, each in ``batches`` parts.
        clip: Largest rewarded change of the probability ratio.
        divergence: Target Kullback-Leibler distance between old and new policy.
        spread: First standard deviation of actions, at last ``least_spread``.
    """

    hidden: tuple[int, ...] = (64, 64)
    horizon: int = 32
    discount: float = 0.995
    trace: float = 0.95
    epochs: int = 5
    batches: int = 4
    clip: float = 0.2
    rate: float = 1e-3
    divergence: float = 0.01
    spread: float = 0.6
    least_spread: float = 0.05


class _Old(NamedTuple):
    """The policy that gathered the data: actions, their means and log probabilities, log spread."""

    actions: Floats
    means: Floats
    chance: Floats
    log_spread: Floats


class Ppo:
    """Actor, critic and optimisers; ``generator`` draws first weights, actions and the order of the data."""

    def __init__(self, environment: BatchEnvironment, settings: PpoSettings, generator: np.random.Generator) -> None:
        self.environment = environment
        self.settings = settings
        self.generator = generator
        seen, extra, actions = environment.observation_size, environment.privileged_size, environment.action_size
        self.actor = Mlp((seen, *settings.hidden, actions), generator, last=0.1)
        self.critic = Mlp((seen + extra, *settings.hidden, 1), generator)
        self.log_spread = np.full(actions, np.log(settings.spread), dtype=np.float32)
        self._adam_actor = Adam([*self.actor.parameters, self.log_spread])
        self._adam_critic = Adam(self.critic.parameters)
        self.rate = settings.rate

    def update(self, remaining: float = 1.0) -> dict[str, float]:
        """Gather data with the present policy and improve it.

        ``remaining`` is the remaining share of the training, which caps the learning rate. Returns mean reward per
        step, divergence, spread and the critic's loss, or raises a FaultError for a parameter that is not finite.
        """
        data, reward = self._gather()
        measured = self._improve(data, remaining)
        finite_or_diverged((*self.actor.parameters, *self.critic.parameters, self.log_spread))
        return {"reward": reward, **measured}

    def _gather(self) -> tuple[tuple[Floats, ...], float]:
        s, env = self.settings, self.environment
        n, t = env.count, s.horizon
        seen = np.empty((t, n, env.observation_size + env.privileged_size), dtype=np.float32)
        actions = np.empty((t, n, env.action_size), dtype=np.float32)
        means = np.empty_like(actions)
        values, rewards, after = (np.empty((t, n), dtype=np.float32) for _ in range(3))
        overs = np.empty((t, n), dtype=np.bool_)
        spread = np.exp(self.log_spread)
        for k in range(t):
            seen[k] = np.concatenate(env.observe(), axis=1)
            values[k] = self.critic.forward(seen[k])[:, 0]
            means[k] = self.actor.forward(seen[k, :, : env.observation_size])
            noise = self.generator.standard_normal((n, env.action_size), dtype=np.float32)
            actions[k] = means[k] + spread * noise
            rewards[k], overs[k] = env.step(np.clip(actions[k], -1.0, 1.0))
            if overs[k].any() or k == t - 1:
                # A time limit does not end the task: bootstrap from the last value.
                after[k] = self.critic.forward(np.concatenate(env.observe(), axis=1))[:, 0]
                env.restart(overs[k])
            if k:
                after[k - 1] = np.where(overs[k - 1], after[k - 1], values[k])
        advantages = np.empty_like(rewards)
        running = np.zeros(n, dtype=np.float32)
        for k in range(t - 1, -1, -1):
            surprise = rewards[k] + np.float32(s.discount) * after[k] - values[k]
            running = surprise + np.float32(s.discount * s.trace) * np.where(overs[k], np.float32(0.0), running)
            advantages[k] = running
        returns = advantages + values
        flat = [seen, actions, means, advantages[..., None], returns[..., None]]
        return tuple(each.reshape(t * n, -1) for each in flat), float(rewards.mean())

    def _improve(self, data: tuple[Floats, ...], remaining: float) -> dict[str, float]:
        seen, actions, means, advantages, returns = data
        s, observed = self.settings, self.environment.observation_size
        advantages = (advantages - advantages.mean()) / (advantages.std() + np.float32(1e-8))
        before = self.log_spread.copy()
        chance_before = _log_chance(actions, means, before)
        size = len(seen) // s.batches
        divergences, losses = [], []

        def criticise(rows: NDArray[np.intp], rate: float) -> float:
            error = self.critic.forward(seen[rows]) - returns[rows]
            self._adam_critic.step(self.critic.backward(error / np.float32(size)), rate)
            return float(np.mean(error * error))

        # Actor and critic share nothing: two threads give the same bits.
        with ThreadPoolExecutor(1) as executor:
            for _ in range(s.epochs):
                order = self.generator.permutation(len(seen))
                for part in range(s.batches):
                    rows = order[part * size : (part + 1) * size]
                    loss = executor.submit(criticise, rows, self.rate)
                    old = _Old(actions[rows], means[rows], chance_before[rows], before)
                    divergences.append(self._follow_advantages(seen[rows, :observed], old, advantages[rows], remaining))
                    losses.append(loss.result())
        return {
            "divergence": float(np.mean(divergences)),
            "spread": float(np.exp(self.log_spread).mean()),
            "critic": float(np.mean(losses)),
        }

    def _follow_advantages(self, x: Floats, old: _Old, gain: Floats, remaining: float) -> float:
        s, size = self.settings, len(x)
        mean = self.actor.forward(x)
        variance = np.exp(2.0 * self.log_spread)
        deviation = old.actions - mean
        ratio = np.exp(_log_chance(old.actions, mean, self.log_spread) - old.chance)
        blocked = ((gain > 0.0) & (ratio > 1.0 + s.clip)) | ((gain < 0.0) & (ratio < 1.0 - s.clip))
        weight = np.where(blocked, np.float32(0.0), -gain * ratio) / np.float32(size)
        beyond = np.clip(mean, -1.1, 1.1)
        slope = weight * deviation / variance + np.float32(0.02 / size) * (mean - beyond)
        spread_slope = np.sum(weight * (deviation * deviation / variance - 1.0), axis=0)
        moved = _divergence(old.means, old.log_spread, mean, self.log_spread)
        if moved > 2.0 * s.divergence:
            self.rate = max(self.rate / 1.5, 1e-5)
        elif moved < 0.5 * s.divergence:
            self.rate = min(self.rate * 1.5, 3e-3 * max(remaining, 0.05))
        self._adam_actor.step([*self.actor.backward(slope), spread_slope], self.rate)
        np.maximum(self.log_spread, np.log(s.least_spread), out=self.log_spread)
        return moved

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        state: dict[str, NDArray[Any]] = {"rate": np.array(self.rate), "log_spread": self.log_spread}
        for name, network in (("actor", self.actor), ("critic", self.critic)):
            state |= {f"{name}_{k}": each for k, each in enumerate(network.parameters)}
        for name, adam in (("adam_actor", self._adam_actor), ("adam_critic", self._adam_critic)):
            state |= {f"{name}_{key}": each for key, each in adam.state().items()}
        return state

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Resume from a checkpoint."""
        self.rate = float(state["rate"])
        self.log_spread[...] = state["log_spread"]
        for name, network in (("actor", self.actor), ("critic", self.critic)):
            for k, each in enumerate(network.parameters):
                each[...] = state[f"{name}_{k}"]
        for name, adam in (("adam_actor_", self._adam_actor), ("adam_critic_", self._adam_critic)):
            adam.restore({key.removeprefix(name): each for key, each in state.items() if key.startswith(name)})


def finite_or_diverged(parameters: Iterable[Floats]) -> None:
    """Raise a FaultError if a parameter is not finite."""
    if not all(np.isfinite(each).all() for each in parameters):
        raise FaultError("training diverged: a weight is no longer finite; expected another seed")


def _log_chance(actions: Floats, means: Floats, log_spread: Floats) -> Floats:
    scaled = (actions - means) * np.exp(-log_spread)
    return np.sum(-0.5 * scaled * scaled - log_spread, axis=1, keepdims=True, dtype=np.float32)


def _divergence(old: Floats, old_log: Floats, new: Floats, new_log: Floats) -> float:
    variance = np.exp(2.0 * (old_log - new_log))
    shift = np.square(old - new) * np.exp(-2.0 * new_log)
    return float(np.mean(np.sum(new_log - old_log + 0.5 * (variance + shift - 1.0), axis=1)))
