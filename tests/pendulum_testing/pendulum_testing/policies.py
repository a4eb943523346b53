"""Policies for tests: small networks with known answers, for a plant."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.policies.policy import (
    DEFAULT_SIGNALS,
    Network,
    Policy,
    default_signals,
    sample_layout,
)
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["linear_policy", "lqr_policy", "random_policy"]


def random_policy(
    plant: PlantParameters, *, hidden: tuple[int, ...] = (8, 8), history: int = 3, seed: int = 0, **changes: Any
) -> Policy:
    """Return a policy of random weights for a plant."""
    coordinates = plant.coordinates
    changes.setdefault("signals", default_signals(coordinates))
    layout = sample_layout(changes["signals"], coordinates)
    sizes = (history * len(layout), *hidden, len(coordinates.driven))
    return _policy(
        plant,
        _network(sizes, seed, changes.pop("activation", "tanh"), changes.pop("output", "clip")),
        history=history,
        **changes,
    )


def linear_policy(plant: PlantParameters, angle_gain: float, velocity_gain: float, **changes: Any) -> Policy:
    """Return the policy u = -angle_gain sin(x) - velocity_gain theta_dot, within the plant's limit."""
    weight = np.zeros((1, len(DEFAULT_SIGNALS)), dtype=np.float32)
    weight[0, 1:3] = -angle_gain / plant.effort_limit, -velocity_gain / plant.effort_limit
    return _policy(plant, Network((weight,), (np.zeros(1, dtype=np.float32),)), **changes)


def lqr_policy(plant: PlantParameters, **changes: Any) -> Policy:
    """Return the policy that answers as the LQR of a plant of several joints does near upright, u = -K [x, q']."""
    gain = output_lqr(linearise(plant), *plant.mechanism.weights).rows
    coordinates = plant.coordinates
    layout = sample_layout(default_signals(coordinates), coordinates)
    n, box = len(coordinates.joints), 0.5
    weight = np.zeros((len(coordinates.driven), len(layout)), dtype=np.float32)
    for column, (signal, joint) in enumerate(layout):
        if signal in {"sin", "position"}:
            weight[:, column] = -gain[:, joint] * (box if signal == "position" else 1.0)
        elif signal == "velocity":
            weight[:, column] = -gain[:, n + joint]
    weight /= np.array(plant.effort_limits, dtype=np.float32)[:, None]
    network = Network((weight,), (np.zeros(len(weight), dtype=np.float32),))
    return _policy(plant, network, signals=default_signals(coordinates), **changes)


def _network(sizes: tuple[int, ...], seed: int, activation: str, output: str) -> Network:
    rng = np.random.default_rng(seed)
    pairs = list(pairwise(sizes))
    weights = tuple(rng.normal(0.0, 1.0 / math.sqrt(n), (m, n)).astype(np.float32) for n, m in pairs)
    biases = tuple(rng.normal(0.0, 0.1, m).astype(np.float32) for _, m in pairs)
    return Network(weights, biases, activation, output)


def _policy(plant: PlantParameters, network: Network, **changes: Any) -> Policy:
    coordinates = plant.coordinates
    n, m = len(coordinates.joints), len(coordinates.driven)
    values: dict[str, Any] = {
        "name": "test",
        "task": "swing_up",
        "joints": coordinates.names,
        "period": 0.01,
        "plant": plant,
        "ranges": {},
        "effort_limit": plant.effort_limits,
        "effort_rate": (math.inf,) * m,
        "velocity_scale": (1.0,) * n,
        "angle_box": tuple(math.pi if joint.turns else 0.5 for joint in coordinates.joints),
        "velocity_box": (20.0,) * n,
    }
    return Policy(network=network, **{**values, **changes})
