"""Output error for a mechanism: windows of free run, the state at the start of each fitted, by Levenberg-Marquardt.

As for one joint (:mod:`~pendulum_bags.identification.solver`), parameters and start states make an arrowhead, and the
states are eliminated window by window. Sensitivities go along the simulated motion: the equation's derivatives in the
middle of each step, and the exponential series of the step to third order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_model import MechanismModel, step_functions
from pendulum_bags.identification.problem import cut_windows, off_line
from pendulum_msgs_py.errors import DataError

__all__ = [
    "Blocks",
    "MechanismFit",
    "Windows",
    "fit",
    "line_errors",
    "prepare_windows",
    "rms_by_joint",
    "scores",
    "window_length",
]


_APART = 30.0
"""Growth of a small difference over a window up to which the window's start determines its end."""

_LONGEST = 0.006
"""Longest step; between samples that lie further apart the motion is simulated in several equal ones [s]."""


_AWAY = "the starting plant's motion leaves all bounds within a window; expected a plant that is near"


@dataclass(frozen=True)
class Windows:
    """One recording cut into windows of equal length, the last ones padded.

    Attributes:
        recording: The data.
        time: Instants of the simulation, shape (w, l); padding repeats the last one [s].
        inside: Which of them are samples, neither between two nor padding, shape (w, l).
        position: Shape (w, l, n) [rad or m].
        states: First guess of the start states, shape (w, 2 n).
        area: Integral of the effort up to each sample of the recording, shape (s, n).
    """

    recording: JointRecording
    time: Array
    inside: NDArray[np.bool_]
    position: Array
    states: Array
    area: Array

    def subset(self, chosen: Sequence[int] | NDArray[np.int64]) -> Windows:
        """Return some of the windows."""
        at = np.asarray(chosen, dtype=int)
        return Windows(self.recording, self.time[at], self.inside[at], self.position[at], self.states[at], self.area)

    def input(self, delay: float) -> tuple[Array, Array, Array]:
        """Return mean effort of each step and its derivative by the delay, shape (n, w, l - 1), and the steps [s]."""
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
        steps = np.diff(self.time, axis=1)
        length = np.where(steps > 0.0, steps, 1.0)[..., None]
        mean, slope = np.diff(area, axis=1) / length, -np.diff(level, axis=1) / length
        return mean.transpose(2, 0, 1), slope.transpose(2, 0, 1), steps


def prepare_windows(recording: JointRecording, window: float, *, stride: int = 1) -> Windows:
    """Cut a recording into windows.

    Args:
        recording: The data.
        window: Length [s].
        stride: Take every so manieth sample; the effort between them is not lost, its mean drives the step.
    """
    cuts = cut_windows(recording.time, window)
    parts = [np.arange(first, stop, stride) for first, stop in cuts]
    # No window reaches across a gap.
    period = float(np.median(np.diff(recording.time)))
    longest = max(10.0 * period, 0.1)
    steps = np.diff(recording.time)
    parts = [p for p in parts if p.size >= 8 and steps[p[0] : p[-1]].max() <= longest]
    if not parts:
        raise DataError(
            f"{recording.name} has no window of {window} s with 8 samples and no gap; expected a longer recording or a "
            "higher rate"
        )
    several = max(1, math.ceil(stride * period / _LONGEST - 1e-6))
    size = (max(part.size for part in parts) - 1) * several + 1
    time, inside = np.empty((len(parts), size)), np.zeros((len(parts), size), dtype=bool)
    position = np.zeros((len(parts), size, recording.position.shape[1]))
    for w, part in enumerate(parts):
        at = np.minimum(np.arange(size) / several, part.size - 1.0)
        time[w] = np.interp(at, np.arange(part.size), recording.time[part])
        inside[w, : part.size * several : several] = True
        position[w, inside[w]] = recording.position[part]
    mean = np.where(
        [hold == "linear" for hold in recording.hold],
        0.5 * (recording.effort[1:] + recording.effort[:-1]),
        recording.effort[:-1],
    )
    area = np.concatenate((np.zeros((1, mean.shape[1])), np.cumsum(mean * steps[:, None], axis=0)))
    states = np.array([_first_state(recording, int(part[0])) for part in parts])
    return Windows(recording, time, inside, position, states, area)


def _first_state(recording: JointRecording, first: int) -> Array:
    low, high = max(first - 5, 0), min(first + 6, recording.time.size)
    t = recording.time[low:high] - recording.time[first]
    scale = float(np.max(np.abs(t)))
    found = np.polynomial.polynomial.polyfit(t / scale, recording.position[low:high], 2)
    return np.concatenate((found[0], found[1] / scale))


