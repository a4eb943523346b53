"""Identification of a mechanism from recordings of all its joints: the fit, what it leaves open, whether it is one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
from threadpoolctl import threadpool_limits

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.between_recordings import Alone, excluding, half_width
from pendulum_bags.identification.covariance import Errors, standard_errors
from pendulum_bags.identification.explained import LARGEST_SHARE, REFUSED, Explained
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_choice import ALL_EXTRAS, choose
from pendulum_bags.identification.mechanism_doubt import better_reading, far_off, refusal
from pendulum_bags.identification.mechanism_fit import (
    MOST,
    MechanismFit,
    Windows,
    error_weights,
    first_weights,
    fit,
    line_errors,
    prepare_windows,
    scores,
    window_length,
)
from pendulum_bags.identification.mechanism_model import DELAY, MechanismModel, tellable
from pendulum_bags.identification.notes import Interval, held_sentences, open_sentences
from pendulum_bags.identification.own_offsets import OwnOffsets
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.result import IdentificationResult, check_distinct, fingerprint
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_bags.runs.datasets import distinct_names
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.determined import SPAN, undetermined
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["identify_mechanism"]

_WINDOW = (0.5, 5.0)
"""Shortest and longest window by default [s], where neighbouring motions stay together. Each window's start takes up
two numbers per joint: parameters from long windows predict short ones better than those from short ones."""

_SHORTEST, _SHORTEST_BY_VELOCITY = 0.2, 0.1
"""Shortest window by default, however fast neighbouring motions part, and where velocities were measured [s]."""

_FAST = 0.005
"""Longest sampling period from which a lag of the actuators can be told from a delay [s]."""

_POOR = 0.25
"""Share of what straight lines miss from which on a fit is tried again by way of shorter windows."""

_DELAYS = tuple(0.01 * k for k in range(13))
"""Delays from which a search may start [s]."""

_CLEARS = 0.2
"""Share of the error that is left at most where a few windows, in which something pushed, made it."""

_PUSHED = 0.25
"""Share of the windows that may be left out as pushed."""

_FEWEST = 5
"""Windows below which no fit is tried."""

_ONE_MACHINE = 1.1
"""Ratio up to which a size that differs from recording to recording may be one machine's."""


# BLAS on one core, as for one joint: a recording has the same result on every worker.
@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_mechanism(
    plant: PlantParameters,
    recordings: Sequence[JointRecording],
    *,
    held_out: Sequence[JointRecording] = (),
    window: float | None = None,
    extras: str | None = None,
    stride: int = 1,
) -> IdentificationResult:
    """Identify a mechanism by output error and judge the result.

    Args:
        plant: Start, and what is held: lengths, gears, gravity, masses that the motion does not determine.
        recordings: Data to fit, all of one machine.
        held_out: Recordings to score only.
        window: Length of the windows [s]; by default a sixth of the data, between 0.5 and 5 s, or what
            neighbouring motions stay together for.
        extras: One of ``EXTRAS``; None lets held-out windows choose.
        stride: Take every n-th position.

    Raises:
        DataError: A recording is too short, of other joints, or one joint of it does not move.
    """
    for recording in (*recordings, *held_out):
        recording.check(plant.coordinates)
    check_distinct(recordings, held_out)
    start = MechanismModel.of(plant)
    sixth = sum(recording.duration for recording in recordings) / 6.0
    longest = float(np.clip(sixth, *_WINDOW)) if window is None else window
    measured = all(recording.velocity is not None for recording in recordings)
    shortest = _SHORTEST_BY_VELOCITY if measured else _SHORTEST
    length = max(window_length(start, recordings, longest), shortest) if window is None else window
    if extras is None and measured and all(recording.period * stride <= _FAST for recording in recordings):
        # Measured to their velocity, the recordings show these: left out, they would bias what is left.
        extras = ALL_EXTRAS
    best = _Search(plant, recordings, extras, stride).best(length, fixed=window is not None)
    found, pushed = _without_pushes(best.fit)
    # Now that the errors are known, each measurement counts by its own; of a fit to be refused none does.
    weights = error_weights(found)
    for _ in range(0 if found.worst > LARGEST_SHARE else 2 if measured else 1):
        weights = error_weights(found)
        found = found.again(weights)
    found, held = _hold_undetermined(found, weights)
    names = distinct_names([*recordings, *held_out])
    training = dict(zip(names, found.scores, strict=False))
    others = [prepare_windows(recording, best.length, stride=stride) for recording in held_out]
    outside = dict(zip(names[len(recordings) :], scores(found.model, others, weights, own=found.own), strict=True))
    refused = refusal(found, training, outside)
    if refused is None and not found.converged:
        refused = f"{REFUSED}: the search had not ended after {MOST} steps; expected a start nearer to the machine"
    alone = _alone(found, weights)
    sizes = dict.fromkeys((name for name in tellable(plant) if name in found.free), _ONE_MACHINE)
    two = excluding(alone, sizes, found.model.unit)
    uncertainty = _uncertainty(found, held, alone)
    if refused is None:
        try:
            identified = found.model.identified(found.free, plant.name)
            ends = {n: (one.low, one.high) for n, one in uncertainty.intervals.items()}
            lost = [
                f"{n} ({uncertainty.intervals[n].text} {found.model.unit(n)})" for n in undetermined(identified, ends)
            ]
            refused = f"{REFUSED}: the recordings do not determine {', '.join(lost)}" if lost else None
        except ParameterError as error:
            refused = f"{REFUSED}: {error}"
    if refused is not None and two is not None:
        refused = f"{REFUSED}: {two[0].lower()}{two[1:]}"
    doubt = None
    if refused is None and found.worst > DOUBTFUL_SHARE:
        doubt = (
            f"{INCOMPLETE}: the model misses up to {100.0 * found.worst:.0f} % of what straight lines miss: something "
            "acts on the machine that it has no word for."
        )
    rms, lines = (
        tuple(np.sqrt(np.mean(np.square(values), axis=0)).tolist())
        for values in zip(*((one.rms, one.lines) for one in found.scores), strict=True)
    )
    notes = [*([two] if two is not None and refused is None else []), *_notes(recordings, pushed)]
    if found.own:
        zeros = OwnOffsets(found.own, found.offsets - found.offsets.mean(axis=0))
        notes.append(zeros.sentence(names[: len(recordings)], found.model.unit))
    if window is None and best.length < longest:
        notes.append(
            f"Windows of {best.length:.2g} s: over longer ones neighbouring motions part (chaos, or no balance)."
        )
    return IdentificationResult(
        found,
        best.extras,
        {name: (error, None) for name, error in best.candidates.items()},
        uncertainty,
        Explained(rms, lines, found.worst, refused, doubt, plant.coordinates.joints),
        training,
        outside,
        best.length,
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
        tuple(map(fingerprint, recordings)),
        tuple(notes),
    )


