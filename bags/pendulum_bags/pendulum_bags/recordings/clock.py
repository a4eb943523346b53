"""Stamps of a recording: steps back, gaps, repeated ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_rosbag.reader.clock import steps_back

__all__ = ["continued", "first_of_each_stamp", "gap_length", "longest_step"]

_LATEST = 9e9
"""Stamps beyond this do not fit nanoseconds of 64 bits [s]."""


def longest_step(stamps: Array) -> float:
    """Return the longest time between two stamps that is no gap [s]: ten median periods, 0.1 s at least."""
    return max(10.0 * float(np.median(np.diff(stamps))), 0.1) if stamps.size > 1 else 0.1


def gap_length(stamps: Array) -> float:
    """Return a time that counts as a gap between some stamps [s]."""
    return 1.2 * longest_step(stamps)


def continued(time: Array) -> tuple[Array, list[str]]:
    """Return stamps [s] that go on, behind a gap, where a clock stepped back, and a note on each step."""
    notes: list[str] = []
    if not np.isfinite(time).all() or (time.size and max(float(time.max()), -float(time.min())) > _LATEST):
        return time, notes  # no clock: what reads it refuses it
    if np.all(time[1:] >= time[:-1]):
        return time, notes
    gap = gap_length(np.sort(time))
    for row in steps_back(np.round(time * 1e9).astype(np.int64)):
        size = float(time[row - 1] - time[row])
        notes.append(f"the time steps back by {size:.3f} s in sample {row}: the recording is cut there")
        time = np.concatenate([time[:row], time[row:] + size + gap])
    return time, notes


def first_of_each_stamp(time: Array) -> NDArray[np.bool_]:
    """Return which samples to keep where a logger wrote some stamps more than once: the first of each, shape (n,)."""
    return np.append(True, time[1:] != time[:-1]) if time.size else np.zeros(0, dtype=bool)
