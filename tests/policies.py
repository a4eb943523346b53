"""Policies for tests: small networks with known answers, for a plant."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from pendulum_lqr.policy import DEFAULT_SIGNALS, Network, Policy
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["linear_policy", "random_policy"]


def random_policy(
    plant: PlantParameters, *, hidden: tuple[int, ...] = (8, 8), history: int = 3, seed: int = 0, **changes: Any
) -> Policy:
    """Return a policy of random weights for a plant."""
    sizes = (history * len(changes.get("signals", DEFAULT_SIGNALS)), *hidden, 1)
    return _policy(plant, _network(sizes, seed, changes.pop("activation", "tanh"), changes.pop("output", "clip")),
                   history=history, **changes)  # fmt: skip


def linear_policy(plant: PlantParameters, angle_gain: float, velocity_gain: float, **changes: Any) -> Policy:
    """Return the policy u = -angle_gain sin(x) - velocity_gain theta_dot, within the plant's limit."""
    weight = np.zeros((1, len(DEFAULT_SIGNALS)), dtype=np.float32)
    weight[0, 1:3] = -angle_gain / plant.effort_limit, -velocity_gain / plant.effort_limit
    return _policy(plant, Network((weight,), (np.zeros(1, dtype=np.float32),)), **changes)


def _network(sizes: tuple[int, ...], seed: int, activation: str, output: str) -> Network:
    rng = np.random.default_rng(seed)
    pairs = list(pairwise(sizes))
    weights = tuple(rng.normal(0.0, 1.0 / math.sqrt(n), (m, n)).astype(np.float32) for n, m in pairs)
    biases = tuple(rng.normal(0.0, 0.1, m).astype(np.float32) for _, m in pairs)
    return Network(weights, biases, activation, output)


def _policy(plant: PlantParameters, network: Network, **changes: Any) -> Policy:
    values: dict[str, Any] = {
        "name": "test", "task": "swing_up", "joints": (JOINT,), "period": 0.01, "plant": plant, "ranges": {},
        "effort_limit": (plant.effort_limit,), "effort_rate": (math.inf,), "velocity_scale": (1.0,),
        "angle_box": (math.pi,), "velocity_box": (20.0,),
    }  # fmt: skip
    return Policy(network=network, **{**values, **changes})
