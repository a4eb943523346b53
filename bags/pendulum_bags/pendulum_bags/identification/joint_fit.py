"""Output error of several joints: windows of free run, the state at the start of each fitted.

A window's motion depends on its start and on the recorded efforts alone, not on what was measured inside it. So a
controller that feeds noise back biases nothing, and an unstable plant only bounds the length of a window. Sensitivities
are differences of compiled simulations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import Solution, minimise
from pendulum_bags.identification.covariance import Information, information
from pendulum_bags.identification.joint_kernel import lagged
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.kernel import cumulative_input
from pendulum_bags.identification.motion_model import MotionModel
from pendulum_bags.identification.problem import cut_windows, first_state, off_line, sensor_noise
from pendulum_bags.recordings.clock import longest_step
from pendulum_msgs_py.errors import DataError

__all__ = [
    "MOST",
    "JointFit",
    "Score",
    "WeightedErrors",
    "Windows",
    "error_weights",
    "first_weights",
    "fit",
    "line_errors",
    "noise_of",
    "prepare_windows",
    "rms_by_joint",
    "scores",
    "sensitivity",
    "window_length",
]


_APART, _APART_BY_VELOCITY = 30.0, 3.0
"""Growth of a small difference over a window up to which the window's start determines its end, and a growth that is
enough where velocities were measured too: the start of a short window is known then, and its cost has one minimum."""

_LONGEST = 0.006
"""Longest step; between samples that lie further apart the motion is simulated in several equal ones [s]."""

_FINE = 0.0005
"""The same where velocities were measured [s]: to their noise, it counts when within a step the effort changes."""

MOST = 100
"""Most steps of a search; one that has not ended by then is no result."""

_NEAR = 5
"""Samples to each side from which the state at the start of a window is guessed."""

_BEFORE = 0.02
"""Longest delay after which an effort from before the recording may still act [s]."""

_DIFFERENCE = 1e-5
"""Step of the differences, in the size of a parameter, and in rad, m, rad/s or m/s of a start.

