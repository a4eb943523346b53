"""Held-out score of a model: windows left out of the fit, predicted with it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, simulate
from pendulum_bags.identification.solver import robust_cost, solve
from pendulum_bags.identification.window_score import fit_states

__all__ = ["CrossValidation", "cross_validate", "folds"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CrossValidation:
    """Outcome of one model on all folds.

    Args:
        rms: Angle error over all held-out windows, their initial states fitted [rad].
        by_fold: The same by fold, shape (f,) [rad].
        losses: Robust cost of each fold, shape (f,) [rad^2].
        vectors: Parameters fitted without each fold, shape (f, 14).
    """

    rms: float
    by_fold: Array
    losses: Array
    vectors: Array


def folds(pieces: Sequence[Piece], count: int = 6) -> list[list[NDArray[np.int64]]]:
    """Return, by fold, the held-out window indices of each piece; contiguous blocks over the whole of the data.

    Neighbouring windows share slow disturbances: scattered folds would leak them into the training part.
    """
    sizes = [len(piece.windows) for piece in pieces]
    number = min(count, sum(sizes))
    if number < 2:
        return []
    blocks = np.array_split(np.arange(sum(sizes)), number)
    starts = np.concatenate(([0], np.cumsum(sizes)))
    return [
        [block[(block >= a) & (block < b)] - a for a, b in itertools.pairwise(starts)] for block in blocks
    ]


def cross_validate(
    model: FitModel,
    pieces: Sequence[Piece],
    states: Sequence[Array],
    free: Sequence[str],
    scale: float,
    *,
    count: int = 6,
) -> CrossValidation | None:
    """Fit without each fold in turn and score on it; None where there is but one window.

    Args:
        model: Fit on all data: start of each partial fit.
        pieces: Data.
        states: Fitted window states by piece.
        free: Fitted parameters.
        scale: Of the robust loss [rad].
        count: Most folds.
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
                part = piece.subset(out)
                test.append(Piece(part.recording, part.windows, state[out], part.integral, part.enabled))
        fitted = solve(
            model,
            train,
            free,
            states=train_states,
            scale=scale,
            max_iterations=25,
            tolerance=1e-5,
            coarse=3.0,
        ).model
        vectors.append(np.array(fitted.vector))
        total, loss, number = 0.0, 0.0, 0
        for piece in test:
            mask = piece.mask()
            error = (
                simulate(fitted, piece, fit_states(fitted, piece)).theta[mask]
                - piece.recording.position[mask]
            )
            total += float(error @ error)
            loss += robust_cost(error, scale)
            number += error.size
        squares.append(total)
        samples.append(number)
        losses.append(loss)
    return CrossValidation(
        rms=float(np.sqrt(np.sum(squares) / np.sum(samples))),
        by_fold=np.sqrt(np.array(squares) / np.array(samples)),
        losses=np.array(losses),
        vectors=np.array(vectors),
    )
