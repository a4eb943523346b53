"""Levenberg-Marquardt on parameters and window states together, for any number of joints.

The normal matrix is an arrowhead: a dense block for the few parameters, a small one for each window's initial state,
and the coupling between them. The states are eliminated window by window (Schur complement), so a recording of any
length is as cheap as its simulation. The algebra is compiled: a search takes thousands of steps on blocks of 2 x 2.

Source: Bock, "Recent advances in parameter identification techniques for ODE", 1983 (multiple shooting); Triggs et al.,
"Bundle adjustment", 2000, sec. 6 (Schur complement) and sec. 4.3 (robust weights); Golub and Pereyra, Inverse Problems
19, 2003 (separable problems).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numba import njit

from pendulum_bags.arrays import Array

__all__ = [
    "Blocks",
    "M",
    "Model",
    "Motion",
    "Prior",
    "Solution",
    "bounded_step",
    "eliminate",
    "find_states",
    "minimise",
    "robust_cost",
]

_FEW, _HELD = 0.25, 1e4
"""Share of the windows that may spoil a step by their own states alone, and their damping above which they cannot.

Where a joint comes to rest the loss has a kink, and derivatives with respect to a window's state mislead there. One
such window must not shorten the steps of all others, or the search ends far from the minimum.
"""

_STUCK, _PROGRESS = 10, 0.99
"""Steps over which a hopeless search has to take its cost below a share of what it was, or ends."""


@dataclass(frozen=True)
class Prior:
    """Known values of some parameters, shape (k,), and one over their variances or 0."""

    values: Array
    weights: Array

    def cost(self, values: Array) -> float:
        """Return the addition to the sum of squares."""
        return float(self.weights @ (values - self.values) ** 2)


@dataclass(frozen=True)
class Blocks:
    """Normal equations of k parameters and of w windows with x states each.

    Attributes:
        h_pp: Parameters with parameters, shape (k, k).
        h_px: Parameters with states, shape (w, k, x).
        h_xx: States with states, shape (w, x, x).
        g_p: Gradient of the parameters, shape (k,).
        g_x: Gradient of the states, shape (w, x).
    """

    h_pp: Array
    h_px: Array
    h_xx: Array
    g_p: Array
    g_x: Array

    @classmethod
    def zeros(cls, k: int, w: int, x: int) -> Blocks:
        """Return empty blocks."""
        return cls(np.zeros((k, k)), np.zeros((w, k, x)), np.zeros((w, x, x)), np.zeros(k), np.zeros((w, x)))


M = TypeVar("M", bound="Model")


class Model(Protocol):
    """Parameters of a simulation, by name and as a vector."""

    vector: Array

    def __getitem__(self, name: str) -> float:
        """Return one value."""

    def index(self, names: Sequence[str]) -> list[int]:
        """Return the places of some parameters in the vector."""

    def with_vector(self: M, vector: Array) -> M:
        """Return the model with other values."""

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the domain of a parameter."""

    def size(self, name: str) -> float:
        """Return a scale of a parameter, in its unit, so that steps do not depend on units."""

    def prior(self, names: Sequence[str]) -> Prior:
        """Return what is known of some parameters beforehand."""
        return Prior(np.zeros(len(names)), np.zeros(len(names)))

    def within_reach(self: M, _other: M) -> bool:
        """Return whether one step may lead from here to another model."""
        return True


_M_contra = TypeVar("_M_contra", contravariant=True)


class Motion(Protocol[_M_contra]):
    """The errors of one recording, cut into windows, under a model."""

    @property
    def scale(self) -> float:
        """Error at which the loss turns from quadratic to linear; inf for least squares."""

    def errors(self, model: _M_contra, states: Array) -> Array:
        """Return the errors in all windows; states have the shape (w, x)."""

    def sensitivities(self, model: _M_contra, states: Array, names: Sequence[str]) -> tuple[Array, Array, list[int]]:
        """Return those to parameters and states, shape (n, k + x), the errors (n,), and where windows begin and end."""


def robust_cost(errors: Array, scale: float) -> float:
    """Return the soft-L1 loss, sum of 2 s^2 (sqrt(1 + (r/s)^2) - 1), of errors; s = inf gives the sum of squares."""
    if not math.isfinite(scale):
        return float(errors @ errors)
    ratio = errors / scale
    return float(2.0 * scale * scale * np.sum(np.sqrt(1.0 + ratio * ratio) - 1.0))