def _notes(recordings: Sequence[JointRecording], pushed: Sequence[tuple[str, float, float]]) -> list[str]:
    notes = [
        f"{r.name}: {r.left_out} rows with a NaN or a repeated stamp are left out." for r in recordings if r.left_out
    ]
    notes += [f"{r.name}: {r.renamed}." for r in recordings if r.renamed]
    passive = {joint for r in recordings for joint in r.passive_effort}
    if passive:
        notes.append(
            f"The plant has no actuator at {', '.join(sorted(passive))}, yet an effort was recorded there: the fit "
            "counts it as acting."
        )
    if pushed:
        listing = ", ".join(f"{name} from {first:.2f} to {last:.2f} s" for name, first, last in pushed)
        notes.append(f"Left out, since something that was not recorded moves the machine there: {listing}.")
    return notes


@dataclass(frozen=True)
class _Attempt:
    fit: MechanismFit
    extras: str
    candidates: dict[str, float]
    length: float


@dataclass(frozen=True)
class _Search:
    """A fit from the start, or by way of shorter windows where that ends in a poor minimum."""

    plant: PlantParameters
    recordings: Sequence[JointRecording]
    extras: str | None
    stride: int

    def best(self, length: float, *, fixed: bool) -> _Attempt:
        """Return the best fit to windows of a length [s], or to shorter ones unless it is fixed.

        Raises:
            DataError: There are too few windows, or none is explained.
        """
        start = MechanismModel.of(self.plant)
        data = self._windows(length)
        first = self._attempt(start, data, length)
        tried = [first] if isinstance(first, _Attempt) else []
        # A minimum that is not poor has values of no machine where the search began far below the delay.
        well = tried and tried[0].fit.worst <= _POOR and far_off(tried[0].fit) is None
        if DELAY in (self.extras or DELAY) and not well and (late := self._late(start, data)) is not None:
            start = late
            again = self._attempt(start, data, length)
            tried += [again] if isinstance(again, _Attempt) else []
        shortest = None
        for shorter in (length / 3.0, length / 9.0):
            if (tried and min(one.fit.worst for one in tried) <= _POOR) or shorter < _SHORTEST:
                break
            # Short windows have fewer minima: what they find is another start.
            near = self._attempt(start, self._windows(shorter), shorter)
            if not isinstance(near, _Attempt) or near.fit.worst > DOUBTFUL_SHARE:
                continue
            again = self._attempt(near.fit.model, data, length)
            tried += [again] if isinstance(again, _Attempt) else []
            shortest = None if fixed else near
        best = min(tried, key=lambda one: one.fit.worst) if tried else None
        # What long windows show, if poorly, predicts better than what short ones do.
        if shortest is not None and (best is None or best.fit.worst > LARGEST_SHARE):
            best = shortest
        if best is None:
            raise DataError(better_reading(self.plant, data) or str(first))
        return best

    def _late(self, start: MechanismModel, data: list[Windows]) -> MechanismModel | None:
        """Return the start with the delay that explains most; None where that is its own."""
        weights, costs = first_weights(data), dict[float, float]()
        models = dict[float, MechanismModel]()
        for delay in dict.fromkeys((start[DELAY], *_DELAYS)):
            models[delay] = start.with_changes({DELAY: delay})
            with suppress(DataError):
                costs[delay] = fit(models[delay], data, (), weights, most=4, tolerance=1e-2).cost
        best = min(costs, key=costs.__getitem__, default=start[DELAY])
        return None if best == start[DELAY] else models[best]

    def _windows(self, length: float) -> list[Windows]:
        data = [prepare_windows(recording, length, stride=self.stride) for recording in self.recordings]
        total = sum(len(part.time) for part in data)
        if total < _FEWEST:
            raise DataError(
                f"the recordings hold {total} windows of {length:.3g} s; expected at least {_FEWEST}: record for "
                "longer, or say a shorter --window"
            )
        return data

    def _attempt(self, start: MechanismModel, data: list[Windows], length: float) -> _Attempt | DataError:
        try:
            return _Attempt(*choose(start, data, first_weights(data), self.extras), length)
        except DataError as error:
            return error


