"""Input replay: drive a plant model with recorded torque and see how far it follows the measured motion."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.identification.window_score import window_score
from pendulum_bags.replay.fit_replay import replay_fit
from pendulum_bags.replay.result import InputReplay, horizon_errors
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.stepping.plant import Plant
from pendulum_sim.stepping.plants import make_pendulum

__all__ = ["replay_input", "replay_recording"]

SMOOTHING = 0.02
"""Half width of the parabola that gives the measured state at a sample [s]: quantised angles have no velocity."""


def replay_recording(
    path: str | os.PathLike[str],
    plant: str | Path | PlantParameters,
    *,
    window: float = 1.0,
    mapping: str | Path | None = None,
    hold: str | None = None,
    effort: str = "applied",
    namespace: str | None = None,
) -> InputReplay:
    """Read a recording, as ``read_recording`` does, and drive a plant with its torque in windows [s].

    A voltage, a set point or a free swing drives the fit that identification wrote next to the plant file. A DataError
    if the recording is damaged or its input not supported, a ParameterError if the plant file is refused.
    """
    recording = read_recording(path, mapping, effort=effort, namespace=namespace, hold=hold)
    if recording.input_kind != "effort" or (isinstance(plant, str | Path) and Path(plant).suffix == ".json"):
        return replay_fit(recording, plant, window=window)
    parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
    return replay_input(recording, parameters, window=window)


def replay_input(recording: Recording, parameters: PlantParameters, *, window: float = 1.0) -> InputReplay:
    """Drive a plant with the torque of a recording; a DataError if its input is none.

    Windows [s] of a rigid plant have fitted initial states, by the score that identification minimises; those of a
    series-elastic plant start from smoothed measured states, for its motor's state is not measured.
    """
    if recording.input_kind != "effort":
        raise DataError(
            f"{recording.name} has the input {recording.input_kind!r}; expected 'effort' [N m] to drive a plant"
        )
    if not window > 0.0:
        raise DataError(f"window is {window} s; expected > 0")
    driven = _Driven.of(recording, parameters)
    lines = math.nan
    if parameters.drivetrain is None:
        score = window_score(parameters, recording, window)
        overall, by_window, lines = score.rms, score.by_window, score.lines
        window_time, window_angle = score.time, score.simulated
        start = tuple(score.states[0])
    else:
        window_time, window_angle, by_window = _windows(driven, window)
        overall = rms(window_angle - np.interp(window_time, driven.time, driven.position))
        start = (float(driven.position[0]), float(driven.velocity[0]))
    return InputReplay(
        name=recording.name,
        plant=parameters,
        window=window,
        lines=lines,
        rms=overall,
        by_window=by_window,
        window_time=window_time,
        window_angle=window_angle,
        time=driven.time,
        measured=driven.position,
        free_run=driven.run(0, driven.time.size - 1, (float(start[0]), float(start[1]))),
        horizons=horizon_errors(
            driven.time.size,
            float(driven.time[1] - driven.time[0]),
            window,
            lambda first, steps: driven.run(first, steps) - driven.position[first : first + steps + 1],
        ),
    )


@dataclass(frozen=True)
class _Driven:
    """A recording at a fixed period, shape (n,), and a plant that can be run along it.

    The velocity is the slope of a parabola through neighbouring angles, the torque, shape (n - 1,), a mean.
    """

    time: Array
    position: Array
    velocity: Array
    smooth: Array
    torque: Array
    plant: Plant

    @classmethod
    def of(cls, recording: Recording, parameters: PlantParameters) -> _Driven:
        period = recording.period
        count = math.floor(recording.duration / period + 1e-6) + 1
        time = recording.time[0] + period * np.arange(count)
        position = np.interp(time, recording.time, recording.position)
        reach = min(max(2, round(SMOOTHING / period)), (count - 1) // 2)
        width = 2 * reach + 1
        smooth = scipy.signal.savgol_filter(position, width, 2)
        velocity = scipy.signal.savgol_filter(position, width, 2, deriv=1, delta=period)
        torque = _mean_input(recording, time)
        # Measured torque was applied, whatever the model's actuator could give.
        limit = max(parameters.effort_limit, 1.001 * float(np.abs(torque).max()))
        plant = make_pendulum(parameters.with_values(effort_limit=limit), period)
        return cls(time, position, velocity, smooth, torque, plant)

    def run(self, first: int, steps: int, state: tuple[float, float] | None = None) -> Array:
        """Return the angle at the samples ``first`` to ``first + steps``, starting there from the measured state."""
        start = (float(self.smooth[first]), float(self.velocity[first])) if state is None else state
        plant = self.plant
        plant.reset(*start)
        angle = np.empty(steps + 1)
        angle[0] = start[0]
        for i, torque in enumerate(self.torque[first : first + steps].tolist(), start=1):
            angle[i] = plant.step(torque).theta
        return angle


def _mean_input(recording: Recording, time: Array) -> Array:
    """Return the mean of the input over each interval, which is what a held torque must be to push as much."""
    stamps, values = recording.input_stamps, recording.input
    if recording.hold == "linear":
        at = np.interp(time, stamps, values)
        return np.asarray(0.5 * (at[1:] + at[:-1]))
    # A held input has a piecewise linear integral, so interpolating that is exact.
    edges = np.append(stamps, max(float(time[-1]), float(stamps[-1])) + 1.0)
    integral = np.concatenate(([0.0], np.cumsum(values * np.diff(edges))))
    return np.asarray(np.diff(np.interp(time, edges, integral)) / np.diff(time))


def _windows(driven: _Driven, window: float) -> tuple[Array, Array, Array]:
    period = float(driven.time[1] - driven.time[0])
    length = min(max(2, round(window / period)), driven.time.size)
    times, angles, errors = [], [], []
    for first in range(0, driven.time.size - length + 1, length):
        angle = driven.run(first, length - 1)
        part = slice(first, first + length)
        times.append(driven.time[part])
        angles.append(angle)
        errors.append(rms(angle - driven.position[part]))
    return np.concatenate(times), np.concatenate(angles), np.array(errors)