def _loss(errors: Array, scale: float) -> float:
    return robust_cost(errors, scale) if np.isfinite(errors).all() else np.inf


def _normal_equations(
    motion: Motion[M], model: M, states: Array, names: Sequence[str]
) -> tuple[float, Blocks, list[int]]:
    """Return loss, normal equations and ends of windows; the loss is inf where a derivative overflows."""
    sensitivity, errors, ends = motion.sensitivities(model, states, names)
    loss, (k, width) = robust_cost(errors, motion.scale), (len(names), sensitivity.shape[1])
    if math.isfinite(motion.scale):
        root = (1.0 + (errors / motion.scale) ** 2) ** -0.25
        sensitivity, errors = sensitivity * root[:, None], errors * root
    matrix, gradient = np.empty((len(states), width, width)), np.empty((len(states), width))
    for n, (a, b) in enumerate(itertools.pairwise(ends)):
        part = sensitivity[a:b]
        np.matmul(part.T, part, out=matrix[n])
        np.matmul(errors[a:b], part, out=gradient[n])
    blocks = Blocks(
        matrix[:, :k, :k].sum(axis=0),
        matrix[:, :k, k:],
        matrix[:, k:, k:],
        gradient[:, :k].sum(axis=0),
        gradient[:, k:],
    )
    return (loss if math.isfinite(float(matrix.sum())) else np.inf), blocks, ends


@dataclass(frozen=True)
class Solution(Generic[M]):
    """Result of one minimisation.

    Args:
        model: Parameters at the minimum; the mean where recordings have values of their own.
        states: Initial states by recording, each shape (w, x).
        cost: Loss, sum over samples; inf where no motion stays within bounds.
        converged: Whether the search ended at a minimum, before its last iteration.
        offsets: Values that each recording has of its own, shape (recordings, m).
    """

    model: M
    states: list[Array]
    cost: float
    converged: bool
    offsets: Array