def _without_pushes(found: MechanismFit) -> tuple[MechanismFit, list[tuple[str, float, float]]]:
    """Return the fit without the windows whose absence lets it explain the rest, and those windows."""
    total = sum(len(part.time) for part in found.data)
    share = found.worst
    if share <= DOUBTFUL_SHARE or total < 8:
        return found, []
    lines = np.sqrt(np.mean([line_errors(part) ** 2 for part in found.data], axis=0))
    now = found
    out: list[tuple[str, float, float]] = []
    while len(out) < _PUSHED * total:
        errors = [np.sqrt(np.sum((left / lines) ** 2, axis=(1, 2))) for left in now.residuals]
        piece = int(np.argmax([np.max(each) for each in errors]))
        window = int(np.argmax(errors[piece]))
        part = now.data[piece]
        if len(part.time) < 2:
            break
        since = part.recording.time[0]
        inside = part.time[window][part.inside[window]]
        out.append((part.recording.name, float(inside[0] - since), float(inside[-1] - since)))
        rest = np.delete(np.arange(len(part.time)), window)
        kept = [p.subset(rest) if i == piece else p for i, p in enumerate(now.data)]
        states = [np.delete(x, window, axis=0) if i == piece else x for i, x in enumerate(now.states)]
        now = now.again(1.0 / np.maximum(lines, 1e-9), data=kept, states=states, most=10, tolerance=1e-3)
        if now.worst <= min(DOUBTFUL_SHARE, _CLEARS * share):
            return now, sorted(out)
    return found, []


def _hold_undetermined(found: MechanismFit, weights: Array) -> tuple[MechanismFit, list[str]]:
    """Return the fit with sizes that the recordings do not determine held at the start's, and their names."""
    start, own, held = MechanismModel.of(found.model.plant), set(tellable(found.model.plant)), list[str]()
    if found.worst > DOUBTFUL_SHARE:
        return found, held
    for _ in range(len(own) - 1):
        intervals = _uncertainty(found).intervals
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
            trial = found.again(weights, model=found.model.with_changes({worst: start[worst]}), free=free)
        except DataError:
            break
        if trial.cost > 1.1 * found.cost:
            # The start's value is no answer: the recordings refuse it, though they know no better.
            break
        found = trial
        held.append(worst)
    return found, held


def _uncertainty(found: MechanismFit, held: Sequence[str] = (), alone: Sequence[Alone] = ()) -> Uncertainty:
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


def _errors(found: MechanismFit) -> Errors:
    measured = sum(part.samples for part in found.data) * np.count_nonzero(found.weights)
    fitted = sum(states.size for states in found.states) + len(found.free) + found.offsets.size
    return standard_errors(
        found.information, found.model, found.free, freedom=float(measured - fitted), serial=False, clusters=True
    )


def _freedom(found: MechanismFit) -> float:
    return float(max(sum(len(part.time) for part in found.data) - len(found.free), 3))


def _alone(found: MechanismFit, weights: Array) -> list[Alone]:
    rows = []
    names = distinct_names([part.recording for part in found.data])
    for i, (name, part) in enumerate(zip(names, found.data, strict=True)):
        if len(found.data) < 2 or len(part.time) < 2:
            continue
        try:
            offsets = found.offsets[[i]]
            one = found.again(weights, data=[part], states=[found.states[i]], offsets=offsets, tolerance=1e-7)
        except (DataError, np.linalg.LinAlgError):
            continue
        errors = _errors(one)
        # The error of few windows is itself uncertain.
        factor = float(student_quantile(0.975, _freedom(one)) / student_quantile(0.975, 1e6))
        deviation = {n: factor * error for n, error in errors.deviation.items()}
        rows.append(Alone(name, {n: one.model[n] for n in one.free}, deviation))
    return rows
