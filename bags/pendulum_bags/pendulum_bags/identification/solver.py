"""Fits of one joint: the robust loss of its angle errors, and searches that begin from other window states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification import arrowhead
from pendulum_bags.identification.arrowhead import minimise
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, longest_step, simulate

__all__ = ["Solution", "angle_motions", "refine", "residuals", "solve"]

Solution: TypeAlias = arrowhead.Solution[FitModel]


def residuals(model: FitModel, pieces: Sequence[Piece], states: Sequence[Array] | None = None) -> list[Array]:
    """Return simulated minus measured angle of each piece, NaN outside its windows [rad]."""
    start = [piece.states for piece in pieces] if states is None else states
    return [simulate(model, p, x).theta - p.recording.position for p, x in zip(pieces, start, strict=True)]


@dataclass(frozen=True)
class _Motion:
    """The angle errors of one recording; its integration steps must not change within a fit, or the loss would jump."""

    piece: Piece
    scale: float
    step: float

    def errors(self, model: FitModel, states: Array) -> Array:
        theta = simulate(model, self.piece, states, step=self.step).theta
        return (theta - self.piece.recording.position)[self.piece.rows]

    def sensitivities(self, model: FitModel, states: Array, names: Sequence[str]) -> tuple[Array, Array, list[int]]:
        result, piece = simulate(model, self.piece, states, free=model.index(names), step=self.step), self.piece
        ends = [0, *np.cumsum(piece.windows[:, 1] - piece.windows[:, 0]).tolist()]
        return result.jacobian[piece.rows], (result.theta - piece.recording.position)[piece.rows], ends


def solve(
    model: FitModel,
    pieces: Sequence[Piece],
    free: Sequence[str],
    *,
    own: Sequence[str] = (),
    states: Sequence[Array] | None = None,
    scale: float = np.inf,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    coarse: float = 1.0,
) -> Solution:
    """Minimise the robust sum of squared angle errors [rad^2], which turns from quadratic to linear at ``scale`` [rad].

    Other arguments are those of :func:`~arrowhead.minimise`; ``coarse`` is a factor on the integration step, 1 for the
    final fit.
    """
    begin = [piece.states for piece in pieces] if states is None else states
    motions = angle_motions(model, pieces, scale, coarse)
    return minimise(model, motions, begin, free, own=own, max_iterations=max_iterations, tolerance=tolerance)


def angle_motions(model: FitModel, pieces: Sequence[Piece], scale: float, coarse: float = 1.0) -> list[_Motion]:
    """Return the errors of each piece under models near this one, whose integration steps they take."""
    return [_Motion(piece, scale, coarse * longest_step(model, piece.recording)) for piece in pieces]


def refine(solution: Solution, pieces: Sequence[Piece], free: Sequence[str], *, scale: float) -> Solution:
    """Return a solution that other initial states of single windows cannot better.

    Near standstill dry friction makes the cost of a window's initial velocity have several valleys (it moves on,
    or it sticks first): a joint search stays in the one where it began. Each window tries others by itself, and
    what helps is taken into a new joint search.
    """
    for _ in range(3):
        states, gain = [], 0.0
        for piece, current in zip(pieces, solution.states, strict=True):
            better = current.copy()
            for i in range(len(piece.windows)):
                single = [piece.subset([i])]
                unchanged = solve(solution.model, single, (), states=[current[[i]]], scale=scale, max_iterations=5)
                speed = max(abs(current[i, 1]), 0.02)
                lowest = unchanged.cost
                for velocity in (0.0, -speed, speed, float(piece.states[i, 1])):
                    start = np.array([[current[i, 0], velocity]])
                    trial = solve(solution.model, single, (), states=[start], scale=scale, max_iterations=15)
                    if trial.cost < lowest * (1.0 - 1e-6):
                        gain += lowest - trial.cost
                        lowest, better[i] = trial.cost, trial.states[0][0]
            states.append(better)
        if gain <= 1e-5 * solution.cost:
            break
        renewed = solve(solution.model, pieces, free, states=states, scale=scale, tolerance=1e-8)
        if renewed.cost >= solution.cost:
            break
        solution = renewed
    return solution
