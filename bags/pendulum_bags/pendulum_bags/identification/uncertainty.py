"""How far the data determine the parameters: covariance, correlation, condition, profiles, plain sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.between_recordings import Alone, half_width
from pendulum_bags.identification.covariance import FREQUENCY, Errors, candidate_errors, least_scale
from pendulum_bags.identification.model import BOUNDS, INDEX, UNITS, FitModel
from pendulum_bags.identification.notes import Interval, edge_sentences, open_sentences, scale_sentences
from pendulum_bags.identification.output_error import OFFSETS, OutputErrorFit
from pendulum_bags.identification.residual_tests import ResidualTests
from pendulum_bags.identification.selection import Candidate, akaike_weights, at_bounds
from pendulum_bags.identification.solver import solve
from pendulum_msgs_py.dynamics.joint_torques import PERIODIC

__all__ = ["Uncertainty", "assess", "profile_interval", "unresolved_offset"]

_MOST_PROFILES = 4
"""Parameters without a useful covariance that get a profile interval at most."""

_LEAST_INDEPENDENT = 5.0
"""Independent pieces that the residuals count as at least, in a profile."""

RIVAL = 0.02
"""Share of the fitted offset's Akaike weight from which on the other one counts as its equal (a difference of 8)."""


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


def assess(
    fit: OutputErrorFit, tests: ResidualTests, *, profiles: int = 2, explains: bool = True, alone: Sequence[Alone] = ()
) -> Uncertainty:
    """Return intervals and what limits them.

    With white residuals the intervals are those of least squares (the window states profiled out), corrected for
    the robust loss. With correlated residuals the largest of three errors counts: consistent under serial
    correlation, clustered by window, and the jackknife over the folds, which also sees how the parameters move from
    one part of the data to another. Friction models and offsets that the data speak for nearly as well count by their
    Akaike weights. An error of the model itself (something that no candidate has) is in no interval.

    ``profiles`` of the weakest parameters get profile intervals. Of a fit that does not explain the motion the cost
    excludes nothing that the folds leave open.

    Source:
        Ljung, System Identification, ch. 9; Efron and Tibshirani, An Introduction to the Bootstrap, ch. 11 (grouped
        jackknife); Buckland, Burnham and Augustin, Biometrics 53, 1997 (model choice).
    """
    chosen = fit.chosen
    model = chosen.solution.model
    own = candidate_errors(chosen, fit.pieces, fit.scale, white=tests.white)
    names = own.names
    deviation = _with_model_choice(fit, own, white=tests.white)
    basis = "white residuals" if tests.white else "correlated residuals and folds"
    folds = len(chosen.validation.vectors) if chosen.validation is not None else 6
    samples = sum(piece.samples for piece in fit.pieces)
    states = 2 * sum(len(piece.windows) for piece in fit.pieces)
    freedom = float(samples - states - len(names)) if tests.white else float(folds - 1)
    freedom = max(freedom, 2.0)
    quantile = float(student_quantile(0.975, freedom))
    intervals = {}
    for name in (*names, FREQUENCY):
        if name in deviation:
            half, deviation[name] = half_width(name, alone, deviation[name], freedom)
            factor = half / max(deviation[name], 1e-300)
            intervals[name] = _interval(name, model, deviation[name], own.white_deviation[name], factor)
    _widen_by_joint_offsets(intervals, fit, quantile, white=tests.white)
    ratio = np.array([deviation[n] / max(own.deviation[n], 1e-300) for n in names])
    covariance = own.covariance * np.outer(ratio, ratio) if names else own.covariance
    safe = np.array([deviation[n] or 1.0 for n in names])
    correlation = covariance / np.outer(safe, safe)
    inflation = max((deviation[n] / max(own.white_deviation[n], 1e-150) for n in names), default=1.0)
    signless = [n for n in names if _positive(n)]
    weak = sorted(signless, key=lambda n: -min(intervals[n].relative, 1e6))
    lost = [n for n in weak if intervals[n].relative > 1.0][:_MOST_PROFILES]
    found = {}
    for name in dict.fromkeys([*weak[:profiles], *lost]) if profiles else ():
        raised = deviation[name] / max(own.white_deviation[name], 1e-150)
        found[name] = low, high = profile_interval(fit, name, inflation=raised)
        held = intervals[name]
        if held.relative <= 1.0 or not explains:
            # One interval for everything: what either way of looking at a weak parameter leaves open.
            low, high = min(held.low, low), max(held.high, high)
        # Else the estimate's neighbourhood, all that a covariance knows, says nothing about ends that far.
        intervals[name] = replace(held, low=low, high=high)
    for name in at_bounds(chosen) if profiles else ():
        if model[name] <= 0.0 == BOUNDS[name][0]:
            high = profile_interval(fit, name, inflation=inflation)[1]
            intervals[name] = Interval(0.0, 0.0, high, 0.5 * high, 0.0)
    sentences = [
        *scale_sentences(intervals, names, fit),
        *open_sentences(intervals, names, correlation, own.condition, own.singular, "transport_delay"),
        *edge_sentences(intervals, fit, unresolved_offset(fit)),
    ]
    return Uncertainty(
        intervals, names, covariance, correlation, own.condition, inflation, basis, found, tuple(sentences)
    )


