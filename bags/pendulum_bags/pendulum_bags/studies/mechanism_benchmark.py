"""The public double-pendulum benchmark: its criteria, its scores, its published rows.

    score v1 = success (1 - sum over the criteria of weight criterion / norm)
    score v2 = success (1 - mean over the criteria of tanh(pi criterion / norm))
    score v3 = seconds above the line / 60

Up is a tip above nine tenths of the arms' length, success to be up at the end. Definitions, norms and rows follow the
public implementation, also where it differs from the paper: it computed the rows.

Sources: F. Wiebe et al., Open-source dual-purpose acrobot and pendubot platform, IEEE RAM 31(2), 2024; F. Wiebe et al.,
Reinforcement learning for athletic intelligence, IJCAI 2024; github.com/dfki-ric-underactuated-lab/double_pendulum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

__all__ = [
    "BENCHMARK_PLANTS",
    "CRITERIA",
    "CRITERIA_HARDWARE",
    "CRITERIA_V1",
    "PUBLISHED",
    "Criterion",
    "Published",
    "benchmark_plant",
    "bounded_share",
    "criteria_of",
    "is_above_line",
    "line_height",
    "score_v1",
    "score_v2",
    "time_above_line",
    "weighted_share",
]

BENCHMARK_PLANTS = ("acrobot", "pendubot")
"""The robots of the benchmark: a motor of 6 N m at the elbow, or at the shoulder."""
_LINE = 0.9


class Criterion(NamedTuple):
    """What a swing-up costs."""

    name: str
    title: str
    unit: str
    norm: float
    weight: float = 1.0


CRITERIA = (
    Criterion("swingup_time", "time", "s", 20.0),
    Criterion("energy", "energy", "J", 60.0),
    Criterion("torque_cost", "torque cost", "N² m² s", 20.0),
    Criterion("torque_smoothness", "smoothness", "N m", 0.1),
    Criterion("velocity_cost", "velocity cost", "rad²/s", 400.0),
)
"""The criteria of score v2 in simulation, all of the same weight."""
CRITERIA_HARDWARE = tuple(
    one._replace(norm={"torque_cost": 100.0, "torque_smoothness": 4.0}.get(one.name, one.norm)) for one in CRITERIA
)
"""Those of score v2 on hardware."""
CRITERIA_V1 = (
    Criterion("swingup_time", "time", "s", 10.0, 0.2),
    Criterion("max_torque", "largest torque", "N m", 6.0, 0.1),
    Criterion("energy", "energy", "J", 100.0, 0.1),
    Criterion("torque_integral", "torque integral", "N m s", 60.0, 0.1),
    Criterion("torque_cost", "torque cost", "N² m² s", 360.0, 0.1),
    Criterion("torque_smoothness", "smoothness", "N m", 12.0, 0.2),
    Criterion("velocity_cost", "velocity cost", "rad²/s", 1000.0, 0.2),
)
"""Those of score v1, in simulation and on hardware."""


@dataclass(frozen=True)
class Published:
    """A row of the public boards: score v2 (or None), overall robustness v2, and score v3 of 2025."""

    method: str
    plant: str
    score: float | None = None
    robustness: float | None = None
    uptime_score: float | None = None


PUBLISHED = (
    Published("History-SAC", "acrobot", 0.655, 0.751),
    Published("AR-EAPO", "acrobot", 0.633, 0.727, 0.658),
    Published("EvolSAC", "acrobot", 0.524, 0.687),
    Published("TVLQR", "acrobot", 0.504, 0.607),
    Published("iLQR-Riccati", "acrobot", 0.396, 0.138),
    Published("iLQR-MPC", "acrobot", 0.345, 0.343),
    Published("MC-PILCO", "acrobot", 0.316, 0.241),
    Published("VIMPPI", "acrobot", uptime_score=0.648),
    Published("acados NMPC", "acrobot", uptime_score=0.630),
    Published("History-SAC", "pendubot", 0.682, 0.770),
    Published("AR-EAPO", "pendubot", 0.659, 0.913, 0.759),
    Published("EvolSAC", "pendubot", 0.596, 0.786),
    Published("TVLQR", "pendubot", 0.526, 0.767),
    Published("iLQR-Riccati", "pendubot", 0.536, 0.255),
    Published("iLQR-MPC", "pendubot", 0.353, 0.674),
    Published("MC-PILCO", "pendubot", 0.480, 0.614),
    Published("VIMPPI", "pendubot", uptime_score=0.799),
    Published("acados NMPC", "pendubot", uptime_score=0.726),
)
"""Rows of the public boards (simulation v2, robustness v2, simulation v3), as read in 2025."""


def benchmark_plant(name: str) -> PlantParameters:
    """Return the plant that the benchmark's boards simulate: design C.1 without friction and rotors, 6 N m."""
    if name not in BENCHMARK_PLANTS:
        raise ParameterError(f"plant {name!r} is not in the benchmark; expected {' or '.join(BENCHMARK_PLANTS)}")
    return load_mechanism(f"{name}_frictionless")


