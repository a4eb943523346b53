"""Held-out score of a model: windows left out of the fit, predicted with it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import robust_cost
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, simulate
from pendulum_bags.identification.solver import Solution, solve
from pendulum_bags.identification.window_score import fit_states

__all__ = ["COARSE", "CrossValidation", "cross_validate", "folds", "predicted"]

COARSE = 3.0
"""Factor on the integration step while searching; the chosen model is fitted to the end without it."""

_SCALED = ("inertia", "damping", "gravity", "coulomb_friction", "stribeck_excess")
_DRY = ("damping", "coulomb_friction", "stribeck_excess", "load_friction")


class _Cut(Protocol):
    @property
    def states(self) -> Array: ...


@dataclass(frozen=True)
class CrossValidation:
    """Outcome of one model on all folds.

    Args:
        rms: Angle error over all held-out windows, their initial states fitted [rad].
        losses: Robust cost of each fold, shape (f,) [rad^2].
        vectors: Parameters fitted without each fold, shape (f, parameters).
    """

    rms: float
    losses: Array
    vectors: Array


def folds(pieces: Sequence[_Cut], count: int = 6) -> list[list[NDArray[np.int64]]]:
    """Return, by fold, the held-out window indices of each piece; contiguous blocks over the whole of the data.

    Neighbouring windows share slow disturbances: scattered folds would leak them into the training part.
    """
    sizes = [len(piece.states) for piece in pieces]
    number = min(count, sum(sizes))
    if number < 2:
        return []
    blocks = np.array_split(np.arange(sum(sizes)), number)
    starts = np.concatenate(([0], np.cumsum(sizes)))
    return [[block[(block >= a) & (block < b)] - a for a, b in itertools.pairwise(starts)] for block in blocks]


def predicted(
    windows: Sequence[tuple[Array, Array]], pieces: Sequence[_Cut], columns: Sequence[int], known: Array
) -> tuple[Array, Array]:
    """Return the squares of each fold by fits one Gauss-Newton step away, shape (f,), and the step of all data.

    ``windows`` are of :class:`~pendulum_bags.identification.covariance.Information`; of its sensitivities those of
    some ``columns``, shape (k,), are used. ``known`` weighs what is known beforehand of the first m ones, shape (m,).
    """
    every = [(effects[:, columns], errors) for effects, errors in windows]
    parts = [(effects.T @ effects, effects.T @ errors) for effects, errors in every]
    matrix = np.diag(np.pad(known, (0, len(columns) - len(known)))) + np.sum([own for own, _ in parts], axis=0)
    gradient = np.sum([own for _, own in parts], axis=0)
    firsts = np.cumsum([0, *(len(piece.states) for piece in pieces)])[:-1]
    squares = []
    for fold in folds(pieces):
        out = np.concatenate([own + first for own, first in zip(fold, firsts, strict=True)]).tolist()
        rest = matrix - np.sum([parts[i][0] for i in out], axis=0)
        step = _solved(rest, gradient - np.sum([parts[i][1] for i in out], axis=0))
        squares.append(sum(float(np.sum((every[i][1] - every[i][0] @ step) ** 2)) for i in out))
    return np.array(squares), _solved(matrix, gradient)


def _solved(matrix: Array, gradient: Array) -> Array:
    size = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    inverse = np.linalg.pinv(matrix * np.outer(size, size), rcond=1e-10, hermitian=True)
    return np.asarray(size * (inverse @ (size * gradient)))


def _refit(
    model: FitModel, train: Sequence[Piece], states: Sequence[Array], free: Sequence[str], scale: float
) -> FitModel:
    """Return the model fitted to the training part.

    The cost has kinks (a reversal, a standstill), and a search that begins on one may keep what it has learnt from the
    held-out part: a start that did not get away is joined by others along the directions that recordings leave open.
    """

    def search(start: FitModel) -> Solution:
        return solve(start, train, free, states=states, scale=scale, max_iterations=30, tolerance=1e-6, coarse=COARSE)

    best = search(model)
    if any(abs(best.model[n] - model[n]) > 1e-4 * max(abs(model[n]), 1e-3) for n in free):
        return best.model
    for names, factor in ((_SCALED, 0.8), (_SCALED, 1.25), (_DRY, 0.5), (_DRY, 2.0)):
        values = {n: v * factor if n in names and n in free else v for n, v in model.values.items()}
        trial = search(replace(model, values=values))
        if trial.cost < best.cost:
            best = trial
    return best.model


def cross_validate(
    model: FitModel,
    pieces: Sequence[Piece],
    states: Sequence[Array],
    free: Sequence[str],
    scale: float,
    *,
    count: int = 6,
) -> CrossValidation | None:
    """Fit without each of ``count`` folds in turn and score on it; None where there is but one window.

    The arguments are of the fit to all data, from which each partial fit starts.
    """
    parts = folds(pieces, count)
    if not parts:
        return None
    squares, samples, losses, vectors = [], [], [], []
    for held in parts:
        train, train_states, test = [], [], []
        for piece, state, out in zip(pieces, states, held, strict=True):
            rest = np.setdiff1d(np.arange(len(piece.windows)), out)
            if rest.size:
                train.append(piece.subset(rest))
                train_states.append(state[rest])
            if out.size:
                test.append(replace(piece.subset(out), states=state[out]))
        fitted = _refit(model, train, train_states, free, scale)
        vectors.append(np.array(fitted.vector))
        total, loss, number = 0.0, 0.0, 0
        for piece in test:
            mask = piece.mask
            error = simulate(fitted, piece, fit_states(fitted, piece)).theta[mask] - piece.recording.position[mask]
            total += float(error @ error)
            loss += robust_cost(error, scale)
            number += error.size
        squares.append(total)
        samples.append(number)
        losses.append(loss)
    return CrossValidation(
        rms=float(np.sqrt(np.sum(squares) / np.sum(samples))), losses=np.array(losses), vectors=np.array(vectors)
    )
