"""How far recordings determine the parameters of several joints: intervals, and what each recording says alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.between_recordings import Alone, half_width
from pendulum_bags.identification.covariance import Errors, standard_errors
from pendulum_bags.identification.joint_fit import JointFit
from pendulum_bags.identification.motion_model import DELAY
from pendulum_bags.identification.notes import Interval, held_sentences, open_sentences
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_bags.runs.datasets import distinct_names
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.determined import SPAN

__all__ = ["assess_joints", "each_alone", "hold_undetermined"]


def hold_undetermined(found: JointFit) -> tuple[JointFit, list[str]]:
    """Return the fit with sizes that the recordings do not determine held at the start's, and their names."""
    start, own, held = found.model.start, set(found.model.sizes), list[str]()
    if found.worst > DOUBTFUL_SHARE:
        return found, held
    for _ in range(len(own) - 1):
        intervals = assess_joints(found).intervals
        open_ended = {
            n: found.relative
            for n, found in intervals.items()
            if n in own and (found.low <= 0.0 or found.high > SPAN * found.low)
        }
        if not open_ended:
            break
        worst = max(open_ended, key=lambda name: open_ended[name])
        free = tuple(name for name in found.free if name != worst)
        try:
            trial = found.again(found.weights, model=found.model.with_changes({worst: start[worst]}), free=free)
        except DataError:
            break
        if trial.cost > 1.1 * found.cost:
            # The start's value is no result: the recordings refuse it, though they know no better.
            break
        found = trial
        held.append(worst)
    return found, held


def assess_joints(found: JointFit, held: Sequence[str] = (), alone: Sequence[Alone] = ()) -> Uncertainty:
    """Return 95 % intervals, widened by coloured residuals and differences between recordings, within the domain."""
    free = found.free
    errors = _errors(found)
    intervals = {}
    for name, error in errors.deviation.items():
        value = found.model[name]
        half, deviation = half_width(name, alone, error, _freedom(found))
        low = max(value - half, found.model.bounds(name)[0])
        intervals[name] = Interval(value, low, value + half, deviation, errors.white_deviation[name])
    spread = np.sqrt(np.diag(errors.white))
    correlation = errors.white / np.outer(spread, spread)
    said = open_sentences(intervals, free, correlation, errors.condition, errors.singular, DELAY)
    largest = np.array([intervals[name].standard_error for name in free])
    return Uncertainty(
        intervals,
        free,
        correlation * np.outer(largest, largest),
        correlation,
        errors.condition,
        max(one.standard_error / max(one.white, 1e-300) for one in intervals.values()),
        "windows as clusters, recordings one by one",
        {},
        (*said, *held_sentences(found, held)),
    )


def _errors(found: JointFit) -> Errors:
    measured = sum(part.samples for part in found.data) * np.count_nonzero(found.weights)
    fitted = sum(states.size for states in found.states) + len(found.free) + found.offsets.size
    return standard_errors(
        found.information, found.model, found.free, freedom=float(measured - fitted), serial=False, clusters=True
    )


def _freedom(found: JointFit) -> float:
    return float(max(sum(len(part.time) for part in found.data) - len(found.free), 3))


def each_alone(found: JointFit) -> list[Alone]:
    """Return what each recording of several says alone."""
    rows = []
    names = distinct_names([part.recording for part in found.data])
    for i, (name, part) in enumerate(zip(names, found.data, strict=True)):
        if len(found.data) < 2 or len(part.time) < 2:
            continue
        try:
            offsets = found.offsets[[i]]
            one = found.again(found.weights, data=[part], states=[found.states[i]], offsets=offsets, tolerance=1e-7)
        except (DataError, np.linalg.LinAlgError):
            continue
        errors = _errors(one)
        # The error of few windows is itself uncertain.
        factor = float(student_quantile(0.975, _freedom(one)) / student_quantile(0.975, 1e6))
        deviation = {n: factor * error for n, error in errors.deviation.items()}
        rows.append(Alone(name, {n: one.model[n] for n in one.free}, deviation))
    return rows