def _interval(name: str, model: FitModel, deviation: float, white: float, quantile: float) -> Interval:
    if name == FREQUENCY:
        # A frequency is positive, however uncertain: its logarithm has the symmetric interval.
        value = model.natural_frequency
        reach = float(np.exp(min(quantile * deviation / value, 100.0)))
        return Interval(value, value / reach, value * reach, deviation, white)
    value, half = model[name], quantile * deviation
    sought = {"angle_offset", "transport_delay", "load_friction", "drive_load_friction"}
    low, high = BOUNDS[name] if name in sought else (0.0 if _positive(name) else -np.inf, np.inf)
    return Interval(value, max(value - half, low), min(value + half, high), deviation, white)


def _widen_by_joint_offsets(
    intervals: dict[str, Interval], fit: OutputErrorFit, quantile: float, *, white: bool
) -> None:
    """Widen the interval of a single offset to what a fit of both leaves open: near one angle they act alike."""
    joint = next((c for c in fit.offset_candidates if set(OFFSETS) <= set(c.free)), None)
    fitted = [name for name in OFFSETS if name in fit.chosen.free]
    if joint is None or len(fitted) != 1 or fitted[0] not in intervals:
        return
    name, errors = fitted[0], candidate_errors(joint, fit.pieces, fit.scale, white=white)
    if name in errors.deviation:
        alone, both = (intervals[name], _interval(name, joint.solution.model, errors.deviation[name], 0.0, quantile))
        wide = max(alone.standard_error, both.standard_error)
        intervals[name] = replace(
            alone, low=min(alone.low, both.low), high=max(alone.high, both.high), standard_error=wide
        )


def _with_model_choice(fit: OutputErrorFit, own: Errors, *, white: bool) -> dict[str, float]:
    """Return the standard errors of the chosen candidate with those of the choice itself."""
    base = fit.chosen.as_searched.model
    averaged = dict.fromkeys(own.deviation, 0.0)
    for candidate, weight in _weighed(fit.candidates):
        errors = own
        if candidate is not fit.chosen:
            errors = candidate_errors(candidate, fit.pieces, fit.scale, white=white)
        for name, total in averaged.items():
            apart = _value(candidate.as_searched.model, name) - _value(base, name)
            averaged[name] = total + weight * float(np.hypot(errors.deviation.get(name, 0.0), apart))
    dry = _with_dry_friction(fit, own, white=white)
    fitted = set(OFFSETS) & set(fit.chosen.free)
    same = next((c.solution.model for c in fit.offset_candidates if set(OFFSETS) & set(c.free) == fitted), None)
    result = {}
    for name, deviation in own.deviation.items():
        squares = 0.0
        # An offset that others put elsewhere is no error of this one: see unresolved_offset.
        if same is not None and name not in OFFSETS:
            squares = sum(
                weight * (_value(c.solution.model, name) - _value(same, name)) ** 2
                for c, weight in _weighed(fit.offset_candidates)
            )
        result[name] = float(np.sqrt(max(deviation, averaged[name], dry.get(name, 0.0)) ** 2 + squares))
    return result