def is_above_line(plant: PlantParameters, states: Array) -> NDArray[np.bool_]:
    """Return whether the tip is above the line, for states [shoulder, elbow, their velocities], shape (N, 4)."""
    chain = in_arithmetic(plant.mechanism.chain, np)
    height = chain((states[:, 0], states[:, 1]), plant.packed)[-1][2]
    return np.asarray(height > line_height(plant), dtype=np.bool_)


def line_height(plant: PlantParameters) -> float:
    """Return the height above the base from which a double pendulum's tip is up [m]."""
    return _LINE * (plant.value("length_1") + plant.value("length_2"))


def criteria_of(plant: PlantParameters, times: Array, states: Array, efforts: Array) -> dict[str, float]:
    """Return the criteria of a recorded swing-up.

    ``swingup_time`` is when the tip rises above the line for good, else the last sample's time; like the public
    implementation it ignores the first and the last sample.

    Args:
        times: Of the samples, shape (N,) [s].
        states: [shoulder, elbow, their velocities] at these times, shape (N, 4).
        efforts: Torques from each of these times on, both joints, shape (N, 2) [N m].
    """
    if not (len(times) == len(states) == len(efforts)) or len(times) < 3:
        raise ParameterError(
            f"times, states and efforts have {len(times)}, {len(states)} and {len(efforts)} rows; "
            "expected as many of each, at least 3"
        )
    inner = is_above_line(plant, states)[1:-1]
    below = np.flatnonzero(~inner)
    entered = 1 if not below.size else int(below[-1]) + 2
    dt = np.diff(times)
    return {
        "swingup_time": float(times[entered]),
        "max_torque": float(np.max(np.abs(efforts))),
        "energy": float(np.sum(np.abs(np.diff(states[:, :2], axis=0) * efforts[:-1]))),
        "torque_integral": float(np.sum(np.abs(efforts[:-1]) * dt[:, None])),
        "torque_cost": float(np.sum(efforts[:-1] ** 2 * dt[:, None])),
        "torque_smoothness": float(np.sum(np.std(np.diff(efforts, axis=0), axis=0))),
        "velocity_cost": float(np.sum(states[:-1, 2:] ** 2 * dt[:, None])),
    }


def weighted_share(criteria: Mapping[str, float], norms: Sequence[Criterion]) -> float:
    """Return what score v1 loses: the weighted sum of the criteria per norm."""
    return sum(one.weight * criteria[one.name] / one.norm for one in norms)


def bounded_share(criteria: Mapping[str, float], norms: Sequence[Criterion]) -> float:
    """Return what score v2 loses: the mean over the criteria of tanh(pi criterion / norm)."""
    return sum(math.tanh(math.pi * criteria[one.name] / one.norm) for one in norms) / len(norms)


def score_v1(criteria: Mapping[str, float], duration: float) -> float:
    """Return score v1 of a swing-up of ``duration`` [s], 0 where the tip was not up at the end."""
    return 1.0 - weighted_share(criteria, CRITERIA_V1) if criteria["swingup_time"] < duration else 0.0


def score_v2(criteria: Mapping[str, float], duration: float, norms: Sequence[Criterion] = CRITERIA) -> float:
    """Return score v2 of a swing-up of ``duration`` [s], 0 where the tip was not up at the end."""
    return 1.0 - bounded_share(criteria, norms) if criteria["swingup_time"] < duration else 0.0


def time_above_line(plant: PlantParameters, times: Array, states: Array) -> float:
    """Return how long the tip was above the line, each sample counting for the interval before it [s]."""
    return float(np.sum(np.diff(times, prepend=0.0)[is_above_line(plant, states)]))
