"""A swing-up with its tracking gains as a law of the state alone, which a network can imitate.

The law of the nearest node applies, by the tracking's own cost; the last node is upright::

    k = argmin_k e_k' P_k e_k,  e_k = x - x_k (wrapped where a joint turns),  u = clamp(u_k - K_k e_k)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_lqr.swing_up.stored_swing_up import tracked_swing_up
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["Teacher", "TeacherOutput"]


class TeacherOutput(NamedTuple):
    """A teacher's output for N states.

    Attributes:
        efforts: Within the limits, shape (N, m) [N m or N].
        cost: Of the deviation from the nearest node, 1 at the edge of the upright LQR's region, shape (N,).
    """

    efforts: Array
    cost: Array


class Teacher:
    """The stored swing-up of a plant, or a ParameterError, tracked from any state near it at ``period`` [s].

    Attributes:
        states: Its nodes, deviations from upright and velocities, shape (K, 2n).
        efforts: At the nodes, shape (K, m) [N m or N].
    """

    def __init__(self, plant: PlantParameters, period: float) -> None:
        tracked = tracked_swing_up(plant, period)
        n, m = len(plant.joints), len(plant.effort_limits)
        self._limits = np.array(plant.effort_limits)
        self._turns = np.array([*(joint.turns for joint in plant.mechanism.joints), *([False] * n)])
        goal = np.array([*plant.coordinates.goal, *([0.0] * n)])
        gain = tracked.catch.gain
        self.states = np.vstack([tracked.states[:-1] - goal, np.zeros(2 * n)])
        self.efforts = np.vstack([tracked.planned, np.zeros(m)])
        self._gains = np.concatenate([tracked.gains, gain.rows[None]])
        self._costs = np.concatenate([tracked.costs[:-1], gain.S[None]]) / tracked.catch.region.level
        upright = _nearest(self.states, self.states[-1:], self._costs[-1:], self._turns)[1]
        self.moving = int(np.flatnonzero(upright > 1.0)[-1]) + 1
        # A unit vector times these is a deviation of cost 1.
        self._roots = np.linalg.inv(np.linalg.cholesky(self._costs)).transpose(0, 2, 1)

    def output(self, states: Array) -> TeacherOutput:
        """Return the efforts for deviations from upright and velocities, shape (N, 2n)."""
        nearest, cost = _nearest(states, self.states, self._costs, self._turns)
        error = states - self.states[nearest]
        error[:, self._turns] = wrap(error[:, self._turns])
        efforts = self.efforts[nearest] - np.einsum("kij,kj->ki", self._gains[nearest], error)
        return TeacherOutput(np.clip(efforts, -self._limits, self._limits), cost)

    def around(self, nodes: NDArray[np.intp], cost: float, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return random states around nodes, up to a cost, and the efforts that act there: those of the node before."""
        direction = generator.standard_normal((nodes.size, self.states.shape[1]))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        # Most of them near the node, where commands have to be exact.
        direction *= np.sqrt(cost) * generator.random((nodes.size, 1)) ** 2
        states = self.states[nodes] + np.einsum("kij,kj->ki", self._roots[nodes], direction)
        return states, np.where(nodes[:, None] > 0, self.efforts[nodes - 1], 0.0)


@numba.njit(cache=True)
def _nearest(states: Any, nodes: Any, costs: Any, turns: Any) -> Any:
    count, size = states.shape
    found, least = np.zeros(count, np.int64), np.full(count, np.inf)
    error = np.empty(size)
    for i in range(count):
        for k in range(len(nodes)):
            cost = 0.0
            for a in range(size):
                away = states[i, a] - nodes[k, a]
                if turns[a]:
                    away -= 2.0 * np.pi * np.floor((away + np.pi) / (2.0 * np.pi))
                error[a] = away
                for b in range(a):
                    cost += 2.0 * away * costs[k, a, b] * error[b]
                cost += away * costs[k, a, a] * away
            if cost < least[i]:
                found[i], least[i] = k, cost
    return found, least
