"""The search for the fit of several joints: windows, starts, extras worth their parameters, pushes left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.cross_validation import folds
from pendulum_bags.identification.explained import LARGEST_SHARE
from pendulum_bags.identification.joint_fit import (
    JointFit,
    Windows,
    error_weights,
    first_weights,
    fit,
    line_errors,
    prepare_windows,
    window_length,
)
from pendulum_bags.identification.joint_readings import better_reading, far_off
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.motion_model import DELAY, MotionModel
from pendulum_bags.identification.own_offsets import pay
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.selection import effective_samples
from pendulum_msgs_py.errors import DataError

__all__ = ["EXTRAS", "Found", "default_window", "search"]

_WINDOW = (0.5, 5.0)
"""Shortest and longest window by default [s], where neighbouring motions stay together. Each window's start takes up
two numbers per joint: parameters from long windows predict short ones better than those from short ones."""

_SHORTEST, _SHORTEST_BY_VELOCITY = 0.2, 0.1
"""Shortest window by default, however fast neighbouring motions part, and where velocities were measured [s]."""

_FAST = 0.005
"""Longest sampling period from which a lag of the actuators differs visibly from a delay [s]."""

_POOR = 0.25
"""Share of what straight lines miss from which on a fit is tried again by way of shorter windows."""

_DELAYS = tuple(0.01 * k for k in range(13))
"""Delays from which a search may start [s]."""

_CLEARS = 0.2
"""Share of the error that is left at most where a few windows, in which something pushed, made it."""

_PUSHED = 0.25
"""Share of the windows that may be left out as pushed."""

_FEWEST = 5
"""Windows below which no fit is tried."""

EXTRAS: Mapping[str, Mapping[str, bool]] = {
    "friction": {},
    "friction, offsets": {"offsets": True},
    "friction, delay": {"delay": True},
    "friction, offsets, delay": {"offsets": True, "delay": True},
    "friction, offsets, delay, lag": {"offsets": True, "delay": True, "lag": True},
}
"""Candidates: what is fitted in addition to masses and friction."""

ALL_EXTRAS = "friction, offsets, delay, lag"
"""The last of them, which is fitted where it is named: most recordings tell no lag from a delay."""

_WORTH = 0.98
"""A candidate with more parameters must bring the held-out error below this share of that of one with fewer."""


def _choose(
    start: MotionModel, data: Sequence[Windows], weights: Array, extras: str | None
) -> tuple[JointFit, str, dict[str, float]]:
    """Return the fit that predicts best what it has not seen, which candidate it is, and the held-out error of each.

    Each further parameter must be worth it. ``extras`` is the one candidate of ``EXTRAS`` to fit; None to choose.

    Raises:
        DataError: There is no such candidate.
    """
    best: tuple[float, JointFit, str] | None = None
    errors: dict[str, float] = {}
    model, states = start, None
    for name, wanted in EXTRAS.items():
        free = start.fitted(**wanted)
        if (name != extras if extras else name == ALL_EXTRAS) or (best is not None and free == best[1].free):
            continue
        found = fit(model, data, free, weights, states=states, tolerance=1e-4, hopeless=LARGEST_SHARE)
        if extras is not None:
            return _with_own_offsets(start, found, weights), name, {}
        if best is None and found.worst <= LARGEST_SHARE:
            model, states = found.model, found.states
        errors[name] = _held_out_error(found, data, weights)
        if best is None or errors[name] < _WORTH * best[0]:
            best = (errors[name], found, name)
    if best is None:
        raise DataError(f"extras is {extras!r}; expected one of {', '.join(EXTRAS)}")
    return _with_own_offsets(start, best[1], weights), best[2], errors


def _with_own_offsets(start: MotionModel, found: JointFit, weights: Array) -> JointFit:
    groups = found.model.own_offsets if len(found.data) > 1 else ()
    if not groups:
        return found
    # Where one offset for all explains little, its values are far off.
    begin: dict[str, Any] = {} if found.worst <= LARGEST_SHARE else {"model": start, "states": None}
    trials = [
        found.again(
            weights,
            own=own,
            offsets=None,
            free=tuple(name for name in found.free if name not in own),
            tolerance=1e-4,
            hopeless=LARGEST_SHARE,
            **begin,
        )
        for own in groups
    ]
    best = min(trials, key=lambda one: one.cost)
    each = weights[: len(found.model.coordinates.joints)]
    left = [
        joint[inside]
        for errors, part in zip(found.residuals, found.data, strict=True)
        for window, inside in zip(errors * each, part.inside, strict=True)
        for joint in window.T
    ]
    more = len(best.own) * len(found.data) - len(set(found.free) - set(best.free))
    return best if pay(found.cost, best.cost, effective_samples(left), more) else found


def _held_out_error(found: JointFit, data: Sequence[Windows], weights: Array) -> float:
    """Return the weighted rms of windows predicted by the others: recordings in turn, or thirds of a single one.

    The parameters without a fold are one Gauss-Newton step from those of all data, where their gradient is known.
    """
    size = np.array([found.model.size(name) for name in found.free])
    parts = folds(data, 3)
    if len(data) > 1:
        parts = [[np.arange(len(p.time) * (p is left_out)) for p in data] for left_out in data]
    cost, samples, seen = 0.0, 0, found.information
    for fold in parts:
        matrix, gradient = np.zeros((len(size), len(size))), np.zeros(len(size))
        for effects, errors, out in zip(seen.projected, seen.residual, fold, strict=True):
            for i in np.setdiff1d(np.arange(len(effects)), out):
                matrix += effects[i].T @ effects[i]
                gradient += effects[i].T @ errors[i]
        step = size * (np.linalg.pinv(matrix * np.outer(size, size), rcond=1e-10) @ (size * gradient))
        moved = {n: max(found.model[n] - d, found.model.bounds(n)[0]) for n, d in zip(found.free, step, strict=True)}
        model = found.model.with_changes(moved)
        for part, states, out in zip(data, found.states, fold, strict=True):
            if not out.size:
                continue
            one = fit(model, [part.subset(out)], (), weights, states=[states[out]], most=8, tolerance=1e-3)
            cost += one.cost
            samples += one.data[0].samples * np.count_nonzero(weights)
    return float(np.sqrt(cost / samples))


@dataclass(frozen=True)
class Found:
    """What a search ended with.

    Attributes:
        fit: The fit, each measurement weighed by its own error.
        extras: The candidate that it is.
        candidates: Held-out errors of all that were tried.
        length: Of the windows [s].
        parted: Whether windows are that short since neighbouring motions part.
        pushed: Windows left out since something else moves the machine there: recording, start and end [s].
    """

    fit: JointFit
    extras: str
    candidates: dict[str, float]
    length: float
    parted: bool = False
    pushed: Sequence[tuple[str, float, float]] = ()


def search(start: MotionModel, recordings: Sequence[JointRecording], window: float | None, extras: str | None) -> Found:
    """Return the best fit to recordings; arguments as of :func:`identify_joints`.

    Raises:
        DataError: The recordings are too short, or no fit explains them.
    """
    measured = all(recording.velocity is not None for recording in recordings)
    length, longest = default_window(start, recordings) if window is None else (window, window)
    if extras is None and measured and all(recording.period <= _FAST for recording in recordings):
        # Measured to their velocity, the recordings show these: left out, they would bias what is left.
        extras = ALL_EXTRAS
    best = _Search(start, recordings, extras).best(length, fixed=window is not None)
    found, pushed = _without_pushes(best.fit)
    # Now that the errors are known, each measurement counts by its own; of a fit to be refused none does.
    for _ in range(0 if found.worst > LARGEST_SHARE else 2 if measured else 1):
        found = found.again(error_weights(found))
    return replace(best, fit=found, parted=window is None and best.length < longest, pushed=pushed)


def default_window(start: MotionModel, recordings: Sequence[JointRecording]) -> tuple[float, float]:
    """Return the length of windows by default, and what it would be if neighbouring motions stayed together [s]."""
    longest = float(np.clip(sum(recording.duration for recording in recordings) / 6.0, *_WINDOW))
    measured = all(recording.velocity is not None for recording in recordings)
    shortest = _SHORTEST_BY_VELOCITY if measured else _SHORTEST
    return max(window_length(start, recordings, longest), shortest), longest


@dataclass(frozen=True)
class _Search:
    """A fit from the start, or by way of shorter windows where that ends in a poor minimum."""

    start: MotionModel
    recordings: Sequence[JointRecording]
    extras: str | None

    def best(self, length: float, *, fixed: bool) -> Found:
        """Return the best fit to windows of a length [s], or to shorter ones unless it is fixed.

        Raises:
            DataError: There are too few windows, or none is explained.
        """
        start = self.start
        data = self._windows(length)
        first = self._attempt(start, data, length)
        tried = [first] if isinstance(first, Found) else []
        # A minimum that is not poor has values of no machine where the search began far below the delay.
        well = tried and tried[0].fit.worst <= _POOR and far_off(tried[0].fit) is None
        if DELAY in (self.extras or DELAY) and not well and (late := self._late(start, data)) is not None:
            start = late
            again = self._attempt(start, data, length)
            tried += [again] if isinstance(again, Found) else []
        shortest = None
        for shorter in (length / 3.0, length / 9.0):
            if (tried and min(one.fit.worst for one in tried) <= _POOR) or shorter < _SHORTEST:
                break
            # Short windows have fewer minima: what they find is another start.
            near = self._attempt(start, self._windows(shorter), shorter)
            if not isinstance(near, Found) or near.fit.worst > DOUBTFUL_SHARE:
                continue
            again = self._attempt(near.fit.model, data, length)
            tried += [again] if isinstance(again, Found) else []
            shortest = None if fixed else near
        best = min(tried, key=lambda one: one.fit.worst) if tried else None
        # What long windows show, if poorly, predicts better than what short ones do.
        if shortest is not None and (best is None or best.fit.worst > LARGEST_SHARE):
            best = shortest
        if best is None:
            raise DataError(better_reading(self.start, data) or str(first))
        return best

    def _late(self, start: MotionModel, data: list[Windows]) -> MotionModel | None:
        """Return the start with the delay that explains most; None where that is its own."""
        weights, costs = first_weights(data), dict[float, float]()
        models = dict[float, MotionModel]()
        for delay in dict.fromkeys((start[DELAY], *_DELAYS)):
            models[delay] = start.with_changes({DELAY: delay})
            with suppress(DataError):
                costs[delay] = fit(models[delay], data, (), weights, most=4, tolerance=1e-2).cost
        best = min(costs, key=costs.__getitem__, default=start[DELAY])
        return None if best == start[DELAY] else models[best]

    def _windows(self, length: float) -> list[Windows]:
        data = [prepare_windows(recording, length) for recording in self.recordings]
        total = sum(len(part.time) for part in data)
        if total < _FEWEST:
            raise DataError(
                f"the recordings hold {total} windows of {length:.3g} s; expected at least {_FEWEST}: record for "
                "longer, or say a shorter --window"
            )
        return data

    def _attempt(self, start: MotionModel, data: list[Windows], length: float) -> Found | DataError:
        try:
            return Found(*_choose(start, data, first_weights(data), self.extras), length)
        except DataError as error:
            return error


def _without_pushes(found: JointFit) -> tuple[JointFit, list[tuple[str, float, float]]]:
    """Return the fit without the windows whose absence lets it explain the rest, and those windows."""
    total = sum(len(part.time) for part in found.data)
    share = found.worst
    if share <= DOUBTFUL_SHARE or total < 8:
        return found, []
    lines = np.sqrt(np.mean([line_errors(part) ** 2 for part in found.data], axis=0))
    now = found
    out: list[tuple[str, float, float]] = []
    while len(out) < _PUSHED * total:
        errors = [np.sqrt(np.sum((left / lines) ** 2, axis=(1, 2))) for left in now.residuals]
        piece = int(np.argmax([np.max(each) for each in errors]))
        window = int(np.argmax(errors[piece]))
        part = now.data[piece]
        if len(part.time) < 2:
            break
        since = part.recording.time[0]
        inside = part.time[window][part.inside[window]]
        out.append((part.recording.name, float(inside[0] - since), float(inside[-1] - since)))
        rest = np.delete(np.arange(len(part.time)), window)
        kept = [p.subset(rest) if i == piece else p for i, p in enumerate(now.data)]
        states = [np.delete(x, window, axis=0) if i == piece else x for i, x in enumerate(now.states)]
        now = now.again(1.0 / np.maximum(lines, 1e-9), data=kept, states=states, most=10, tolerance=1e-3)
        if now.worst <= min(DOUBTFUL_SHARE, _CLEARS * share):
            return now, sorted(out)
    return found, []
