"""Covariance of fitted parameters, and of one joint what fits without a part of the data add to it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import M, Model, Motion
from pendulum_bags.identification.model import INDEX, FitModel
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.selection import Candidate, at_bounds
from pendulum_bags.identification.solver import angle_motions

__all__ = [
    "FREQUENCY",
    "Errors",
    "Information",
    "candidate_errors",
    "information",
    "least_scale",
    "standard_errors",
    "without",
]

FREQUENCY = "natural_frequency"
"""Name of w0 = sqrt(G / J) among the parameters."""


@dataclass(frozen=True)
class Errors:
    """Standard errors of one fit.

    Args:
        names: Parameters with an error, order of the matrices.
        covariance: Raised to ``deviation``, shape (k, k).
        white: That of white residuals, shape (k, k).
        deviation: Standard errors by name; that of ``natural_frequency`` too where gravity is not 0.
        white_deviation: What white residuals alone would give, by name.
        singular: The direction that the data see least, shape (k,).
        condition: Condition number of the information matrix.
    """

    names: tuple[str, ...]
    covariance: Array
    white: Array
    deviation: dict[str, float]
    white_deviation: dict[str, float]
    singular: Array
    condition: float


@dataclass(frozen=True)
class Information:
    """What a fit sees, by recording and window.

    Attributes:
        projected: Sensitivities to k parameters without what initial states and own offsets can take over, (n, k).
        residual: Simulated minus measured, shape (n,).
    """

    projected: list[list[Array]]
    residual: list[list[Array]]

    @property
    def windows(self) -> list[tuple[Array, Array]]:
        """Sensitivities and residuals of each window."""
        return [*zip(itertools.chain(*self.projected), itertools.chain(*self.residual), strict=True)]


def information(
    models: Sequence[M],
    motions: Sequence[Motion[M]],
    states: Sequence[Array],
    free: Sequence[str],
    own: Sequence[str] = (),
) -> Information:
    """Return what the motions of recordings show of free parameters; ``own`` ones are of each recording."""
    k, projected, residuals = len(free), list[list[Array]](), list[list[Array]]()
    for model, motion, x in zip(models, motions, states, strict=True):
        sensitivity, errors, ends = motion.sensitivities(model, x, (*free, *own))
        parts = [sensitivity[a:b] for a, b in itertools.pairwise(ends)]
        rest = [without(each[:, k + len(own) :], each[:, : k + len(own)]) for each in parts]
        if own:
            stacked = np.concatenate(rest)
            follow = np.linalg.lstsq(stacked[:, k:], stacked[:, :k], rcond=None)[0]
            rest = [each[:, :k] - each[:, k:] @ follow for each in rest]
        projected.append(rest)
        residuals.append([errors[a:b] for a, b in itertools.pairwise(ends)])
    return Information(projected, residuals)


def without(columns: Array, values: Array) -> Array:
    """Return what some columns cannot take over of values, shape (n, k)."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def standard_errors(
    seen: Information,
    model: Model,
    names: Sequence[str],
    *,
    freedom: float,
    size: Array | None = None,
    scale: float = np.inf,
    serial: bool,
    clusters: bool,
) -> Errors:
    """Return the standard errors of parameters: the largest of those of white and of correlated residuals.

    What the model knows beforehand counts as measured. ``freedom`` is the number of measurements less that of what was
    fitted; ``size`` scales the parameters for the condition number, by default by their errors, were the others known;
    ``serial`` allows for residuals that are correlated within a window, ``clusters`` for what those of a window share.

    Source:
        Huber, Robust Statistics, sec. 7.6; Newey and West, Econometrica 55, 1987; Liang and Zeger, Biometrika 73, 1986.
    """
    prior = model.prior(names)
    stacked = np.concatenate(
        [each for each, _ in seen.windows] + [np.diag(np.sqrt(prior.weights))[prior.weights > 0.0]]
    )
    psi, slope = _influence(np.concatenate([each for _, each in seen.windows]), scale)
    weight = float(np.mean(slope))
    squares = float(psi @ psi) + prior.cost(np.array([model[name] for name in names]))
    if size is None:
        norm = np.linalg.norm(stacked, axis=0)
        size = np.array([1.0 / one if one > 0.0 else model.size(name) for one, name in zip(norm, names, strict=True)])
    _, singular, right = np.linalg.svd(stacked * size, full_matrices=False)
    condition = float(min(singular[0] / max(singular[-1], 1e-300), 1e150)) ** 2 if singular.size else 1.0
    inverse = np.zeros((0, 0))
    if names:
        inverse = (right.T / np.maximum(singular, 1e-12 * max(singular[0], 1e-300)) ** 2) @ right * np.outer(size, size)
    white = squares / max(freedom, 1.0) / weight**2 * inverse
    bread = inverse / max(weight, 1e-3)
    errors, count = [white], len(seen.windows)
    serially, cluster = np.zeros_like(white), np.zeros_like(white)
    for sensitivity, residual in seen.windows:
        scores = sensitivity * _influence(residual, scale)[0][:, None]
        if serial:
            reach = max(1, len(scores) // 4)
            # Sums over all stretches of that length weigh the lags as Bartlett does.
            running = np.cumsum(np.pad(scores, ((reach + 1, reach), (0, 0))), axis=0)
            blocks = running[reach + 1 :] - running[: -reach - 1]
            serially += blocks.T @ blocks / (reach + 1)
        total = scores.sum(axis=0)
        cluster += np.outer(total, total)
    if serial:
        errors.append(bread @ serially @ bread)
    if clusters and count > 1:
        errors.append(bread @ (cluster * count / (count - 1) + np.diag(prior.weights)) @ bread)
    before = np.sqrt(np.maximum(np.diag(white), 1e-300))
    after = np.sqrt(np.max([np.maximum(np.diag(each), 0.0) for each in errors], axis=0))
    return Errors(
        tuple(names),
        white * np.outer(after / before, after / before),
        white,
        dict(zip(names, after.tolist(), strict=True)),
        dict(zip(names, before.tolist(), strict=True)),
        right[-1] if names else np.zeros(0),
        condition,
    )


def candidate_errors(candidate: Candidate, pieces: Sequence[Piece], scale: float, *, white: bool) -> Errors:
    """Return the standard errors of a candidate; of residuals that are not white, by clusters and a jackknife too."""
    model, states = candidate.solution.model, candidate.solution.states
    edges = set(at_bounds(candidate))
    names = tuple(n for n in candidate.free if n not in edges)
    motions, measured = angle_motions(model, pieces, scale), sum(p.samples - 2 * len(p.windows) for p in pieces)

    def errors_of(*some: str) -> Errors:
        seen = information([model] * len(pieces), motions, states, some)
        size = np.array([max(abs(model[name]), least_scale(name)) for name in some])
        freedom = measured - len(some)
        # Even white residuals are not alike everywhere: near a reversal the fit bends, and the sandwich sees it.
        return standard_errors(
            seen, model, some, freedom=freedom, size=size, scale=scale, serial=True, clusters=not white
        )

    found = errors_of(*names)
    linear, plain = found.covariance, found.white
    # A friction that ended at 0 is not known to be 0: what it could take over from the others widens those.
    at_zero = tuple(n for n in ("damping", "coulomb_friction") if n in edges and model[n] <= 0.0)
    if at_zero and names:
        wide = errors_of(*names, *at_zero)
        linear, plain = (each[: len(names), : len(names)] for each in (wide.covariance, wide.white))
    before = np.sqrt(np.maximum(np.diag(linear), 1e-300))
    after = before
    if not white and names:
        # Along a firm direction the fit is as good as linear, and the sandwich is its error; along a weak one it
        # is not, and only fits without a part of the data show how far it moves.
        after = np.maximum(before, _jackknife(candidate, lambda vector: vector[[INDEX[n] for n in names]]))
    covariance = linear * np.outer(after / before, after / before)
    deviation = dict(zip(names, after.tolist(), strict=True))
    plain_deviation = dict(zip(names, np.sqrt(np.maximum(np.diag(plain), 0.0)).tolist(), strict=True))
    gradient = _frequency_gradient(model, names)
    if gradient is not None:
        # G and J move together: w0 has far less error than either, and a jackknife of its own.
        error = float(np.sqrt(max(float(gradient @ linear @ gradient), 0.0)))
        if not white:
            error = max(error, float(_jackknife(candidate, _frequency_of)[0]))
        deviation[FREQUENCY] = error
        plain_deviation[FREQUENCY] = float(np.sqrt(max(float(gradient @ plain @ gradient), 0.0)))
    return Errors(names, covariance, plain, deviation, plain_deviation, found.singular, found.condition)


def _frequency_of(vector: Array) -> Array:
    return np.sqrt(np.maximum(vector[[INDEX["gravity"]]], 0.0) / vector[INDEX["inertia"]])


def _frequency_gradient(model: FitModel, names: Sequence[str]) -> Array | None:
    relevant = [name for name in ("gravity", "inertia") if name in names]
    if not relevant or model["gravity"] <= 0.0:
        return None
    gradient = np.zeros(len(names))
    for name in relevant:
        sign = 0.5 if name == "gravity" else -0.5
        gradient[list(names).index(name)] = sign * model.natural_frequency / model[name]
    return gradient


def _influence(residual: Array, scale: float) -> tuple[Array, Array]:
    if not np.isfinite(scale):
        return residual, np.ones_like(residual)
    root = np.sqrt(1.0 + (residual / scale) ** 2)
    return residual / root, 1.0 / root**3


def least_scale(name: str) -> float:
    """Return the scale below which a parameter counts as 0, in its unit."""
    return {"transport_delay": 1e-3, "angle_offset": 1e-2, "torque_offset": 1e-2}.get(name, 1e-6)


def _jackknife(candidate: Candidate, of: Callable[[Array], Array]) -> Array:
    """Return the standard error that the fits without one fold show of a function of the parameters (Efron, ch. 11)."""
    validation = candidate.validation
    vectors = () if validation is None else validation.vectors
    if len(vectors) < 2:
        return np.zeros(np.shape(of(candidate.solution.model.vector)))
    values = np.array([of(vector) for vector in vectors])
    count = len(values)
    return np.asarray(np.sqrt((count - 1) / count * np.sum((values - values.mean(axis=0)) ** 2, axis=0)))