def _with_dry_friction(fit: OutputErrorFit, own: Errors, *, white: bool) -> dict[str, float]:
    """Return the errors that a fit with Coulomb friction has, where one without was chosen.

    Left out is not known to be 0: held-out windows prefer fewer parameters where noise is large.
    """
    rival = next((c for c in fit.candidates if c.friction == "coulomb"), None)
    if fit.chosen.friction != "viscous" or rival is None:
        return {}
    errors = candidate_errors(rival, fit.pieces, fit.scale, white=white)
    base, other = fit.chosen.as_searched.model, rival.as_searched.model
    return {
        name: float(np.hypot(errors.deviation.get(name, 0.0), _value(other, name) - _value(base, name)))
        for name in own.deviation
    }


def _weighed(candidates: Sequence[Candidate]) -> list[tuple[Candidate, float]]:
    if not candidates:
        return []
    weights = akaike_weights(candidates)
    return [(c, weights[id(c)]) for c in candidates if weights[id(c)] > 1e-3]


def _value(model: FitModel, name: str) -> float:
    return model.natural_frequency if name == FREQUENCY else model[name]


def unresolved_offset(fit: OutputErrorFit) -> str | None:
    """Return the offset that was left out although it would have done nearly as well as the fitted one."""
    fitted = [name for name in OFFSETS if name in fit.chosen.free]
    if len(fitted) != 1:
        return None
    weights = akaike_weights(fit.offset_candidates) if fit.offset_candidates else {}
    other = next(name for name in OFFSETS if name not in fitted)
    share = {
        name: sum(weights[id(c)] for c in fit.offset_candidates if set(OFFSETS) & set(c.free) == {name})
        for name in OFFSETS
    }
    return other if share[other] > RIVAL * share[fitted[0]] else None


def _positive(name: str) -> bool:
    return name not in {"torque_offset", "angle_offset", "input_gain", "transport_delay", *PERIODIC}


def _torque_scale(fit: OutputErrorFit, name: str) -> float:
    """Return how large a parameter would have to be to do what all torques do, where its unit tells; else 0."""
    model = fit.model
    drive = np.concatenate([model["input_gain"] * piece.recording.input for piece in fit.pieces])
    torque = max(model["gravity"], float(np.std(drive)))
    speeds = [np.diff(piece.recording.position) / np.diff(piece.recording.time) for piece in fit.pieces]
    speed = max(float(np.std(np.concatenate(speeds))), 1e-3)
    return {"N m": torque, "N m s/rad": torque / speed}.get(UNITS[name], 0.0)


def profile_interval(fit: OutputErrorFit, name: str, *, inflation: float = 1.0) -> tuple[float, float]:
    """Return the 95 % profile interval of one parameter: where the refitted cost has risen by its share.

    The other parameters and all window states are fitted again at each value, so a curved or one-sided valley
    shows, which a covariance cannot. The threshold rises by the square of ``inflation``, of coloured residuals.
    """
    solution = fit.chosen.solution
    best = solution.model
    others = tuple(n for n in fit.chosen.free if n != name)
    samples = sum(piece.samples for piece in fit.pieces)
    # However correlated, the folds count as independent: what doubles the cost is excluded, whatever its curvature.
    rise = 3.84 * solution.cost * min(inflation**2 / samples, 1.0 / _LEAST_INDEPENDENT)
    unit = max(abs(best[name]), least_scale(name), 1e-3 * _torque_scale(fit, name))
    ends = []
    for direction in (-1.0, 1.0):
        low, high, states, start = 0.0, None, solution.states, best
        if direction < 0.0 and _positive(name) and best[name] <= 0.0:
            ends.append(0.0)
            continue
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
        # What no cost stopped has no end.
        reach = np.inf if high is None else 0.5 * (low + high)
        value = best[name] + direction * reach
        ends.append(max(value, 0.0) if _positive(name) else value)
    return ends[0], ends[1]