Larger ones have errors that look like effects: where dry friction sticks, 1e-4 tells numbers apart that do the same.
"""

_AWAY = "the starting plant's motion leaves all bounds within a window; expected a plant that is near"


@dataclass(frozen=True)
class Windows:
    """One recording cut into windows of equal length, the last ones padded.

    Attributes:
        recording: The data.
        time: Instants of the simulation, shape (w, l); padding repeats the last one [s].
        inside: Which of them are samples, neither between two nor padding, shape (w, l).
        position: Shape (w, l, n) [rad or m].
        velocity: The same, or None where it was not measured [rad/s or m/s].
        states: First guess of the start states, shape (w, 2 n).
        area: Integral of the effort up to each sample of the recording, shape (s, n).
    """

    recording: JointRecording
    time: Array
    inside: NDArray[np.bool_]
    position: Array
    velocity: Array | None
    states: Array
    area: Array

    @property
    def samples(self) -> int:
        """Number of samples in the windows."""
        return int(self.inside.sum())

    def subset(self, chosen: Sequence[int] | NDArray[np.int64]) -> Windows:
        """Return some of the windows."""
        at = np.asarray(chosen, dtype=int)
        velocity = None if self.velocity is None else self.velocity[at]
        return Windows(
            self.recording, self.time[at], self.inside[at], self.position[at], velocity, self.states[at], self.area
        )

    def input(self, delay: float, lag: float) -> Array:
        """Return straight lines for the effort in each step, delayed and lagging: start and slope, (w, l - 1, 2 n)."""
        r = self.recording
        wanted = self.time - delay
        at = np.clip(wanted, r.time[0], r.time[-1])
        k = np.clip(np.searchsorted(r.time, at, side="right") - 1, 0, r.time.size - 2)
        since = (at - r.time[k])[..., None]
        linear = np.array([hold == "linear" for hold in r.hold])
        rise = np.where(linear, (r.effort[k + 1] - r.effort[k]) / (r.time[k + 1] - r.time[k])[..., None], 0.0)
        level = r.effort[k] + rise * since
        area = self.area[k] + (r.effort[k] + 0.5 * rise * since) * since
        # Before the first sample and after the last the effort stays as it is there.
        beyond = (wanted - at)[..., None]
        area = area + beyond * np.where(beyond < 0.0, r.effort[0], r.effort[-1])
        if lag > 0.0:
            # Of lag y' + y = u the integral: that of y is that of u, less lag times the rise of y.
            steps = np.diff(r.time)
            slope = np.where(linear, np.diff(r.effort, axis=0) / steps[:, None], 0.0)
            settled = slope[k] * lag
            start = lagged(r.effort, slope, steps, lag)[k]
            late = level - settled + (start - r.effort[k] + settled) * np.exp(-since / lag)
            area, level = area - lag * late, late
        steps = np.diff(self.time, axis=1)
        length = np.where(steps > 0.0, steps, 1.0)[..., None]
        mean, half = np.diff(area, axis=1) / length, 0.5 * np.diff(level, axis=1)
        return np.concatenate((mean - half, 2.0 * half / length), axis=2)


def prepare_windows(recording: JointRecording, window: float) -> Windows:
    """Cut a recording into windows of a length [s]; the mean effort drives each step."""
    # What was commanded before the recording acts on in its first moments.
    begin = int(np.searchsorted(recording.time, recording.time[0] + _BEFORE))
    cuts = begin + cut_windows(recording.time[begin:], window)
    parts = [np.arange(first, stop) for first, stop in cuts]
    # No window reaches across a gap.
    period, longest = recording.period, longest_step(recording.time)
    steps = np.diff(recording.time)
    parts = [p for p in parts if p.size >= 8 and steps[p[0] : p[-1]].max() <= longest]
    if not parts:
        raise DataError(
            f"{recording.name} has no window of {window} s with 8 samples and no gap; expected a longer recording or a "
            "higher rate"
        )
    longest = _LONGEST if recording.velocity is None else _FINE
    several = max(1, math.ceil(period / longest - 1e-6))
    size = (max(part.size for part in parts) - 1) * several + 1
    time, inside = np.empty((len(parts), size)), np.zeros((len(parts), size), dtype=bool)
    position = np.zeros((len(parts), size, recording.position.shape[1]))
    velocity = None if recording.velocity is None else np.zeros_like(position)
    for w, part in enumerate(parts):
        at = np.minimum(np.arange(size) / several, part.size - 1.0)
        time[w] = np.interp(at, np.arange(part.size), recording.time[part])
        inside[w, : part.size * several : several] = True
        position[w, inside[w]] = recording.position[part]
        if velocity is not None and recording.velocity is not None:
            velocity[w, inside[w]] = recording.velocity[part]
    states = np.array([_first_state(recording, int(part[0])) for part in parts])
    return Windows(recording, time, inside, position, velocity, states, _area(recording))


def _area(recording: JointRecording) -> Array:
    columns = zip(recording.effort.T, recording.hold, strict=True)
    time = recording.time
    return np.stack([cumulative_input(time, np.array(u), hold == "linear") for u, hold in columns], axis=1)


def _first_state(recording: JointRecording, first: int) -> Array:
    position, rate = first_state(recording.time, recording.position, first, _NEAR)
    if recording.velocity is not None:
        rate = recording.velocity[max(first - _NEAR, 0) : first + _NEAR + 1].mean(axis=0)
    return np.concatenate((position, rate))


@dataclass(frozen=True)
class Score:
    """How well a recording is predicted, the start of each window fitted.

    Attributes:
        rms: Of each joint, shape (n,) [rad or m].
        lines: What straight lines through the windows would leave, shape (n,).
        noise: Of the sensors, which no model explains, shape (n,).
    """

    rms: Array
    lines: Array
    noise: Array | float = 0.0

    @classmethod
    def of(cls, rms: Array, data: Windows) -> Score:
        """Return the score of errors of each joint, shape (n,)."""
        return cls(rms, line_errors(data), noise_of(data.recording.position))

    @property
    def share(self) -> float:
        """Error over that of straight lines, of the joint where it is worst."""
        return float(np.max(self.shares()))

    def shares(self, least: Array | float = 1e-12) -> Array:
        """Return the error beyond the sensors' noise over that of straight lines, by joint, shape (n,).

        Below ``least`` [rad or m] straight lines count as missing nothing: a joint that hardly moves shows noise.
        """
        left = np.sqrt(np.maximum(self.rms**2 - np.square(self.noise), 0.0))
        return np.asarray(left / np.maximum(self.lines, least))


def noise_of(position: Array) -> Array:
    """Return the noise of positions, or of rounding to their encoders' steps where that is more, shape (n,)."""
    apart = np.abs(np.diff(position, axis=0))
    step = np.min(np.where(apart > 1e-9, apart, np.inf), axis=0)
    return np.maximum(sensor_noise(position), np.where(np.isfinite(step), step, 0.0) / math.sqrt(12.0))


