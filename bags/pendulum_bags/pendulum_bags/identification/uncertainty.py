"""How far the data determine the parameters: covariance, correlation, condition, profiles, plain sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pendulum_bags.identification.model import INDEX, FitModel
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.problem import Piece, longest_step, simulate
from pendulum_bags.identification.residual_tests import ResidualTests
from pendulum_bags.identification.selection import Candidate, at_bounds
from pendulum_bags.identification.solver import solve
from pendulum_bags.identification.wording import Interval, plain_sentences

__all__ = ["Interval", "Uncertainty", "assess", "profile_interval"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """Everything about how well the parameters are known.

    Args:
        intervals: By parameter, and for ``natural_frequency`` [rad/s].
        names: Order of the matrices.
        covariance: shape (k, k), units of the parameters.
        correlation: shape (k, k).
        condition_number: Of the information matrix, parameters scaled to their values.
        inflation: By which the standard errors exceed those of white residuals, largest over parameters.
        basis: Where the intervals come from: ``white residuals`` or ``correlated residuals and folds``.
        profiles: Profile intervals of the weak parameters.
        sentences: What this recording cannot determine, in words.
    """

    intervals: Mapping[str, Interval]
    names: tuple[str, ...]
    covariance: Array
    correlation: Array
    condition_number: float
    inflation: float
    basis: str
    profiles: Mapping[str, tuple[float, float]]
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class _Information:
    projected: list[Array]
    residual: list[Array]
    samples: int
    states: int


def assess(fit: OutputErrorFit, tests: ResidualTests, *, profiles: int = 2) -> Uncertainty:
    """Return intervals and what limits them.

    With white residuals the intervals are those of least squares (the window states profiled out), corrected for
    the robust loss. With correlated residuals the model itself is at fault: then the largest of three errors
    counts: consistent under serial correlation, clustered by window, and the jackknife over the folds, which
    also sees how the parameters move from one part of the data to another.

    Args:
        fit: The fit.
        tests: Its residual tests.
        profiles: For how many of the weakest parameters to compute profile intervals.

    Source:
        Ljung, System Identification, ch. 9; Newey and West, Econometrica 55, 1987; Liang and Zeger, Biometrika
        73, 1986 (clusters); Efron and Tibshirani, An
        Introduction to the Bootstrap, ch. 11 (grouped jackknife); Huber, Robust Statistics, sec. 7.6.
    """
    chosen = fit.chosen
    model = chosen.solution.model
    names = tuple(n for n in chosen.free if n not in set(at_bounds(chosen)))
    information = _information(model, fit.pieces, chosen.solution.states, names)
    white, singular, condition = _white_covariance(information, fit.scale, model, names)
    # Even white residuals are not alike everywhere: near a reversal the fit bends, and the sandwich sees it.
    linear, basis = _sandwich(white, information, fit.scale, clusters=not tests.white), "white residuals"
    covariance = linear
    freedom = float(information.samples - information.states - len(names))
    deviation = np.sqrt(np.maximum(np.diag(linear), 0.0))
    if not tests.white and names:
        # Along a firm direction the fit is as good as linear, and the sandwich is its error; along a weak one it
        # is not, and only fits without a part of the data show how far it moves.
        basis = "correlated residuals and folds"
        folds = len(chosen.validation.vectors) if chosen.validation is not None else 6
        freedom = float(folds - 1)
        before = np.sqrt(np.maximum(np.diag(linear), 1e-300))
        deviation = np.maximum(before, _jackknife(chosen, names))
        covariance = linear * np.outer(deviation / before, deviation / before)
    quantile = float(stats.t.ppf(0.975, max(freedom, 2.0)))
    intervals = {}
    for i, name in enumerate(names):
        value, half = model[name], quantile * float(deviation[i])
        floor = 0.0 if _positive(name) else -np.inf
        intervals[name] = Interval(
            value, max(value - half, floor), value + half, float(deviation[i]), float(np.sqrt(white[i, i]))
        )
    _add_frequency(intervals, model, names, linear, white, quantile)
    safe = np.where(deviation > 0.0, deviation, 1.0)
    correlation = covariance / np.outer(safe, safe)
    white_deviation = np.sqrt(np.maximum(np.diag(white), 1e-300))
    inflation = float(np.max(deviation / white_deviation)) if names else 1.0
    weak = sorted((n for n in names if n in intervals), key=lambda n: -min(intervals[n].relative, 1e6))[
        :profiles
    ]
    found = {name: profile_interval(fit, name, inflation=inflation) for name in weak}
    sentences = plain_sentences(intervals, names, correlation, condition, singular, found, fit)
    return Uncertainty(
        intervals, names, covariance, correlation, condition, inflation, basis, found, tuple(sentences)
    )


def _positive(name: str) -> bool:
    return name not in {"torque_offset", "angle_offset", "input_gain", "transport_delay"}


def _information(
    model: FitModel, pieces: Sequence[Piece], states: Sequence[Array], names: Sequence[str]
) -> _Information:
    """Return, by window, the sensitivities with the window's initial state projected out, and the residuals."""
    index = [INDEX[name] for name in names]
    projected, residual, samples, count = [], [], 0, 0
    for piece, state in zip(pieces, states, strict=True):
        result = simulate(model, piece, state, free=index, step=longest_step(model, piece.recording))
        for first, stop in piece.windows:
            jacobian = result.jacobian[first:stop]
            basis, _ = np.linalg.qr(jacobian[:, -2:])
            sensitivity = jacobian[:, :-2]
            projected.append(sensitivity - basis @ (basis.T @ sensitivity))
            residual.append(result.theta[first:stop] - piece.recording.position[first:stop])
            samples += stop - first
            count += 2
    return _Information(projected, residual, samples, count)


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
    size = np.array([max(abs(model[name]), _least_scale(name)) for name in names])
    _, singular, right = np.linalg.svd(stacked * size, full_matrices=False)
    condition = float((singular[0] / max(singular[-1], 1e-300)) ** 2) if singular.size else 1.0
    inverse = (
        (right.T / np.maximum(singular, 1e-12 * max(singular[0], 1e-300)) ** 2) @ right
        if singular.size
        else stacked
    )
    return variance * inverse * np.outer(size, size), right[-1] if len(names) else np.zeros(0), condition


