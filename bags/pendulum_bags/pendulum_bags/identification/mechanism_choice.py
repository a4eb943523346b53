"""Which of the possible extras of a mechanism's fit are worth their parameters: by what the fit has not seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.explained import LARGEST_SHARE
from pendulum_bags.identification.mechanism_fit import MechanismFit, Windows, fit
from pendulum_bags.identification.mechanism_model import MechanismModel
from pendulum_bags.identification.own_offsets import pay
from pendulum_bags.identification.selection import effective_samples
from pendulum_msgs_py.errors import DataError

__all__ = ["ALL_EXTRAS", "EXTRAS", "choose"]

EXTRAS: Mapping[str, Mapping[str, bool]] = {
    "friction": {},
    "friction, offsets": {"offsets": True},
    "friction, delay": {"delay": True},
    "friction, offsets, delay": {"offsets": True, "delay": True},
    "friction, offsets, delay, lag": {"offsets": True, "delay": True, "lag": True},
}
"""Candidates: what is fitted beside masses and friction."""

ALL_EXTRAS = "friction, offsets, delay, lag"
"""The last of them, which is fitted where it is named: most recordings tell no lag from a delay."""

_WORTH = 0.98
"""A candidate with more parameters must bring the held-out error below this share of that of one with fewer."""


def choose(
    start: MechanismModel, data: Sequence[Windows], weights: Array, extras: str | None
) -> tuple[MechanismFit, str, dict[str, float]]:
    """Return the fit that predicts best what it has not seen, which candidate it is, and the held-out error of each.

    Each further parameter must be worth it. ``extras`` is the one candidate of ``EXTRAS`` to fit; None to choose.

    Raises:
        DataError: There is no such candidate.
    """
    best: tuple[float, MechanismFit, str] | None = None
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


def _with_own_offsets(start: MechanismModel, found: MechanismFit, weights: Array) -> MechanismFit:
    """Return the fit in which each of several recordings has offsets of its own, where the data ask for it."""
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
    each = weights[: len(found.model.plant.joints)]
    left = [
        joint[inside]
        for errors, part in zip(found.residuals, found.data, strict=True)
        for window, inside in zip(errors * each, part.inside, strict=True)
        for joint in window.T
    ]
    more = len(best.own) * len(found.data) - len(set(found.free) - set(best.free))
    return best if pay(found.cost, best.cost, effective_samples(left), more) else found


def _held_out_error(found: MechanismFit, data: Sequence[Windows], weights: Array) -> float:
    """Return the weighted rms of windows predicted by the others: recordings in turn, or thirds of a single one.

    The parameters without a fold are one Gauss-Newton step from those of all data, where their gradient is known.
    """
    size = np.array([found.model.size(name) for name in found.free])
    if len(data) > 1:
        folds = [
            [np.arange(len(p.time)) if i == j else np.zeros(0, dtype=int) for j, p in enumerate(data)]
            for i in range(len(data))
        ]
    else:
        folds = [[part] for part in np.array_split(np.arange(len(data[0].time)), 3)]
    cost, samples, seen = 0.0, 0, found.information
    for fold in folds:
        matrix, gradient = np.zeros((len(size), len(size))), np.zeros(len(size))
        for parts, errors, out in zip(seen.projected, seen.residual, fold, strict=True):
            for i in np.setdiff1d(np.arange(len(parts)), out):
                matrix += parts[i].T @ parts[i]
                gradient += parts[i].T @ errors[i]
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