@dataclass(frozen=True)
class Blocks:
    """Normal equations of one recording with the start states eliminated.

    Attributes:
        matrices: By window, shape (w, k, k).
        gradients: By window, shape (w, k).
        samples: Positions inside the windows.
    """

    matrices: Array
    gradients: Array
    samples: int


@dataclass(frozen=True)
class MechanismFit:
    """A fit.

    Attributes:
        model: Parameters at the minimum.
        free: Names of what was fitted.
        states: Start states by recording, shape (w, 2 n).
        cost: Weighted sum of squares.
        blocks: Normal equations by recording, at the minimum.
        residuals: Simulated minus measured positions by recording, shape (w, l, n), 0 in the padding.
    """

    model: MechanismModel
    free: tuple[str, ...]
    states: list[Array]
    cost: float
    blocks: list[Blocks]
    residuals: list[Array]


class _Simulator:
    """The compiled steps of one set of free parameters, over windows of any number and length."""

    def __init__(self, model: MechanismModel, free: Sequence[str]) -> None:
        self.count = len(model.plant.joints)
        self.forward, self.derivative = step_functions(model.plant, tuple(free))
        self.free = len(free)
        self.made: dict[tuple[str, int, int], Any] = {}

    def _made(self, name: str, windows: int, steps: int) -> Any:
        """Return the memory of a function over so many windows of so many steps each, and what evaluates it."""
        key = (name, windows, steps)
        if key not in self.made:
            runs = name == "runs"
            one = self.forward.mapaccum("run", steps) if runs else self.derivative
            self.made[key] = one.map(windows if runs else windows * steps).buffer()
        return self.made[key]

    def _evaluate(
        self, name: str, windows: int, steps: int, arguments: Sequence[Array], results: Sequence[Array]
    ) -> None:
        """Evaluate from arrays into arrays, whose rows are casadi's columns: its own matrices are slow to fill."""
        buffer, start = self._made(name, windows, steps)
        kept = [np.ascontiguousarray(array) for array in arguments]
        for i, array in enumerate(kept):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(results):
            buffer.set_res(i, array.data)
        start()

    def motion(self, model: MechanismModel, data: Windows, states: Array) -> Array:
        """Return the states at each sample, shape (w, l, 2 n)."""
        n, (w, size) = self.count, data.time.shape
        mean, _, h = data.input(model["delay"])
        p = np.tile(model.values, (w * (size - 1), 1))
        later = np.empty((w, size - 1, 2 * n))
        self._evaluate("runs", w, size - 1, (states, mean.reshape(n, -1).T, h, p), (later,))
        return np.concatenate((states[:, None], later), axis=1)

    def sensitivity(self, model: MechanismModel, data: Windows, path: Array) -> Array:
        """Return those of the positions of a motion to parameters and start states, shape (w, l, n, k + 2 n)."""
        n, (w, size) = self.count, data.time.shape
        mean, slope, h = data.input(model["delay"])
        p = np.tile(model.values, (w * (size - 1), 1))
        middle = 0.5 * (path[:, :-1] + path[:, 1:])
        by_x, by_p = np.empty((w, size - 1, 2 * n, 2 * n)), np.empty((w, size - 1, self.free, 2 * n))
        drive = (mean.reshape(n, -1).T, slope.reshape(n, -1).T)
        self._evaluate("derivatives", w, size - 1, (middle, *drive, p), (by_x, by_p))
        step = h[:, :, None, None]
        a, b = (np.multiply(found.swapaxes(2, 3), step, order="C") for found in (by_x, by_p))
        unit = np.eye(2 * n)
        square = a @ a
        gain, b = unit + a + 0.5 * square + (square @ a) / 6.0, (unit + 0.5 * a + square / 6.0) @ b
        result = np.zeros((w, size, 2 * n, self.free + 2 * n))
        result[:, 0, :, self.free :] = unit
        for i in range(size - 1):
            result[:, i + 1] = gain[:, i] @ result[:, i]
            result[:, i + 1, :, : self.free] += b[:, i]
        return result[:, :, :n]


