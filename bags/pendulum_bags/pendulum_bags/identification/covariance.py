"""Covariance of the parameters of one fitted candidate, and what fits without a part of the data add to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import INDEX, FitModel
from pendulum_bags.identification.problem import Piece, longest_step, projected_sensitivities, simulate
from pendulum_bags.identification.selection import Candidate, at_bounds

__all__ = ["FREQUENCY", "Errors", "candidate_errors", "least_scale"]

FREQUENCY = "natural_frequency"
"""Name of w0 = sqrt(G / J) among the parameters."""


@dataclass(frozen=True)
class Errors:
    """Standard errors of one candidate.

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
class _Information:
    projected: list[Array]
    residual: list[Array]
    samples: int
    states: int


def candidate_errors(candidate: Candidate, pieces: Sequence[Piece], scale: float, *, white: bool) -> Errors:
    """Return the standard errors of a candidate; of residuals that are not white, by clusters and a jackknife too."""
    model = candidate.solution.model
    edges = set(at_bounds(candidate))
    names = tuple(n for n in candidate.free if n not in edges)
    information = _information(model, pieces, candidate.solution.states, names)
    plain, singular, condition = _white_covariance(information, scale, model, names)
    # Even white residuals are not alike everywhere: near a reversal the fit bends, and the sandwich sees it.
    linear = _sandwich(plain, information, scale, clusters=not white)
    # A friction that ended at 0 is not known to be 0: what it could take over from the others widens those.
    beside = tuple(n for n in ("damping", "coulomb_friction") if n in edges and model[n] <= 0.0)
    if beside and names:
        information = _information(model, pieces, candidate.solution.states, (*names, *beside))
        wide, _, _ = _white_covariance(information, scale, model, (*names, *beside))
        linear = _sandwich(wide, information, scale, clusters=not white)[: len(names), : len(names)]
        plain = wide[: len(names), : len(names)]
    before = np.sqrt(np.maximum(np.diag(linear), 1e-300))
    after = before
    if not white and names:
        # Along a firm direction the fit is as good as linear, and the sandwich is its error; along a weak one it
        # is not, and only fits without a part of the data show how far it moves.
        after = np.maximum(before, _jackknife(candidate, lambda vector: vector[[INDEX[n] for n in names]]))
    covariance = linear * np.outer(after / before, after / before) if names else linear
    deviation = dict(zip(names, map(float, after), strict=True))
    plain_deviation = dict(zip(names, map(float, np.sqrt(np.maximum(np.diag(plain), 0.0))), strict=True))
    gradient = _frequency_gradient(model, names)
    if gradient is not None:
        # G and J move together: w0 has far less error than either, and a jackknife of its own.
        error = float(np.sqrt(max(float(gradient @ linear @ gradient), 0.0)))
        if not white:
            error = max(error, float(_jackknife(candidate, _frequency_of)[0]))
        deviation[FREQUENCY] = error
        plain_deviation[FREQUENCY] = float(np.sqrt(max(float(gradient @ plain @ gradient), 0.0)))
    return Errors(names, covariance, plain, deviation, plain_deviation, singular, condition)


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


def _information(
    model: FitModel, pieces: Sequence[Piece], states: Sequence[Array], names: Sequence[str]
) -> _Information:
    """Return, by window, the sensitivities with the window's initial state projected out, and the residuals."""
    index = [INDEX[name] for name in names]
    projected: list[Array] = []
    residual: list[Array] = []
    samples = 0
    for piece, state in zip(pieces, states, strict=True):
        result = simulate(model, piece, state, free=index, step=longest_step(model, piece.recording))
        projected += projected_sensitivities(result, piece.windows)
        residual += [result.theta[a:b] - piece.recording.position[a:b] for a, b in piece.windows]
        samples += piece.samples
    return _Information(projected, residual, samples, 2 * len(projected))


def _influence(residual: Array, scale: float) -> tuple[Array, Array]:
    """Return psi(r), the derivative of the loss, and psi'(r)."""
    if not np.isfinite(scale):
        return residual, np.ones_like(residual)
    root = np.sqrt(1.0 + (residual / scale) ** 2)
    return residual / root, 1.0 / root**3


def _white_covariance(
    information: _Information, scale: float, model: FitModel, names: Sequence[str]
) -> tuple[Array, Array, float]:
    """Return the covariance for white residuals, the weakest direction (scaled), and the condition number."""
    stacked = np.concatenate(information.projected)
    residual = np.concatenate(information.residual)
    psi, slope = _influence(residual, scale)
    freedom = max(information.samples - information.states - len(names), 1)
    variance = float(psi @ psi) / freedom / float(np.mean(slope)) ** 2
    size = np.array([max(abs(model[name]), least_scale(name)) for name in names])
    _, singular, right = np.linalg.svd(stacked * size, full_matrices=False)
    condition = float(min(singular[0] / max(singular[-1], 1e-300), 1e150)) ** 2 if singular.size else 1.0
    inverse = (
        (right.T / np.maximum(singular, 1e-12 * max(singular[0], 1e-300)) ** 2) @ right if names else np.zeros((0, 0))
    )
    return variance * inverse * np.outer(size, size), right[-1] if len(names) else np.zeros(0), condition


def least_scale(name: str) -> float:
    """Return the scale below which a parameter counts as 0, in its unit."""
    return {"transport_delay": 1e-3, "angle_offset": 1e-2, "torque_offset": 1e-2}.get(name, 1e-6)


def _sandwich(white: Array, information: _Information, scale: float, *, clusters: bool) -> Array:
    """Return the covariance raised to that of residuals correlated within windows: serially, and as clusters."""
    if not white.size:
        return white
    stacked = np.concatenate(information.projected)
    _, slopes = _influence(np.concatenate(information.residual), scale)
    weight = max(float(np.mean(slopes)), 1e-3)
    bread = np.linalg.pinv(weight * stacked.T @ stacked, rcond=1e-14)
    serial, cluster = np.zeros_like(bread), np.zeros_like(bread)
    for sensitivity, residual in zip(information.projected, information.residual, strict=True):
        psi, _ = _influence(residual, scale)
        scores = sensitivity * psi[:, None]
        reach = max(1, len(psi) // 4)
        # Sums over all stretches of that length weigh the lags as Bartlett does.
        running = np.cumsum(np.pad(scores, ((reach + 1, reach), (0, 0))), axis=0)
        blocks = running[reach + 1 :] - running[: -reach - 1]
        serial += blocks.T @ blocks / (reach + 1)
        total = scores.sum(axis=0)
        cluster += np.outer(total, total)
    count = len(information.projected)
    errors = [white, bread @ serial @ bread]
    if clusters and count > 1:
        errors.append(bread @ cluster @ bread * count / (count - 1))
    old = np.sqrt(np.maximum(np.diag(white), 1e-300))
    factor = np.sqrt(np.max([np.maximum(np.diag(e), 0.0) for e in errors], axis=0)) / old
    return np.asarray(white * np.outer(factor, factor))


def _jackknife(candidate: Candidate, of: Callable[[Array], Array]) -> Array:
    """Return the standard error that the fits without one fold show of a function of the parameter vector, shape (k,).

    Source:
        Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 11.
    """
    validation = candidate.validation
    vectors = () if validation is None else validation.vectors
    if len(vectors) < 2:
        return np.zeros(np.shape(of(candidate.solution.model.vector)))
    values = np.array([of(vector) for vector in vectors])
    count = len(values)
    return np.asarray(np.sqrt((count - 1) / count * np.sum((values - values.mean(axis=0)) ** 2, axis=0)))
