"""Plants on which a policy learns, each with its own parameters, delay and noise. One joint is n = 1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array, Floats
from pendulum_learning.body import body_of, start_spread, travel_of, velocity_scales
from pendulum_learning.task import SwingUpTask
from pendulum_lqr.policies.policy import default_signals, sample_layout
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["SwingUp"]

_KICK_TIME = 0.05
_EDGE, _END = 0.55, 0.7
"""Shares of the way to the stop from which moving on costs, and costs most [-]; the travel ends at 0.8."""
_PRICE, _LAST_PRICE = 2.0, 5.0
"""Largest cost in the first and the last third of a training: a policy that may never go there does not learn to swing
up; one that has learned it can do without."""
_MIDDLE = 0.5
"""Share of the way to the stop that counts as near the middle: from rest far from it a joint cannot recover."""
_AGAIN, _UP, _LEARNED = 0.75, 0.3, 0.6
"""With a passive joint: chance that a plant is drawn again after an episode that did not end upright [rad] or left its
travel, and the share of the training after which: hard plants are rare and else not learned, but a policy that cannot
swing up yet must train on all."""
_ENDS = 0.5
"""Of one joint, the share of parameters at an end of their range: in even draws, plants with several extremes are too
rare for a policy to learn to brake them."""
_SPUN, _FASTEST_SPIN = 0.1, 3.0
"""Of one joint, the share of episodes that begin at any speed up to this many scales: else no plant in training
spins."""
_HELD, _FULL = 0.1, 1.5
"""Of one joint, the share of episodes that begin where gravity and effort balance, which dry friction and a constant
command would hold for ever; efforts are drawn up to this many limits and clipped, as most get stuck at the limit."""
_MOST_DRAWS = 50


class SwingUp:
    """N plants of n joints, m driven, under one policy; a ParameterError for springs, no motor, or a delay."""

    def __init__(
        self,
        count: int,
        plant: PlantParameters,
        ranges: Mapping[str, tuple[float, float]],
        task: SwingUpTask,
        generator: np.random.Generator,
    ) -> None:
        self.count = count
        self.plant, self.task, self._ranges = plant, task, dict(ranges)
        self._generator = generator
        self.body = body = body_of(plant, ranges, task.travel)
        coordinates = body.coordinates
        n = len(coordinates.joints)
        self._n, self._driven = n, list(coordinates.driven)
        self._goal = np.array(coordinates.goal)
        self._turns = np.array([joint.turns for joint in coordinates.joints])
        self._layout = sample_layout(default_signals(coordinates), coordinates)
        self.observation_size = task.history * len(self._layout)
        self.action_size = len(self._driven)
        self.reach = np.array(travel_of(plant, task.travel))
        self.limit = body.limits
        self.scale = np.array(velocity_scales(plant, task.travel))
        self._furthest, self._fastest = start_spread(plant, task.travel, self.scale.tolist())
        self.step_limit = 2.0 * self.limit * task.period / task.rate_time
        # Columns: n positions from upright, n velocities, n efforts of the actuators, n acting, n pending commands, and
        # when those arrive.
        self.motion = np.zeros((count, 5 * n + 1))
        self.parameters = np.repeat(body.row[None, :], count, axis=0)
        self.delay, self.effort = np.zeros(count), np.zeros((count, self.action_size))
        self.push = np.zeros((count, n))
        self.progress = 0.0
        self._zero, self._astray = np.zeros((count, n)), np.zeros(count, dtype=np.bool_)
        self._kick_left, self._left = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        self._steps = max(1, round(task.episode / task.period))
        self._samples = np.zeros((count, self.observation_size), dtype=np.float32)
        self.privileged_size = 0
        self.restart(np.ones(count, dtype=np.bool_))
        self.privileged_size = self.observe()[1].shape[1]
        # Episodes must not all end at once.
        self._left[:] = generator.integers(1, self._steps + 1, count)

    def observe(self) -> tuple[Floats, Floats]:
        """Return the samples, shape (N, history s), and the true state, plant and delay, shape (N, k)."""
        n, turns = self._n, self._turns
        x, v = self.motion[:, :n], self.motion[:, n : 2 * n]
        extra = [
            np.cos(x[:, turns]), np.sin(x[:, turns]), x[:, ~turns] / self.reach[~turns], v / self.scale,
            self.push / self.body.kicks, self.delay[:, None] / (2.0 * self.task.period),
            *(each[:, None] for each in self.body.privileged(self.parameters)),
        ]  # fmt: skip
        return self._samples.copy(), np.concatenate(extra, axis=1).astype(np.float32)

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Apply rate-limited efforts, actions times the limit; return rewards and finished episodes."""
        task, draw, n = self.task, self._generator, self._n
        change = self.limit * actions.astype(np.float64) - self.effort
        change = np.clip(change, -self.step_limit, self.step_limit)
        self.effort = self.effort + change
        self._kick()
        late = np.maximum(0.0, self.delay + task.jitter * draw.standard_normal(self.count))
        efforts = np.zeros((self.count, n))
        efforts[:, self._driven] = self.effort
        self.body.advance(self.motion, self.parameters, efforts, late, self.push, task.period, self.body.longest)
        self._sample()
        slides = ~self._turns
        self._astray |= np.any(np.abs(self.motion[:, :n][:, slides]) > task.travel, axis=1)
        self._left -= 1
        return (0.05 * self._reward(change)).astype(np.float32), self._left <= 0

    def _reward(self, change: Array) -> Array:
        """Return the reward for height and nearness to rest upright, less the costs of effort, change and travel.

        Each turning joint adds as much for rest upright: else one of two could spin with the other upright.
        """
        n, turns = self._n, self._turns
        x, v = self.motion[:, :n], self.motion[:, n : 2 * n]
        away = np.where(turns, wrap(x) / 0.25, x / (_MIDDLE * self.reach))
        far = np.sum(away**2, axis=1) + np.sum((v / (0.5 * self.scale)) ** 2, axis=1)
        near = np.count_nonzero(turns) * np.exp(-far)
        u = self.effort / self.limit
        slid = np.abs(x[:, ~turns]) / self.reach[~turns]
        own = self.body.excess
        # Without a motor at each joint, pumping and braking are the task, so both are rewarded.
        lost = 0.5 * np.minimum(1.0, np.abs(own(x, v, self.parameters))) if own is not None else 0.0
        return (
            0.5 * self.body.height(x) + near - np.sum(0.05 * u * u, axis=1)
            - np.sum(0.2 * (change / self.step_limit) ** 2 * 0.25, axis=1)
            - np.sum(0.02 * np.maximum(0.0, np.abs(v[:, turns]) / self.scale[turns] - 2.5) ** 2, axis=1)
            - np.sum(0.1 * slid**2 + 5.0 * np.maximum(0.0, slid - _EDGE) + self._price() * (slid > _END), axis=1) - lost
        )  # fmt: skip

    def _price(self) -> float:
        return _PRICE + (_LAST_PRICE - _PRICE) * min(1.0, max(0.0, 3.0 * self.progress - 1.0))

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Start new episodes: half anywhere (some spinning or held), a quarter hanging, a quarter near upright."""
        rows = np.flatnonzero(which)
        if not rows.size:
            return
        draw, size, task, n = self._generator, rows.size, self.task, self._n
        self._draw_plants(rows[~self._meets_again(rows)])
        offsets = draw.uniform(-1.0, 1.0, (size, self.action_size)) * task.offset * self.limit
        self.parameters[np.ix_(rows, np.array(self.body.offsets))] = offsets
        self._zero[rows] = draw.uniform(-1.0, 1.0, (size, n)) * task.offset
        self.delay[rows] = draw.uniform(0.0, 1.0, size) * task.delay
        self._astray[rows] = False
        kind = draw.uniform(0.0, 1.0, (size, 1))
        anywhere = draw.uniform(-self._furthest, self._furthest, (size, n))
        hanging = np.where(self._turns, self._goal, -self._goal)
        position = np.where(kind < 0.5, anywhere, np.where(kind < 0.75, hanging, 0.0))
        self.motion[rows] = 0.0
        self.motion[rows, :n] = position + 0.05 * draw.standard_normal((size, n))
        self.motion[rows, n : 2 * n] = np.where(kind < 0.5, self._fastest, 0.1) * draw.standard_normal((size, n))
        self.effort[rows], self.push[rows] = 0.0, 0.0
        if self.body.held is not None:
            spun = rows[kind[:, 0] < _SPUN]
            self.motion[spun, n : 2 * n] = draw.uniform(-_FASTEST_SPIN, _FASTEST_SPIN, (spun.size, n)) * self.scale
            self._hold(rows[(kind[:, 0] >= 0.5 - _HELD) & (kind[:, 0] < 0.5)], self.body.held)
        self._kick_left[rows], self._left[rows] = 0, self._steps
        first = self._measure(rows)
        self._samples[rows] = np.tile(first, (1, task.history))

    @property
    def states(self) -> Array:
        """Deviations from upright and velocities, shape (N, 2n) [rad or m, rad/s or m/s]."""
        return self.motion[:, : 2 * self._n].copy()

    def start_at(self, rows: NDArray[np.intp], states: Array, efforts: Array) -> None:
        """Move rows of episodes that just began to other starts.

        ``states``: deviations from upright and velocities, shape (k, 2n); ``efforts``: last commands, shape (k, m).
        """
        n = self._n
        self.motion[rows] = 0.0
        self.motion[rows, : 2 * n] = states
        for first in (2 * n, 3 * n, 4 * n):
            self.motion[np.ix_(rows, first + np.array(self._driven))] = efforts
        self.effort[rows] = efforts
        self._samples[rows] = np.tile(self._measure(rows), (1, self.task.history))

    def _hold(self, rows: NDArray[np.intp], held: Callable[[Array, Array, NDArray[np.bool_]], Array]) -> None:
        draw, n = self._generator, self._n
        efforts = self.limit * np.clip(draw.uniform(-_FULL, _FULL, (rows.size, n)), -1.0, 1.0)
        above = draw.uniform(0.0, 1.0, rows.size) < 0.5
        self.effort[rows], self.motion[rows] = efforts, 0.0
        self.motion[rows, :n] = held(self.parameters[rows], efforts, above)
        self.motion[rows, 2 * n : 5 * n] = np.tile(efforts, (1, 3))

    def _meets_again(self, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        if self.body.excess is None or self.progress < _LEARNED:
            return np.zeros(rows.size, dtype=np.bool_)
        down = np.any(np.abs(wrap(self.motion[rows, : self._n][:, self._turns])) > _UP, axis=1)
        found: NDArray[np.bool_] = (down | self._astray[rows]) & (self._generator.uniform(0.0, 1.0, rows.size) < _AGAIN)
        return found

    def _draw_plants(self, rows: NDArray[np.intp]) -> None:
        for _ in range(_MOST_DRAWS):
            for name, (low, high) in self._ranges.items():
                if name.rpartition(".")[2] != "static_friction":
                    self.parameters[rows, self.body.columns[name]] = self._values(low, high, rows.size)
            for static, coulomb, ratio in self.body.ratios:
                self.parameters[rows, static] = ratio * self.parameters[rows, coulomb]
            rows = rows[~self.body.possible(self.parameters[rows])]
            if not rows.size:
                return
        self.parameters[rows] = self.body.row

    def _values(self, low: float, high: float, size: int) -> Array:
        values = self._generator.uniform(low, high, size)
        if self.body.held is None:
            return values
        nearest = np.where(values < 0.5 * (low + high), low, high)
        return np.where(self._generator.uniform(0.0, 1.0, size) < _ENDS, nearest, values)

    def state(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {
            "motion": self.motion, "parameters": self.parameters, "delay": self.delay, "effort": self.effort,
            "push": self.push, "zero": self._zero, "kick_left": self._kick_left, "left": self._left,
            "samples": self._samples, "astray": self._astray,
        }  # fmt: skip

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Resume from a checkpoint."""
        for name, array in self.state().items():
            array[...] = state[name]

    def _kick(self) -> None:
        draw, task = self._generator, self.task
        begins = draw.uniform(0.0, 1.0, self.count) < task.kick_rate * task.period
        torque = draw.uniform(-1.0, 1.0, (self.count, self._n)) * task.kick * self.body.kicks
        begins &= self._kick_left == 0
        self._kick_left[begins] = max(1, round(_KICK_TIME / task.period))
        self.push = np.where(begins[:, None], torque, np.where(self._kick_left[:, None] > 0, self.push, 0.0))
        self._kick_left = np.maximum(0, self._kick_left - 1)

    def _measure(self, rows: NDArray[np.intp] | slice) -> Floats:
        n = self._n
        x, v = self.motion[rows, :n], self.motion[rows, n : 2 * n]
        noise = self._generator.standard_normal((len(x), 2 * n))
        position = x + self._zero[rows] + self.task.angle_noise * noise[:, :n]
        seen = {
            "cos": np.cos(position),
            "sin": np.sin(position),
            "position": position / self.reach,
            "velocity": (v + self.task.velocity_noise * noise[:, n:]) / self.scale,
            "effort": np.zeros_like(position),
        }
        seen["effort"][:, self._driven] = self.effort[rows] / self.limit
        sample = np.stack([seen[signal][:, joint] for signal, joint in self._layout], axis=1)
        return sample.astype(np.float32)

    def _sample(self) -> None:
        size = len(self._layout)
        self._samples[:, :-size] = self._samples[:, size:].copy()
        self._samples[:, -size:] = self._measure(slice(None))