# Far along an unstable motion sensitivities overflow; what is not finite is refused.
@np.errstate(over="ignore", invalid="ignore")
def fit(
    model: MechanismModel,
    data: Sequence[Windows],
    free: Sequence[str],
    weights: Array,
    *,
    states: Sequence[Array] | None = None,
    most: int = 30,
    tolerance: float = 1e-5,
) -> MechanismFit:
    """Minimise the weighted squares of the position errors over free parameters and start states.

    Args:
        model: Start.
        data: Windows of each recording.
        free: Names of what to fit; none fits the start states alone.
        weights: Of each joint's error, shape (n,).
        states: Start of the start states; by default the windows' first guesses.
        most: Most steps to try.
        tolerance: Relative decrease of the cost below which the fit ends.
    """
    simulator = _Simulator(model, free)
    index = model.index(free)
    size = np.array([model.size(name) for name in free])
    low = np.array([model.lowest(name) for name in free])
    values = model.values.copy()
    values[index] = np.maximum(values[index], low)
    best, x = model.with_values(values), [np.array(s) for s in (states or [part.states for part in data])]
    damping, k = 1e-4, len(index)
    cost, paths = _simulate(simulator, best, data, x, weights)
    if not np.isfinite(cost):
        raise DataError(_AWAY)
    normal, errors = _linearise(simulator, best, data, paths, weights)
    if not all(np.isfinite(matrix).all() for matrix in normal[0]):
        raise DataError(_AWAY)
    for _ in range(most):
        step = _step(normal, values[index], size, low, damping)
        trial = values.copy()
        trial[index] = np.maximum(values[index] + step[0], low)
        candidate = best.with_values(trial)
        moved = [a + b for a, b in zip(x, step[1], strict=True)]
        new, paths = _simulate(simulator, candidate, data, moved, weights)
        if new < cost:
            following = _linearise(simulator, candidate, data, paths, weights)
            if not all(np.isfinite(matrix).all() for matrix in following[0][0]):
                # So far along an unstable motion the derivatives have no size: a smaller step.
                damping *= 8.0
                continue
            done = (cost - new) < tolerance * cost
            values, best, x, cost = trial, candidate, moved, new
            damping = max(0.2 * damping, 1e-9)
            normal, errors = following
            if done:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    blocks = []
    for matrix, gradient, part in zip(normal[0], normal[1], data, strict=True):
        coupling, own = matrix[:, :k, k:], matrix[:, k:, k:]
        solved = np.linalg.pinv(own, hermitian=True) @ coupling.transpose(0, 2, 1)
        reduced = matrix[:, :k, :k] - coupling @ solved
        along = gradient[:, :k] - np.einsum("wxk,wx->wk", solved, gradient[:, k:])
        blocks.append(Blocks(reduced, along, int(part.inside.sum()) * simulator.count))
    return MechanismFit(best, tuple(free), x, cost, blocks, errors)


def _simulate(
    simulator: _Simulator, model: MechanismModel, data: Sequence[Windows], states: Sequence[Array], weights: Array
) -> tuple[float, list[Array]]:
    """Return the cost, inf where a motion leaves all bounds, and the motions of each recording."""
    total, paths = 0.0, []
    for part, x in zip(data, states, strict=True):
        path = simulator.motion(model, part, x)
        paths.append(path)
        if not np.isfinite(path).all():
            return np.inf, paths
        error = _errors(simulator, part, path) * weights
        total += float(np.sum(error**2))
    return total, paths


def _errors(simulator: _Simulator, part: Windows, path: Array) -> Array:
    errors: Array = (path[..., : simulator.count] - part.position) * part.inside[..., None]
    return errors


def _linearise(
    simulator: _Simulator, model: MechanismModel, data: Sequence[Windows], paths: Sequence[Array], weights: Array
) -> tuple[tuple[list[Array], list[Array]], list[Array]]:
    """Return the normal equations about the motions, and their errors."""
    matrices, gradients, errors = [], [], []
    for part, path in zip(data, paths, strict=True):
        plain = _errors(simulator, part, path)
        scaled = simulator.sensitivity(model, part, path) * (part.inside[..., None] * weights)[..., None]
        flat = scaled.reshape(len(path), -1, scaled.shape[-1])
        matrices.append(flat.transpose(0, 2, 1) @ flat)
        gradients.append(np.einsum("wia,wi->wa", flat, (plain * weights).reshape(len(path), -1)))
        errors.append(plain)
    return (matrices, gradients), errors