@dataclass(frozen=True)
class JointFit(Solution[MotionModel]):
    """A fit of several joints.

    Attributes:
        free: Names of what was fitted.
        data: The windows of each recording.
        weights: Of the errors of positions and velocities, shape (2 n,).
        own: Names of what each recording has a value of its own of.
    """

    free: tuple[str, ...]
    data: Sequence[Windows]
    weights: Array
    own: tuple[str, ...]

    def again(self, weights: Array, **changes: Any) -> JointFit:
        """Return the fit from here under other weights, and with other arguments of :func:`fit`."""
        start = {"model": self.model, "data": self.data, "free": self.free, "states": self.states}
        return fit(weights=weights, **{**start, "own": self.own, "offsets": self.offsets, **changes})

    @property
    def models(self) -> list[MotionModel]:
        """The model of each recording, with its own offsets."""
        return [self.model.with_changes(dict(zip(self.own, row, strict=True))) for row in self.offsets]

    @cached_property
    def errors(self) -> list[Array]:
        """Simulated minus measured by recording, positions before velocities, shape (w, l, 2 n).

        0 in the padding and where no velocity was measured.
        """
        rows = zip(self.models, self.data, self.states, strict=True)
        return [_errors(part, one.motions(one.vector[None], part, x[None])[0]) for one, part, x in rows]

    @cached_property
    def information(self) -> Information:
        """Sensitivities and errors by window, weighted."""
        weighted = [WeightedErrors(part, self.weights) for part in self.data]
        return information(self.models, weighted, self.states, self.free, self.own)

    @property
    def residuals(self) -> list[Array]:
        """Errors of the positions by recording, shape (w, l, n)."""
        return [each[..., : each.shape[-1] // 2] for each in self.errors]

    @property
    def scores(self) -> list[Score]:
        """How well each recording is explained."""
        pairs = zip(self.residuals, self.data, strict=True)
        return [Score.of(rms_by_joint(errors, part), part) for errors, part in pairs]

    @property
    def worst(self) -> float:
        """What it misses over what straight lines miss, of the joint and recording where it is worst."""
        return max(score.share for score in self.scores)


def sensitivity(model: MotionModel, names: Sequence[str], data: Windows, states: Array, path: Array) -> Array:
    """Return those of a motion to parameters and start states, shape (w, l, 2 n, k + 2 n)."""
    index, width = model.index(names), states.shape[1]
    steps = np.array([*(_DIFFERENCE * model.size(name) for name in names), *[_DIFFERENCE] * width])
    values = np.tile(model.vector, (steps.size, 1))
    starts = np.tile(states, (steps.size, 1, 1))
    for c, step in enumerate(steps):
        if c < len(index):
            values[c, index[c]] += step
        else:
            starts[c, :, c - len(index)] += step
    found = (model.motions(values, data, starts) - path) / steps[:, None, None, None]
    return np.moveaxis(found, 0, -1)


def _errors(part: Windows, path: Array) -> Array:
    n = part.position.shape[-1]
    measured = np.concatenate((part.position, path[..., n:] if part.velocity is None else part.velocity), axis=-1)
    errors: Array = (path - measured) * part.inside[..., None]
    return errors


@dataclass
class WeightedErrors:
    """The weighted errors of one recording; sensitivities are differences from the motion simulated last."""

    part: Windows
    weights: Array
    last: tuple[Array, Array, Array] | None = None
    scale: float = math.inf

    def _path(self, model: MotionModel, states: Array) -> Array:
        last = self.last
        if last is None or not (np.array_equal(last[0], model.vector) and np.array_equal(last[1], states)):
            path = model.motions(model.vector[None], self.part, states[None])[0]
            self.last = last = (model.vector, states, path)
        return last[2]

    def errors(self, model: MotionModel, states: Array) -> Array:
        """Return all errors, of positions before velocities at each sample."""
        return np.ravel(_errors(self.part, self._path(model, states)) * self.weights)

    def sensitivities(self, model: MotionModel, states: Array, names: Sequence[str]) -> tuple[Array, Array, list[int]]:
        """Return sensitivities, errors and ends of windows; see :class:`~arrowhead.Motion`."""
        path, part = self._path(model, states), self.part
        own = self.weights * np.repeat([1.0, float(part.velocity is not None)], part.position.shape[-1])
        scaled = sensitivity(model, names, part, states, path) * (part.inside[..., None] * own)[..., None]
        errors = np.ravel(_errors(part, path) * self.weights)
        return scaled.reshape(-1, scaled.shape[-1]), errors, list(range(0, errors.size + 1, errors.size // len(path)))


# Far along an unstable motion sensitivities overflow; what is not finite is refused.
@np.errstate(over="ignore", invalid="ignore")
def fit(
    model: MotionModel,
    data: Sequence[Windows],
    free: Sequence[str],
    weights: Array,
    *,
    own: Sequence[str] = (),
    states: Sequence[Array] | None = None,
    offsets: Array | None = None,
    most: int = MOST,
    tolerance: float = 1e-6,
    hopeless: float = np.inf,
) -> JointFit:
    """Minimise the weighted squares of the errors over free parameters and start states, as :func:`minimise` does.

    ``weights`` are of each joint's error, shape (n,), or of its position and its velocity, shape (2 n,); the start
    states begin at the windows' first guesses. A fit whose weighted rms error is above ``hopeless`` is refused anyway,
    and ends as soon as it makes little progress.

    Raises:
        DataError: The start's motion leaves all bounds.
    """
    count = len(model.coordinates.joints)
    weights = np.concatenate((weights, np.zeros(count))) if weights.size == count else weights
    found = minimise(
        model,
        [WeightedErrors(part, weights) for part in data],
        states or [part.states for part in data],
        free,
        own=own,
        offsets=offsets,
        max_iterations=most,
        tolerance=tolerance,
        hopeless=hopeless**2 * sum(part.samples for part in data) * np.count_nonzero(weights),
    )
    if not math.isfinite(found.cost):
        raise DataError(_AWAY)
    rest = found.states, found.cost, found.converged, found.offsets
    return JointFit(found.model, *rest, tuple(free), data, weights, tuple(own))


def scores(
    model: MotionModel, data: Sequence[Windows], weights: Array | None = None, *, own: Sequence[str] = ()
) -> list[Score]:
    """Return how well a model explains each recording, with the start of each window and its ``own`` offsets fitted.

    Joints weigh by default as one over what straight lines miss: metres and radians have no common scale.
    """
    found: list[Score] = []
    for part in data:
        size = 1.0 / np.maximum(line_errors(part), 1e-9) if weights is None else weights
        found += fit(model, [part], (), size, own=own, most=12, tolerance=1e-6).scores
    return found


def window_length(model: MotionModel, recordings: Sequence[JointRecording], longest: float) -> float:
    """Return the longest window over which motions that begin close to each other stay near, up to ``longest`` [s].

    Along the measured motion the equation, linearised and without dry friction (which hides an unstable equilibrium as
    long as a joint rests), carries a small difference on. Where it grows by more than a factor of 30 (3 where
    velocities were measured) a fit has many minima: chaotic motion, and motion about an unstable equilibrium.
    """
    n, lengths, smooth = len(model.coordinates.joints), [], model.smooth
    for recording in recordings:
        stride = max(1, round(_LONGEST / recording.period))
        time, q = recording.time[::stride], recording.position[::stride]
        if time.size < 4:
            continue
        v = np.gradient(q, time, axis=0) if recording.velocity is None else recording.velocity[::stride]
        scale = np.maximum(np.std(q, axis=0), 1e-9)
        # Each step is a window.
        steps = np.stack((time[:-1], time[1:]), axis=1)
        states = np.hstack((q, v))[:-1]
        data = Windows(recording, steps, steps > 0.0, np.stack((q[:-1], q[1:]), axis=1), None, states, _area(recording))
        starts = np.tile(states, (2 * n + 1, 1, 1))
        starts[np.arange(1, 2 * n + 1), :, np.arange(2 * n)] += _DIFFERENCE
        path = smooth.motions(np.tile(smooth.vector, (2 * n + 1, 1)), data, starts)[:, :, 1]
        gain = np.moveaxis((path[1:] - path[0]) / _DIFFERENCE, 0, -1)
        most = _APART if recording.velocity is None else _APART_BY_VELOCITY
        for first in range(0, len(gain), max(1, len(gain) // 12)):
            product, end = np.eye(2 * n), first
            while end < len(gain) and time[end] - time[first] < longest:
                product = gain[end] @ product
                end += 1
                if not np.max(np.abs(product[:n, :n] * scale / scale[:, None])) < most:
                    lengths.append(float(time[end] - time[first]))
                    break
            else:
                # A rest of the recording shows no length.
                if time[min(end, len(gain))] - time[first] >= longest:
                    lengths.append(longest)
    return float(np.quantile(lengths, 0.25)) if lengths else longest


def first_weights(data: Sequence[Windows]) -> Array:
    """Return weights of positions and velocities before a fit: one over what windows' own lines and means miss."""
    lines = [line_errors(part) for part in data]
    rates = [
        np.full(len(line), np.inf)
        if part.velocity is None
        else rms_by_joint(part.velocity - part.velocity.mean(axis=1, keepdims=True), part)
        for line, part in zip(lines, data, strict=True)
    ]
    size = np.sqrt(np.mean(np.square([np.concatenate(pair) for pair in zip(lines, rates, strict=True)]), axis=0))
    return 1.0 / np.maximum(size, 1e-9)


def error_weights(found: JointFit) -> Array:
    """Return weights of positions and velocities by the errors of a fit, 0 for what was not measured."""
    data = found.data
    squares = np.mean([rms_by_joint(e, part) ** 2 for e, part in zip(found.errors, data, strict=True)], axis=0)
    measured = np.repeat([True, all(part.velocity is not None for part in data)], squares.size // 2)
    return np.asarray(np.where(measured, 1.0 / np.maximum(np.sqrt(squares), 1e-9), 0.0))


def line_errors(data: Windows) -> Array:
    """Return the rms errors of the best straight lines through each joint of each window, shape (n,)."""
    errors = np.zeros_like(data.position)
    for i, inside in enumerate(data.inside):
        errors[i, inside] = off_line(data.time[i, inside], data.position[i, inside])
    return rms_by_joint(errors, data)


def rms_by_joint(errors: Array, data: Windows) -> Array:
    """Return the rms of errors of shape (w, l, n) at the samples of the windows, shape (n,)."""
    return np.asarray(np.sqrt(np.mean(errors[data.inside] ** 2, axis=0)))
