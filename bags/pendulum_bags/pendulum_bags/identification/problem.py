"""Recordings cut into windows and handed to the compiled simulation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification import kernel
from pendulum_bags.identification.model import FitModel
from pendulum_bags.runs.datasets import Recording, gaps
from pendulum_msgs_py.dynamics.joint_torques import PERIODIC
from pendulum_msgs_py.errors import DataError

__all__ = [
    "Piece",
    "Simulation",
    "cut_windows",
    "first_state",
    "longest_step",
    "off_line",
    "prepare",
    "sensor_noise",
    "simulate",
    "stretches_between_gaps",
]
_NOTHING = np.zeros((0, 0))


@dataclass(frozen=True)
class Piece:
    """One recording with its windows, ready to simulate.

    Args:
        recording: The data.
        windows: First and one past last sample of each window, shape (w, 2).
        states: First guess of the initial state of each window, shape (w, 2) [rad, rad/s].
        integral: Integral of the input up to each of its stamps, shape (m,).
        enabled: Drive switch at each input stamp, shape (m,).
    """

    recording: Recording
    windows: NDArray[np.int64]
    states: Array
    integral: Array
    enabled: Array

    @property
    def samples(self) -> int:
        """Number of samples inside the windows."""
        return int(np.sum(self.windows[:, 1] - self.windows[:, 0]))

    def subset(self, chosen: Sequence[int] | NDArray[np.int64]) -> Piece:
        """Return the piece with some of its windows."""
        index = np.asarray(chosen, dtype=int)
        return Piece(self.recording, self.windows[index], self.states[index], self.integral, self.enabled)

    @cached_property
    def rows(self) -> slice | NDArray[np.bool_]:
        """Index of the samples in windows; without a copy where the windows follow one another."""
        follow = np.array_equal(self.windows[1:, 0], self.windows[:-1, 1])
        return slice(int(self.windows[0, 0]), int(self.windows[-1, 1])) if follow else self.mask

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """Return which samples lie in a window, shape (n,)."""
        inside = np.zeros(self.recording.time.size, dtype=bool)
        for first, stop in self.windows:
            inside[first:stop] = True
        return inside


@dataclass(frozen=True)
class Simulation:
    """Simulated angle [rad], velocity [rad/s] and d angle / d(parameters, window state); rows as the samples."""

    theta: Array
    omega: Array
    jacobian: Array


def cut_windows(time: Array, window: float | None) -> NDArray[np.int64]:
    """Return windows that follow one another, shape (w, 2), None for one; a rest of half a window counts as one."""
    if window is not None and not window > 0.0:
        raise DataError(f"window is {window} s; expected > 0")
    span = float(time[-1] - time[0])
    if window is None or window >= span:
        return np.array([[0, time.size]], dtype=np.int64)
    period = float(np.median(np.diff(time)))
    starts = time[0] + window * np.arange(math.ceil(span / window + 1e-9))
    # Half a sample of slack keeps k windows of a run of k window lengths in spite of jitter in the stamps.
    edges = np.append(np.searchsorted(time, starts - 0.5 * period), time.size)
    windows = np.stack((edges[:-1], edges[1:]), axis=1)
    lengths = windows[:, 1] - windows[:, 0]
    keep = lengths >= 4
    rest = float(time[-1] - time[windows[-1, 0]]) + period
    keep[-1] &= rest >= 0.5 * window
    if not keep.any():
        raise DataError(f"window of {window} s holds fewer than 4 samples at a period of {period:.4g} s")
    return windows[keep].astype(np.int64)


def stretches_between_gaps(recording: Recording) -> list[tuple[int, int]]:
    """Return first and one past last sample of each stretch that no gap lies in."""
    found = gaps(recording)
    since = recording.time - recording.time[0]
    begins = [0, *(int(np.searchsorted(since, stop - 1e-9)) for _, stop in found)]
    ends = [*(int(np.searchsorted(since, start + 1e-9)) for start, _ in found), since.size]
    return list(zip(begins, ends, strict=True))


def _between_gaps(recording: Recording, window: float | None) -> NDArray[np.int64]:
    """Return windows that no gap of the recording lies in, shape (w, 2)."""
    stretches = stretches_between_gaps(recording)
    if len(stretches) == 1:
        return cut_windows(recording.time, window)
    parts = [
        first + cut_windows(recording.time[first:stop], window)
        for first, stop in stretches
        # A stretch too short for a window's two states and something to compare is left out.
        if stop - first >= 8
    ]
    if not parts:
        raise DataError(
            f"{recording.name} has {len(stretches) - 1} gaps and no 8 samples between any two; expected fewer gaps"
        )
    return np.concatenate(parts)


def prepare(recording: Recording, window: float | None, *, across_gaps: bool = False) -> Piece:
    """Return the recording with windows of a length [s], None for all of it, and first guesses of their initial states.

    Windows reach across stretches in which nothing was recorded only by ``across_gaps``.
    """
    windows = _between_gaps(recording, window) if not across_gaps else cut_windows(recording.time, window)
    stamps = recording.input_stamps
    integral = kernel.cumulative_input(stamps, recording.input, recording.hold == "linear")
    enabled = np.ones(stamps.size) if recording.enabled is None else recording.enabled
    reach = max(4, round(0.02 / recording.period))
    states = np.array([first_state(recording.time, recording.position, first, reach) for first, _ in windows])
    return Piece(recording, windows, states, integral, enabled)


def first_state(time: Array, position: Array, first: int, reach: int) -> tuple[Array, Array]:
    """Return position and velocity at a sample from a parabola through ``reach`` neighbours to each side.

    Positions have the shape (n,) or (n, joints) [rad or m].
    """
    near = slice(max(first - reach, 0), first + reach + 1)
    t = time[near] - time[first]
    # polyfit conditions badly on short times in seconds: scale to about 1.
    scale = max(float(np.max(np.abs(t))), 1e-9)
    fit = np.polynomial.polynomial.polyfit(t / scale, position[near], min(2, t.size - 1))
    return fit[0], fit[1] / scale


def off_line(time: Array, values: Array) -> Array:
    """Return what the best straight lines through values leave over, shape of the values: (n,) or (n, k)."""
    since = time - np.mean(time)
    off = values - np.mean(values, axis=0)
    slope = since @ off / max(float(since @ since), 1e-300)
    return np.asarray(off - (np.multiply.outer(since, slope)))


def sensor_noise(position: Array) -> Array:
    """Return the noise of samples by third differences, in which a smooth motion all but vanishes, along axis 0."""
    return np.asarray(np.std(np.diff(position, 3, axis=0), axis=0) / math.sqrt(20.0))


def longest_step(model: FitModel, recording: Recording) -> float:
    """Return an integration step [s] that leaves the numerical error far below the sensor's.

    The leapfrog's relative frequency error is (w h)^2 / 24; a linear drive stiffness counts like gravity. The
    exponential damping is exact in velocity, but the angle is its trapezoid: hence the bound by the rate. Friction
    that falls with speed is taken at the start of a step: its speed may change by a small part of its scale only.
    """
    inertia = model["inertia"]
    stiffness = abs(model["gravity"])
    for order, pair in ((2.0, PERIODIC[:2]), (3.0, PERIODIC[2:])):
        stiffness += order * math.hypot(*(model[name] for name in pair))
    rate = model["damping"] / inertia
    if model.input_kind == "position_goal":
        stiffness += abs(model["input_gain"]) * _supply(recording) * _servo_gain(model, recording)
        rate += model["drive_damping"] / inertia
    frequency = math.sqrt(stiffness / inertia) if stiffness > 0.0 else 0.0
    longest = min(0.02 / max(frequency, 1e-3), 0.15 / max(rate, 1e-3))
    if model["stribeck_excess"] > 0.0 or model["load_stribeck"] > 0.0:
        longest = min(longest, max(0.05 * model["stribeck_velocity"] / max(frequency**2, 1e-3), 5e-4))
    return float(np.clip(longest, 1e-4, 0.01))


def _supply(recording: Recording) -> float:
    return float(recording.meta.get("vin", 1.0))


def _servo_gain(model: FitModel, recording: Recording) -> float:
    return model.duty_gain * float(recording.meta.get("kp", 1.0))


def simulate(
    model: FitModel,
    piece: Piece,
    states: Array | None = None,
    free: Sequence[int] | None = None,
    step: float | None = None,
) -> Simulation:
    """Simulate every window of a piece; samples outside the windows are NaN.

    States, shape (w, 2), are by default the first guesses; ``free`` are indices of parameters to differentiate; the
    integration steps are at most ``step`` long [s].
    """
    recording = piece.recording
    if recording.input_kind not in (model.input_kind, "none"):
        raise DataError(
            f"{recording.name} has the input {recording.input_kind!r}; the model expects {model.input_kind!r}"
        )
    size = recording.time.size
    theta, omega = np.full(size, np.nan), np.full(size, np.nan)
    columns = np.asarray(free if free is not None else (), dtype=np.int64)
    jacobian = np.zeros((size, columns.size + 2)) if free is not None else _NOTHING
    kernel.simulate_windows(
        np.array(model.vector),
        columns,
        piece.windows,
        np.ascontiguousarray(piece.states if states is None else states),
        recording.time,
        recording.input_stamps,
        recording.input,
        piece.integral,
        piece.enabled,
        recording.hold == "linear",
        model.input_kind == "position_goal",
        _servo_gain(model, recording),
        _supply(recording),
        longest_step(model, recording) if step is None else step,
        theta,
        omega,
        jacobian,
    )
    return Simulation(theta, omega, jacobian)