def _step(
    normal: tuple[list[Array], list[Array]], values: Array, size: Array, low: Array, damping: float
) -> tuple[Array, list[Array]]:
    """Return the damped step of parameters and start states; what would leave its domain stops at the edge."""
    k = values.size
    reduced, gradient, solved = np.zeros((k, k)), np.zeros(k), []
    for matrix, own_gradient in zip(*normal, strict=True):
        states = matrix[:, k:, k:].copy()
        # A start that a wrong model's motion hardly shows must not stop the search.
        diagonal = np.einsum("wii->wi", states)
        diagonal[:] = (1.0 + damping) * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True)
        right = np.concatenate((matrix[:, k:, :k], own_gradient[:, k:, None]), axis=2)
        found = np.linalg.solve(states, right)
        solved.append(found)
        both = matrix[:, :k, k:] @ found
        reduced += matrix[:, :k, :k].sum(axis=0) - both[:, :, :k].sum(axis=0)
        gradient += own_gradient[:, :k].sum(axis=0) - both[:, :, k].sum(axis=0)
    step = np.zeros(k)
    if k:
        # In shares of the parameters' scales. The little that is added keeps what the data do not see where it is.
        system = reduced * np.outer(size, size)
        system += np.diag(damping * np.diag(system) + 1e-10 * np.trace(system) / k)
        active = np.zeros(k, dtype=bool)
        for _ in range(k):
            idle = np.flatnonzero(~active)
            if not idle.size:
                break
            right = -(size * gradient + system @ np.where(active, step / size, 0.0))[idle]
            step[idle] = size[idle] * np.linalg.solve(system[np.ix_(idle, idle)], right)
            outside = (values + step < low) & ~active
            if not outside.any():
                break
            step[outside] = (low - values)[outside]
            active |= outside
    return step, [-(found[:, :, k] + found[:, :, :k] @ step) for found in solved]


def scores(model: MechanismModel, data: Sequence[Windows], weights: Array | None = None) -> list[Array]:
    """Return the rms errors of each joint of each recording with the start of each window fitted, shape (n,).

    Args:
        model: The model.
        data: Windows of each recording.
        weights: Of each joint's error, shape (n,); by default one over what straight lines miss: metres and radians
            have no common scale.
    """
    found = []
    for part in data:
        own = 1.0 / np.maximum(line_errors(part), 1e-9) if weights is None else weights
        found.append(rms_by_joint(fit(model, [part], (), own, most=12, tolerance=1e-6).residuals[0], part))
    return found


def window_length(model: MechanismModel, recordings: Sequence[JointRecording], longest: float) -> float:
    """Return the longest window over which motions that begin close to each other stay near, up to ``longest`` [s].

    Along the measured motion the linearised equation carries a small difference on. Where it grows by more than a
    factor of 30 the start of a window does not determine its end, and a fit to it has many minima: chaotic motion, and
    motion about an unstable equilibrium.

    Args:
        model: The start of the fit.
        recordings: The data.
        longest: Largest length [s].
    """
    derivative = step_functions(model.plant, ())[1]
    n, lengths = len(model.plant.joints), []
    for recording in recordings:
        stride = max(1, round(_LONGEST / float(np.median(np.diff(recording.time)))))
        time, q = recording.time[::stride], recording.position[::stride]
        if time.size < 4:
            continue
        v, h = np.gradient(q, time, axis=0), np.diff(time)
        scale = np.maximum(np.std(q, axis=0), 1e-9)
        states, drive = np.hstack((q, v))[:-1], recording.effort[::stride][:-1]
        by_x = derivative.map(h.size)(states.T, drive.T, 0.0 * drive.T, np.tile(model.values, (h.size, 1)).T)[0]
        a = np.array(by_x).reshape(2 * n, h.size, 2 * n).transpose(1, 0, 2) * h[:, None, None]
        gain = np.eye(2 * n) + a + 0.5 * a @ a + a @ a @ a / 6.0
        for first in range(0, h.size, max(1, h.size // 12)):
            product, end = np.eye(2 * n), first
            while end < h.size and time[end] - time[first] < longest:
                product = gain[end] @ product
                end += 1
                if not np.max(np.abs(product[:n, :n] * scale / scale[:, None])) < _APART:
                    lengths.append(float(time[end] - time[first]))
                    break
            else:
                # A rest of the recording shows no length.
                if time[min(end, h.size)] - time[first] >= longest:
                    lengths.append(longest)
    return float(np.quantile(lengths, 0.25)) if lengths else longest


def line_errors(data: Windows) -> Array:
    """Return the rms errors of the best straight lines through each joint of each window, shape (n,)."""
    errors = np.zeros_like(data.position)
    for i, inside in enumerate(data.inside):
        errors[i, inside] = off_line(data.time[i, inside], data.position[i, inside])
    return rms_by_joint(errors, data)


def rms_by_joint(errors: Array, data: Windows) -> Array:
    """Return the rms of errors of shape (w, l, n) at the samples of the windows, shape (n,)."""
    return np.asarray(np.sqrt(np.mean(errors[data.inside] ** 2, axis=0)))