def minimise(
    model: M,
    motions: Sequence[Motion[M]],
    states: Sequence[Array],
    free: Sequence[str],
    *,
    own: Sequence[str] = (),
    offsets: Array | None = None,
    max_iterations: int,
    tolerance: float,
    hopeless: float = np.inf,
) -> Solution[M]:
    """Minimise the loss of all recordings over free parameters and window states, shape (w, x) by recording.

    Each recording has values of its own of the parameters ``own``, which are not in ``free``, and which begin at
    ``offsets``, shape (recordings, m), or the model's. The search ends after ``max_iterations``, where a step lowers
    the loss by less than a share ``tolerance``, or where a loss above ``hopeless`` makes little progress.
    """
    k, m, count = len(free), len(own), len(motions)
    names = (*free, *(name for _ in motions for name in own))
    index = np.array(model.index(names), dtype=np.int64)
    # The unknowns of each recording: those that all have in common, then its own.
    columns = [[*range(k), *range(k + m * r, k + m * (r + 1))] for r in range(count)]
    low, high = np.array([model.bounds(name) for name in names]).reshape(-1, 2).T
    size, prior = np.array([model.size(name) for name in names]), model.prior(names)
    found, x = np.clip(model.vector[index], low, high), [np.array(s, dtype=float) for s in states]
    if offsets is not None:
        found[k:] = np.ravel(offsets)
    ends = [0, *np.cumsum([len(s) for s in x]).tolist()]

    def models(values: Array) -> list[M]:
        vectors = [np.array(model.vector) for _ in motions]
        for vector, at in zip(vectors, columns, strict=True):
            vector[index[at]] = values[at]
        return list(map(model.with_vector, vectors)) if m else [model.with_vector(vectors[0])] * count

    def losses_of(models: Sequence[M], x: Sequence[Array]) -> Array:
        errors = [motion.errors(one, state) for motion, one, state in zip(motions, models, x, strict=True)]
        return np.array(
            [
                _loss(each[a:b], motion.scale)
                for each, motion, some in zip(errors, motions, cuts, strict=True)
                for a, b in itertools.pairwise(some)
            ]
        )

    def linearise() -> tuple[float, Blocks]:
        blocks, cost = Blocks.zeros(len(names), ends[-1], x[0].shape[1] if count > 1 else 0), prior.cost(found)
        for one, motion, at, state, (a, b) in zip(best, motions, columns, x, itertools.pairwise(ends), strict=True):
            loss, part, cut = _normal_equations(motion, one, state, (*free, *own))
            if len(cuts) < count:
                cuts.append(cut)
            if not math.isfinite(loss):
                return np.inf, blocks
            cost += loss
            if count == 1:
                blocks = part
                break
            blocks.h_pp[np.ix_(at, at)] += part.h_pp
            blocks.h_px[a:b, at], blocks.h_xx[a:b], blocks.g_x[a:b] = part.h_px, part.h_xx, part.g_x
            blocks.g_p[at] += part.g_p
        blocks.h_pp.flat[:: len(names) + 1] += prior.weights
        blocks.g_p[:] += prior.weights * (found - prior.values)
        return cost, blocks

    best, cuts = models(found), list[list[int]]()
    damping, converged = 1e-4, False
    held = np.full(ends[-1], damping)
    cost, blocks = linearise()
    before, costs, current = (found, best, x, cost, blocks), [cost], True
    for _ in range(max_iterations if math.isfinite(cost) else 0):
        if cost > hopeless and len(costs) > _STUCK and cost > _PROGRESS * costs[-_STUCK - 1]:
            break
        costs.append(cost)
        if not current:
            following, blocks = linearise()
            current = True
            if not math.isfinite(following):
                # So far along an unstable motion the derivatives have no size: a smaller step.
                found, best, x, cost, blocks = before
                damping *= 40.0
        step = _damped_step(blocks, found, low, high, damping, np.maximum(held, damping), size)
        if step is None:
            damping *= 10.0
            if damping > 1e12:
                break
            continue
        d_p, d_x, gain = step
        trial = np.clip(found + d_p, low, high)
        candidates = models(trial)
        if not best[0].within_reach(candidates[0]):
            damping *= 4.0
            continue
        x_trial = [state + d_x[a:b] for state, (a, b) in zip(x, itertools.pairwise(ends), strict=True)]
        new_cost = prior.cost(trial)
        for one, motion, state in zip(candidates, motions, x_trial, strict=True):
            new_cost += _loss(motion.errors(one, state), motion.scale)
        if new_cost < cost:
            before, current = (found, best, x, cost, blocks), False
            good = (cost - new_cost) / max(gain, 1e-300) > 0.25
            damping = max(damping * (0.2 if good else 1.0), 1e-10)
            held = np.maximum(0.2 * held, 1e-10)
            converged = (cost - new_cost) / cost < tolerance
            found, best, x, cost = trial, candidates, x_trial, new_cost
        else:
            spoilt = losses_of(candidates, x_trial) - losses_of(best, x) > gain
            if 0 < np.count_nonzero(spoilt) <= _FEW * spoilt.size and held[spoilt].max() < _HELD:
                held[spoilt] = 40.0 * np.maximum(held[spoilt], damping)
                continue
            damping *= 5.0
            converged = gain < tolerance * cost or damping > 1e10
        if converged:
            break
    values = found[k:].reshape(count, m)
    if m:
        return Solution(model.with_vector(np.mean([one.vector for one in best], axis=0)), x, cost, converged, values)
    return Solution(best[0], x, cost, converged, values)


def _damped_step(
    blocks: Blocks, values: Array, low: Array, high: Array, damping: float, held: Array, size: Array
) -> tuple[Array, Array, float] | None:
    """Return the step of parameters and states and the decrease it predicts, or None if the system is singular.

    ``held`` is the damping of the states of each window, shape (w,).
    """
    k = blocks.g_p.size
    reduced, gradient, inverses = eliminate(blocks.h_pp, blocks.h_px, blocks.h_xx, blocks.g_p, blocks.g_x, held)
    d_p = np.zeros(k)
    if k:
        own = np.maximum(blocks.h_pp.diagonal(), 0.0) * size**2
        # A parameter without any effect stays where it is.
        own += 1e-12 * max(float(own.max()), 1e-30)
        system = reduced * np.outer(size, size)
        system.flat[:: k + 1] += damping * own
        try:
            d_p = size * bounded_step(system, size * gradient, values / size, low / size, high / size)
        except np.linalg.LinAlgError:
            return None
    d_x, decrease = find_states(blocks.h_px, blocks.h_xx, blocks.g_x, inverses, d_p)
    return d_p, d_x, decrease - 2.0 * float(blocks.g_p @ d_p) - float(d_p @ blocks.h_pp @ d_p)


