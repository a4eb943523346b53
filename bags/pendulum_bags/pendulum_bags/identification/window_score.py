"""The score of a model on a recording: angle error over windows, and in free run.

One definition for identification, input replay, benchmarks and reports.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel, from_plant
from pendulum_bags.identification.problem import Piece, off_line, prepare, simulate
from pendulum_bags.identification.solver import solve
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["WindowScore", "fit_states", "free_run", "window_score"]


@dataclass(frozen=True)
class WindowScore:
    """Angle error of a model on a recording.

    Args:
        rms: Root mean square over all samples in all windows [rad].
        mean_absolute: Mean absolute value over the same samples [rad].
        by_window: Root mean square of each window, shape (w,) [rad].
        time, measured, simulated, velocity: The samples in windows, shape (n,); [s], [rad], [rad], [rad/s].
        windows: First and one past last index of each window in those arrays, shape (w, 2).
        states: Fitted initial states, shape (w, 2) [rad, rad/s].
    """

    rms: float
    mean_absolute: float
    by_window: Array
    time: Array
    measured: Array
    simulated: Array
    velocity: Array
    windows: NDArray[np.int64]
    states: Array

    @property
    def share(self) -> float:
        """Error over that of straight lines."""
        return self.rms / max(self.lines, 1e-300)

    @property
    def lines(self) -> float:
        """Root mean square error of the best straight line through each window [rad]."""
        left = np.concatenate([off_line(self.time[a:b], self.measured[a:b]) for a, b in self.windows])
        return float(np.sqrt(np.mean(left**2)))


def window_score(model: FitModel | PlantParameters, recording: Recording, window: float | None = 1.0) -> WindowScore:
    """Simulate a recording in windows, the initial state of each fitted to it, and measure the angle error.

    Windows of length ``window`` follow one another from the first sample; a rest of at least half a window is
    one more, a shorter rest is left out. For each window, angle and velocity at its first sample are those that
    minimise the sum of squared angle errors over that window; all parameters are those of the model, and the
    input is the recorded one. The score is sqrt(sum of squared errors / number of samples) over all windows. The window
    None is all of the recording.
    """
    fit_model = from_plant(model) if isinstance(model, PlantParameters) else model
    piece = prepare(recording, window)
    states = fit_states(fit_model, piece)
    return _score(fit_model, piece, states)


def fit_states(model: FitModel, piece: Piece) -> Array:
    """Return the initial state of each window that fits it best in least squares, shape (w, 2)."""
    # Window by window: each has its own damping, so that a hard one does not hold up the others. Dry friction
    # makes two valleys at standstill (it moves on, or it sticks first), so each begins from both sides.
    states = []
    for i in range(len(piece.windows)):
        single = [piece.subset([i])]
        guess = single[0].states
        begin = (guess, guess * np.array([1.0, 0.0]))
        trials = [solve(model, single, (), states=[start], max_iterations=30) for start in begin]
        states.append(min(trials, key=lambda trial: trial.cost).states[0])
    return np.concatenate(states)


def free_run(model: FitModel | PlantParameters, recording: Recording, *, fitted: bool = True) -> WindowScore:
    """Simulate a whole recording from one initial state, never corrected by the measurement again.

    The state is fitted to the first second, or, unless ``fitted``, the first one measured.
    """
    fit_model = from_plant(model) if isinstance(model, PlantParameters) else model
    piece = prepare(recording, None, across_gaps=True)
    states = piece.states.copy()
    if fitted:
        stop = int(np.searchsorted(recording.time, recording.time[0] + 1.0))
        head = Piece(recording, np.array([[0, max(stop, 4)]], dtype=np.int64), states, piece.integral, piece.enabled)
        states = solve(fit_model, [head], (), max_iterations=40).states[0]
    elif recording.velocity is not None:
        states[0] = recording.position[0], recording.velocity[0]
    return _score(fit_model, piece, states)


def _score(model: FitModel, piece: Piece, states: Array) -> WindowScore:
    result = simulate(model, piece, states)
    recording = piece.recording
    error = result.theta - recording.position
    by_window = np.array([np.sqrt(np.mean(error[a:b] ** 2)) for a, b in piece.windows])
    mask = piece.mask
    lengths = piece.windows[:, 1] - piece.windows[:, 0]
    ends = np.cumsum(lengths)
    inside = error[mask]
    return WindowScore(
        rms=float(np.sqrt(np.mean(inside**2))),
        mean_absolute=float(np.mean(np.abs(inside))),
        by_window=by_window,
        time=recording.time[mask],
        measured=recording.position[mask],
        simulated=result.theta[mask],
        velocity=result.omega[mask],
        windows=np.stack((ends - lengths, ends), axis=1),
        states=states,
    )
