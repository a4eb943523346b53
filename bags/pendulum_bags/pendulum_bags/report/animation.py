"""The animation of a report: both plants drawn over each other, small deviations enlarged and labelled so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison import Comparison
from pendulum_bags.report.data import ReportData
from pendulum_bags.runs.series import uniform_times
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

__all__ = ["animation_of", "joint_animation"]

FRAMES_PER_SECOND = 50.0
WIDEST_SWING = 0.5
"""Largest drawn deviation [rad or m]: what is smaller is enlarged up to it."""
LARGEST_FACTOR = 200.0
WIDTH, HEIGHT, MARGIN = 640, 300, 24
"""Size of the picture of several joints, and what stays free at its edges [px]."""


def animation_of(data: ReportData) -> dict[str, Any]:
    """Return frames of both pendulums: deviation from upright [rad], torque [N m], and the factor of enlargement."""
    pair = data.comparison.pairs[0]
    sim, hw = pair.simulation.window, pair.hardware.window
    stop = min(float(sim.t[-1]), float(hw.t[-1]))
    times = uniform_times(max(float(sim.t[0]), float(hw.t[0]), 0.0), stop, 1.0 / FRAMES_PER_SECOND)
    tracks = {}
    largest = 1e-9
    for name, series in (("sim", sim), ("hw", hw)):
        angle = np.interp(times, series.t, series.position - np.pi)
        largest = max(largest, float(np.abs(angle).max()))
        tracks[name] = np.round(angle, 6).tolist()
    return {"period": 1.0 / FRAMES_PER_SECOND, "factor": _enlarged(largest), **tracks}


def joint_animation(comparisons: Mapping[str, Comparison], plant: str) -> dict[str, Any] | None:
    """Return frames of both plants as points of their links [px] and the enlargement, or None for an unknown plant."""
    try:
        parameters = load_mechanism(plant)
    except ParameterError:
        return None
    coordinates = parameters.coordinates
    if coordinates.names != tuple(comparisons):
        return None
    pairs = [comparison.pairs[0] for comparison in comparisons.values()]
    sides = {"sim": [pair.simulation.window for pair in pairs], "hw": [pair.hardware.window for pair in pairs]}
    begin = max(float(series.t[0]) for each in sides.values() for series in each)
    stop = min(float(series.t[-1]) for each in sides.values() for series in each)
    times = uniform_times(max(begin, 0.0), stop, 1.0 / FRAMES_PER_SECOND)
    goal = np.array(coordinates.goal)
    off = {
        side: np.column_stack([np.interp(times, one.t, one.position) for one in each]) - goal
        for side, each in sides.items()
    }
    factor = _enlarged(max(1e-9, *(float(np.abs(values).max()) for values in off.values())))
    points = {side: _chains(parameters, goal + factor * values) for side, values in off.items()}
    low = np.min([values.min(axis=(0, 1)) for values in points.values()], axis=0)
    high = np.max([values.max(axis=(0, 1)) for values in points.values()], axis=0)
    room = np.array([WIDTH, HEIGHT]) - 2.0 * MARGIN
    scale = float(np.min(room / np.maximum(high - low, 1e-9)))
    middle, up = 0.5 * (low + high), np.array([1.0, -1.0])
    frames = {
        side: np.round(0.5 * np.array([WIDTH, HEIGHT]) + scale * up * (values - middle), 1).tolist()
        for side, values in points.items()
    }
    return {"period": 1.0 / FRAMES_PER_SECOND, "factor": factor, **frames}


def _chains(parameters: PlantParameters, positions: Array) -> Array:
    """Return where the ends of all links are, to the right and up, shape (frames, points, 2) [m]."""
    mechanism, packed = parameters.mechanism, parameters.packed
    return np.array([[mechanism.seen(point) for point in mechanism.chain(tuple(q), packed)] for q in positions])


def _enlarged(largest: float) -> float:
    return min(max(1.0, float(np.floor(WIDEST_SWING / largest))), LARGEST_FACTOR)