def bounded_step(system: Array, gradient: Array, values: Array, low: Array, high: Array) -> Array:
    """Return the step of a quadratic model within bounds: what would leave them stops there, the others solve again.

    All but the damped matrix ``system``, shape (k, k), have the shape (k,); ``gradient`` is half of the derivative.
    """
    step = np.linalg.solve(system, -gradient)
    active = np.zeros(step.size, dtype=bool)
    for _ in range(step.size):
        reached = values + step
        outside = ((reached < low) | (reached > high)) & ~active
        if not outside.any():
            break
        step[outside] = np.clip(reached, low, high)[outside] - values[outside]
        active |= outside
        idle = np.flatnonzero(~active)
        right = -(gradient + system @ np.where(active, step, 0.0))[idle]
        step[idle] = np.linalg.solve(system[np.ix_(idle, idle)], right)
    return np.asarray(step)


@njit(cache=True)
def eliminate(
    h_pp: Array, h_px: Array, h_xx: Array, g_p: Array, g_x: Array, damping: Array
) -> tuple[Array, Array, Array]:
    """Return the reduced matrix (k, k), the reduced gradient (k,) and the inverse damped state blocks (w, x, x).

    Arguments as in :class:`Blocks`; ``damping`` is the share of each state block's diagonal that is added to it,
    shape (w,).
    """
    k, x = h_px.shape[1], h_px.shape[2]
    reduced, gradient, inverses = h_pp.copy(), g_p.copy(), h_xx.copy()
    left = np.zeros(x)
    for n in range(h_xx.shape[0]):
        inverse, largest = inverses[n], 0.0
        for i in range(x):
            largest = max(largest, inverse[i, i])
        # A state that a wrong model's motion hardly shows must not stop the search.
        least = 1e-14 * largest if largest > 0.0 else 1.0
        for i in range(x):
            inverse[i, i] += damping[n] * (inverse[i, i] + 1e-12) + least
        for i in range(x):  # Gauss-Jordan; the block is positive definite, which needs no pivoting
            pivot = 1.0 / max(inverse[i, i], least)
            inverse[i, i] = 1.0
            for j in range(x):
                inverse[i, j] *= pivot
            for r in range(x):
                if r != i:
                    factor = inverse[r, i]
                    inverse[r, i] = 0.0
                    for j in range(x):
                        inverse[r, j] -= factor * inverse[i, j]
        for i in range(k):
            for a in range(x):
                left[a] = 0.0
                for b in range(x):
                    left[a] += h_px[n, i, b] * inverse[b, a]
                gradient[i] -= left[a] * g_x[n, a]
            for j in range(i + 1):
                taken = 0.0
                for a in range(x):
                    taken += left[a] * h_px[n, j, a]
                reduced[i, j] -= taken
    for i in range(k):
        for j in range(i):
            reduced[j, i] = reduced[i, j]
    return reduced, gradient, inverses


@njit(cache=True)
def find_states(h_px: Array, h_xx: Array, g_x: Array, inverses: Array, d_p: Array) -> tuple[Array, float]:
    """Return the step of the states (w, x) that belongs to one of the parameters, and the decrease it adds.

    Arguments as in :class:`Blocks`, with the inverse damped state blocks and the step of the parameters (k,).
    """
    steps, right = np.zeros(g_x.shape), np.zeros(g_x.shape[1])
    decrease = 0.0
    for n in range(g_x.shape[0]):
        for a in range(right.size):
            right[a] = g_x[n, a]
            for i in range(d_p.size):
                right[a] += h_px[n, i, a] * d_p[i]
        for a in range(right.size):
            for b in range(right.size):
                steps[n, a] -= inverses[n, a, b] * right[b]
        for a in range(right.size):
            decrease -= 2.0 * right[a] * steps[n, a]
            for b in range(right.size):
                decrease -= steps[n, a] * h_xx[n, a, b] * steps[n, b]
    return steps, decrease
