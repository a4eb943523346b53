"""Motion of an environment's plants: smooth pendulums compiled, smooth mechanisms as arrays, others one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.environments.environment_kernel import lane_table, step_kernel
from pendulum_sim.environments.environment_task import Array, EnvironmentTask
from pendulum_sim.stepping.mechanism_plant import is_smooth

__all__ = ["Lanes", "Stepped", "make_motion"]

_LANES = 256


class Lanes:
    """``count`` smooth pendulums in one compiled step, noise, reward and observation included.

    ``w`` holds the kernel's rows, one block of lanes after another, ``keys`` those of the noise, ``counts`` the steps
    since the start; ``h`` is the integration step [s].
    """

    def __init__(self, task: EnvironmentTask, count: int) -> None:
        self._task, self._count = task, count
        method = "etd4" if task.method == "auto" else task.method
        self._lanes = lanes = 1 if count == 1 else _LANES
        self.h = task.dt / task.substeps
        blocks = -(-count // lanes)
        table = lane_table(task.parameters, method, self.h, lanes, task.disturbance, tuple(task.q), task.r)
        self.w = np.repeat(table.reshape(1, -1), blocks, axis=0)
        self.keys = np.zeros((blocks, lanes), dtype=np.uint64)
        self.counts = np.zeros((blocks, lanes), dtype=np.int64)
        self._actions = np.zeros((blocks, lanes))
        self._flat = self._actions.reshape(-1)
        self.kernel = step_kernel(method, lanes, torques=task.parameters.has_torques)

    @property
    def steps(self) -> NDArray[np.int64]:
        """Steps since the start of each, shape (N,)."""
        return self.counts.reshape(-1)[: self._count]

    def place(self, which: NDArray[np.intp], x: Array, keys: list[int]) -> None:
        """Start some plants at states x, shape (k, 2)."""
        if self._count == 1:
            # Array indexing would take ten times as long.
            self.w[0, :3] = x[0, 0] + self._task.goal[0], x[0, 1], 0.0
            self.keys[0, 0], self.counts[0, 0] = keys[0], 0
            return
        block, lane = which // self._lanes, which % self._lanes
        self.w[block, lane] = x[:, 0] + self._task.goal[0]
        self.w[block, self._lanes + lane] = x[:, 1]
        self.w[block, 2 * self._lanes + lane] = 0.0
        self.keys[block, lane] = keys
        self.counts[block, lane] = 0

    def step(self, actions: Array) -> tuple[Array, Array]:
        """Hold torques (N, 1) for one step; return observations (N, 2) and rewards (N,)."""
        count = self._count
        self._flat[:count] = actions.reshape(-1)
        blocks = len(self.w)
        observations, rewards = np.empty((blocks, 2 * self._lanes)), np.empty((blocks, self._lanes))
        for block in range(blocks):
            self.kernel(
                self.w[block], self.keys[block], self.counts[block], self._task.hold, self.h, self._task.substeps,
                self._actions[block], observations[block], rewards[block],
            )  # fmt: skip
        reward = rewards.reshape(-1)[:count]
        if not np.isfinite(reward).all():
            raise ParameterError(f"action {int(np.argmin(np.isfinite(reward)))} is not a finite number of N m")
        return observations.reshape(-1, 2)[:count], reward

    def observe(self) -> Array:
        """Return the observations, shape (N, 2)."""
        if self._count == 1:
            return np.array([[from_upright(float(self.w[0, 0])), self.w[0, 1]]])
        position, velocity = self.state
        return np.concatenate([from_upright(position), velocity], axis=1)

    @property
    def state(self) -> tuple[Array, Array]:
        """Positions and velocities, shape (N, 1) each [rad, rad/s]."""
        rows = (self.w[:, row * self._lanes : (row + 1) * self._lanes] for row in range(2))
        position, velocity = (row.reshape(-1, 1)[: self._count] for row in rows)
        return position, velocity

    @property
    def effort(self) -> Array:
        """Torques of the last step in the first block, disturbance included, shape (lanes,) [N m]."""
        found: Array = self.w[0, 2 * self._lanes : 3 * self._lanes]
        return found


class Stepped:
    """``count`` plants of any kind: many smooth mechanisms as arrays, others one after another."""

    def __init__(self, task: EnvironmentTask, count: int) -> None:
        self._task, parameters = task, task.parameters
        arrays = count > 1 and is_smooth(parameters) and not parameters.is_pendulum
        self._plants = [] if arrays else [task.make_plant() for _ in range(count)]
        self._forward = in_arithmetic(parameters.mechanism.forward, np)
        self._along = along_functions(task.joints)
        self.state = np.zeros((count, task.joints)), np.zeros((count, task.joints))
        self.effort = np.zeros(len(task.limits))
        self._keys = [0] * count
        self.steps = np.zeros(count, dtype=np.int64)
        self._still = (0.0,) * task.joints
        self._seen = self.observe()

    def place(self, which: NDArray[np.intp], x: Array, keys: list[int]) -> None:
        """Start some plants at states x, shape (k, 2n)."""
        n = self._task.joints
        for index, own, key in zip(which.tolist(), x, keys, strict=True):
            position, velocity = own[:n] + self._task.goal, own[n:]
            self.state[0][index], self.state[1][index], self._keys[index] = position, velocity, key
            if self._plants:
                self._plants[index].reset(tuple(position.tolist()), tuple(velocity.tolist()))
        self.steps[which] = 0
        self._seen = self.observe()
        self.effort = np.zeros(len(self._task.limits))

    def step(self, actions: Array) -> tuple[Array, Array]:
        """Hold efforts (N, m) for one step; return observations (N, 2n) and rewards (N,)."""
        task = self._task
        effort = task.efforts(actions)
        reward = task.reward(self._seen, effort)
        self.effort = effort[0]
        if task.disturbance > 0.0:
            effort = effort + [task.noise(*each) for each in zip(self._keys, self.steps.tolist(), strict=True)]
        for index, plant in enumerate(self._plants):
            state = plant.step(tuple(effort[index].tolist()), self._still)
            self.state[0][index], self.state[1][index] = state.position, state.velocity
        if not self._plants:
            self._advance(np.clip(effort, -task.limits, task.limits))
        self.steps += 1
        self._seen = self.observe()
        return self._seen.copy(), reward

    def _advance(self, effort: Array) -> None:
        torque = np.zeros_like(self.state[0])
        torque[:, list(self._task.parameters.coordinates.driven)] = effort * np.array(self._task.parameters.gains)
        q, v, tau = (tuple(each.T) for each in (*self.state, torque))
        h, p = self._task.dt / self._task.substeps, self._task.parameters.packed
        for _ in range(self._task.substeps):
            q, v = rk4_joints(self._forward, self._along, q, v, tau, tau, tau, h, p)
        self.state = np.stack(q, axis=1), np.stack(v, axis=1)

    def observe(self) -> Array:
        """Return the observations, shape (N, 2n)."""
        return self._task.observe(*self.state)


def make_motion(task: EnvironmentTask, count: int) -> Lanes | Stepped:
    """Return the motion of ``count`` plants."""
    compiled = task.parameters.is_pendulum and is_smooth(task.parameters) and task.method != "adaptive"
    return Lanes(task, count) if compiled else Stepped(task, count)
