"""The animated pendulum: both plants drawn over each other, small deviations enlarged and said to be."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_bags.report.data import ReportData
from pendulum_bags.runs.series import uniform_times

__all__ = ["animation_of"]

FRAMES_PER_SECOND = 50.0
WIDEST_SWING = 0.5
"""Largest drawn deviation [rad]: what is smaller is enlarged up to it."""


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
    factor = max(1.0, float(np.floor(WIDEST_SWING / largest)))
    return {"period": 1.0 / FRAMES_PER_SECOND, "factor": min(factor, 200.0), **tracks}