def _least_scale(name: str) -> float:
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


def _jackknife(chosen: Candidate, names: Sequence[str]) -> Array:
    """Return the standard errors that the fits without one fold show, shape (k,); zeros where there are none."""
    validation = chosen.validation
    if validation is None or len(validation.vectors) < 2:
        return np.zeros(len(names))
    vectors = validation.vectors[:, [INDEX[name] for name in names]]
    count = len(vectors)
    return np.asarray(np.sqrt((count - 1) / count * np.sum((vectors - vectors.mean(axis=0)) ** 2, axis=0)))


def _add_frequency(
    intervals: dict[str, Interval],
    model: FitModel,
    names: Sequence[str],
    linear: Array,
    white: Array,
    quantile: float,
) -> None:
    """Add w0 = sqrt(G / J), whose error is far less than those of G and J where the scale is what is weak."""
    relevant = [name for name in ("gravity", "inertia") if name in names]
    if not relevant or model["gravity"] <= 0.0:
        return
    w0 = model.natural_frequency
    gradient = np.zeros(len(names))
    for name in relevant:
        gradient[list(names).index(name)] = (0.5 if name == "gravity" else -0.5) * w0 / model[name]
    error = float(np.sqrt(max(float(gradient @ linear @ gradient), 0.0)))
    white_error = float(np.sqrt(max(float(gradient @ white @ gradient), 0.0)))
    half = quantile * error
    intervals["natural_frequency"] = Interval(w0, w0 - half, w0 + half, error, white_error)


def profile_interval(fit: OutputErrorFit, name: str, *, inflation: float = 1.0) -> tuple[float, float]:
    """Return the 95 % profile interval of one parameter: where the refitted cost has risen by its share.

    The other parameters and all window states are fitted again at each value, so a curved or one-sided valley
    shows, which a covariance cannot.

    Args:
        fit: The fit.
        name: A free parameter.
        inflation: Factor on standard errors for correlated residuals; the threshold rises by its square.
    """
    solution = fit.chosen.solution
    best = solution.model
    others = tuple(n for n in fit.chosen.free if n != name)
    samples = sum(piece.samples for piece in fit.pieces)
    rise = 3.84 * solution.cost / samples * inflation**2
    unit = max(abs(best[name]), _least_scale(name))
    ends = []
    for direction in (-1.0, 1.0):
        low, high, states, start = 0.0, None, solution.states, best
        step = 0.02 * unit
        for _ in range(12):
            distance = low + step if high is None else 0.5 * (low + high)
            value = best[name] + direction * distance
            if value <= 0.0 and _positive(name):
                high = best[name] if high is None else high
                if distance >= best[name]:
                    value = 1e-6 * unit
            vector = np.array(start.vector)
            vector[INDEX[name]] = value
            trial = solve(
                start.with_vector(vector),
                fit.pieces,
                others,
                states=states,
                scale=fit.scale,
                max_iterations=15,
                tolerance=1e-5,
            )
            if trial.cost - solution.cost > rise:
                high = distance
            else:
                low, states, start = distance, trial.states, trial.model
                step *= 3.0
            if high is not None and high - low < 0.05 * high:
                break
        reach = low if high is None else 0.5 * (low + high)
        value = best[name] + direction * reach
        ends.append(max(value, 0.0) if _positive(name) else value)
    return ends[0], ends[1]
