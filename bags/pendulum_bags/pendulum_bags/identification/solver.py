"""Levenberg-Marquardt on parameters and window states together; the states are eliminated window by window.

The normal matrix is an arrowhead: a dense block for the few parameters, a 2 x 2 block for each window's
initial state, and the coupling between them. The Schur complement costs O(windows), so a recording of any
length is as cheap as its simulation. Source: Bock, "Recent advances in parameter identification techniques
for ODE", 1983 (multiple shooting); Triggs et al., "Bundle adjustment", 2000, sec. 6 (Schur complement) and
sec. 4.3 (robust weights); Golub and Pereyra, Inverse Problems 19, 2003 (separable problems).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.identification import kernel
from pendulum_bags.identification.arrowhead import bounded_step, eliminate, find_states
from pendulum_bags.identification.kernel import PARAMETER_NAMES
from pendulum_bags.identification.model import BOUNDS, INDEX, FitModel
from pendulum_bags.identification.problem import Piece, longest_step, simulate

__all__ = ["Solution", "refine", "residuals", "robust_cost", "solve"]


@dataclass(frozen=True)
class Solution:
    """Result of one minimisation.

    Args:
        model: Parameters at the minimum.
        states: Initial states by piece, each shape (w, 2).
        cost: Robust cost, sum over samples [rad^2].
        converged: Whether the step or the decrease became negligible.
        iterations: Steps tried.
        own: What each recording has a value of its own of, shape (pieces, m); the model has their mean.
    """

    model: FitModel
    states: list[Array]
    cost: float
    converged: bool
    iterations: int
    own: Array | None = None


def robust_cost(residual: Array, scale: float) -> float:
    """Return the soft-L1 cost, sum of 2 s^2 (sqrt(1 + (r/s)^2) - 1); s = inf gives the sum of squares [rad^2]."""
    if not math.isfinite(scale):
        return float(residual @ residual)
    ratio = residual / scale
    return float(2.0 * scale * scale * np.sum(np.sqrt(1.0 + ratio * ratio) - 1.0))


def residuals(model: FitModel, pieces: Sequence[Piece], states: Sequence[Array] | None = None) -> list[Array]:
    """Return simulated minus measured angle of each piece, NaN outside its windows [rad]."""
    start = [piece.states for piece in pieces] if states is None else states
    return [simulate(model, p, x).theta - p.recording.position for p, x in zip(pieces, start, strict=True)]


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
    bounds: dict[str, tuple[float, float]] | None = None,
    coarse: float = 1.0,
) -> Solution:
    """Minimise the robust sum of squared angle errors over the free parameters and all window states.

    Args:
        model: Start.
        pieces: Data.
        free: Names of the parameters to fit; none fits the window states alone.
        own: Names of what each piece has a value of its own of; none of them is in ``free``.
        states: Start of the window states; by default the pieces' first guesses.
        scale: Where the loss turns from quadratic to linear [rad].
        max_iterations: Most steps to try.
        tolerance: Relative decrease of the cost below which the fit has converged.
        bounds: Domain of parameters where it differs from ``BOUNDS``.
        coarse: Factor on the integration step; a search may take 3, an answer 1.
    """
    names = (*free, *(name for _ in pieces for name in own))
    index = np.array([INDEX[name] for name in names], dtype=np.int64)
    k, m = len(free), len(own)
    # The unknowns of each piece: those that all have in common, then its own.
    columns = [[*range(k), *range(k + m * r, k + m * (r + 1))] for r in range(len(pieces))]
    limits = {**BOUNDS, **(bounds or {})}
    low = np.array([limits[name][0] for name in names])
    high = np.array([limits[name][1] for name in names])
    x = [np.array(s, dtype=float) for s in (states or [piece.states for piece in pieces])]
    found = np.clip(model.vector[index], low, high)

    def models(values: Array) -> list[FitModel]:
        vectors = [np.array(model.vector) for _ in pieces]
        for vector, own_columns in zip(vectors, columns, strict=True):
            vector[index[own_columns]] = values[own_columns]
        if not m:
            return [model.with_vector(vectors[0])] * len(pieces)
        return [model.with_vector(vector) for vector in vectors]

    best = models(found)
    # The steps must not change within one fit, or the cost would jump with them.
    steps = [coarse * longest_step(best[0], piece.recording) for piece in pieces]
    masks = [piece.mask() for piece in pieces]
    measured = [piece.recording.position[mask] for piece, mask in zip(pieces, masks, strict=True)]
    ends = np.cumsum([len(piece.windows) for piece in pieces])[:-1]
    typical = _typical_scales(index)
    damping, cost, iterations, converged = 1e-4, np.inf, 0, False
    blocks = None
    while iterations < max_iterations:
        iterations += 1
        if blocks is None:
            cost, blocks = _linearise(best, pieces, x, index, columns, scale, steps, masks)
            if not math.isfinite(cost):
                break
        step = _damped_step(blocks, found, low, high, damping, typical)
        if step is None:
            damping *= 10.0
            if damping > 1e12:
                break
            continue
        d_p, d_x, gain = step
        trial = np.clip(found + d_p, low, high)
        candidates = models(trial)
        # An inertia is never negative: at most a fourfold change at a time.
        before, after = best[0]["inertia"], candidates[0]["inertia"]
        if after < 0.25 * before or after > 4.0 * before:
            damping *= 4.0
            continue
        x_trial = [a + b for a, b in zip(x, np.split(d_x, ends), strict=True)]
        new_cost = 0.0
        for one, piece, state, h, mask, known in zip(candidates, pieces, x_trial, steps, masks, measured, strict=True):
            r = simulate(one, piece, state, step=h).theta[mask] - known
            new_cost += robust_cost(r, scale) if np.isfinite(r).all() else np.inf
        if new_cost < cost:
            relative = (cost - new_cost) / cost
            found, best, x, blocks = trial, candidates, x_trial, None
            good = (cost - new_cost) / max(gain, 1e-300) > 0.25
            damping = max(damping * (0.2 if good else 1.0), 1e-10)
            cost = new_cost
            if relative < tolerance:
                converged = True
                break
        else:
            damping *= 5.0
            if gain < tolerance * cost or damping > 1e10:
                converged = gain < 1e-3 * cost
                break
    if not m:
        return Solution(best[0], x, cost, converged, iterations)
    mean = model.with_vector(np.mean([one.vector for one in best], axis=0))
    return Solution(mean, x, cost, converged, iterations, found[k:].reshape(len(pieces), m))


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
                kept = solve(solution.model, single, (), states=[current[[i]]], scale=scale, max_iterations=5)
                speed = max(abs(current[i, 1]), 0.02)
                lowest = kept.cost
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


def _typical_scales(index: NDArray[np.int64]) -> Array:
    """Return the least scale by which each parameter is damped, so that a zero column cannot blow up."""
    typical = {"transport_delay": 1e-2, "angle_offset": 1e-1, "stribeck_velocity": 1e-1}
    return np.array([typical.get(PARAMETER_NAMES[i], 1.0) for i in index])


@dataclass(frozen=True)
class _Blocks:
    """The arrowhead: parameters (k), states of all windows of all pieces (w, 2), what couples them, gradients."""

    h_pp: Array
    h_px: Array
    h_xx: Array
    g_p: Array
    g_x: Array


def _linearise(
    models: Sequence[FitModel],
    pieces: Sequence[Piece],
    states: Sequence[Array],
    index: NDArray[np.int64],
    columns: Sequence[Sequence[int]],
    scale: float,
    steps: Sequence[float],
    masks: Sequence[NDArray[np.bool_]],
) -> tuple[float, _Blocks]:
    k, windows = index.size, sum(len(piece.windows) for piece in pieces)
    blocks = _Blocks(
        np.zeros((k, k)), np.zeros((windows, k, 2)), np.zeros((windows, 2, 2)), np.zeros(k), np.zeros((windows, 2))
    )
    cost, begin = 0.0, 0
    for model, at, piece, state, h, mask in zip(models, columns, pieces, states, steps, masks, strict=True):
        result = simulate(model, piece, state, free=index[at].tolist(), step=h)
        residual = result.theta - piece.recording.position
        inside = residual[mask]
        if not (np.isfinite(inside).all() and np.isfinite(result.jacobian).all()):
            return np.inf, blocks
        cost += robust_cost(inside, scale)
        weight = np.ones_like(residual)
        if math.isfinite(scale):
            weight = 1.0 / np.sqrt(1.0 + (residual / scale) ** 2)
        own = slice(begin, begin + len(piece.windows))
        begin = own.stop
        h_pp, h_px, g_p = np.zeros((len(at), len(at))), np.zeros((len(piece.windows), len(at), 2)), np.zeros(len(at))
        kernel.normal_blocks(
            result.jacobian, residual, weight, piece.windows, h_pp, h_px, blocks.h_xx[own], g_p, blocks.g_x[own]
        )
        blocks.h_pp[np.ix_(at, at)] += h_pp
        blocks.h_px[own, at] = h_px
        blocks.g_p[at] += g_p
    return cost, blocks


def _damped_step(
    blocks: _Blocks, values: Array, low: Array, high: Array, damping: float, typical: Array
) -> tuple[Array, Array, float] | None:
    """Return the step of parameters and states and the decrease it predicts, or None if the system is singular."""
    k = blocks.g_p.size
    reduced, gradient, inverses = eliminate(blocks.h_pp, blocks.h_px, blocks.h_xx, blocks.g_p, blocks.g_x, damping)
    d_p = np.zeros(k)
    if k:
        own = blocks.h_pp.diagonal()
        floor = 1e-12 * max(float(own.max()), 1e-30)
        system = reduced.copy()
        system.flat[:: k + 1] += damping * (np.maximum(own, 0.0) + floor / typical**2)
        try:
            d_p = bounded_step(system, gradient, values, low, high)
        except np.linalg.LinAlgError:
            return None
    d_x, decrease = find_states(blocks.h_px, blocks.h_xx, blocks.g_x, inverses, d_p)
    return d_p, d_x, decrease - 2.0 * float(blocks.g_p @ d_p) - float(d_p @ blocks.h_pp @ d_p)
