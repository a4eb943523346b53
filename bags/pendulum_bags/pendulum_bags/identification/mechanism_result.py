"""Identification of a mechanism from recordings of all its joints: intervals, scores, refusals, a plant file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.explained import LARGEST_SHARE, REFUSED
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_choice import ALL_EXTRAS, choose
from pendulum_bags.identification.mechanism_doubt import Score, better_reading, noise_of, refusal
from pendulum_bags.identification.mechanism_fit import (
    MOST,
    MechanismFit,
    Prior,
    Windows,
    error_weights,
    first_weights,
    fit,
    line_errors,
    prepare_windows,
    scores,
    window_length,
)
from pendulum_bags.identification.mechanism_model import DELAY, LAG, MechanismModel, tellable
from pendulum_bags.identification.mechanism_notes import notes_of
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.wording import Interval
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.determined import SPAN, undetermined
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, write_mechanism

__all__ = ["MechanismResult", "Score", "identify_mechanism"]

FORMAT = "pendulum_mechanism_identification/1"

_WINDOW = (0.5, 5.0)
"""Shortest and longest window by default [s], where neighbouring motions stay together. Each window's start takes up
two numbers per joint: parameters from long windows predict short ones better than those from short ones."""

_SHORTEST, _SHORTEST_BY_VELOCITY = 0.2, 0.1
"""Shortest window by default, however fast neighbouring motions part, and where velocities were measured [s]."""

_FAST = 0.005
"""Longest sampling period from which a lag of the actuators can be told from a delay [s]."""

_POOR = 0.25
"""Share of what straight lines miss from which on a fit is tried again by way of shorter windows."""

_CLEARS = 0.2
"""Share of the error that is left at most where a few windows, in which something pushed, made it."""

_PUSHED = 0.25
"""Share of the windows that may be left out as pushed."""

_FEWEST = 5
"""Windows below which no fit is tried."""


@dataclass(frozen=True)
class MechanismResult:
    """Fit, intervals and scores.

    Attributes:
        fit: The chosen fit.
        extras: Which of ``EXTRAS`` it is.
        candidates: Held-out error of each candidate, in shares of the motion.
        intervals: By name.
        training: Scores of the recordings of the fit, by name.
        held_out: Scores of recordings that took no part, by name.
        window: Length of the windows of the fit [s].
        refusal: Sentence that this is no model of the motion; None where it is one.
        notes: What there is to say, most important first.
        sources: Files of the fit.
    """

    fit: MechanismFit
    extras: str
    candidates: Mapping[str, float]
    intervals: Mapping[str, Interval]
    training: Mapping[str, Score]
    held_out: Mapping[str, Score]
    window: float
    refusal: str | None
    notes: tuple[str, ...]
    sources: tuple[str, ...]

    @property
    def refused(self) -> bool:
        """Whether the fit is written to no plant file."""
        return self.refusal is not None

    @property
    def model(self) -> MechanismModel:
        """The fitted model."""
        return self.fit.model

    @property
    def verdict(self) -> str:
        """Whether the fit is a model of the machine, in one sentence."""
        if self.refusal is not None:
            return self.refusal
        worst = max(score.share for score in self.training.values())
        errors = ", ".join(
            f"{joint.name} {1e3 * np.sqrt(np.mean([s.rms[i] ** 2 for s in self.training.values()])):.3g} m{joint.unit}"
            for i, joint in enumerate(self.model.plant.coordinates.joints)
        )
        return f"Fits {100.0 * (1.0 - worst):.3g} % of the motion or more, joint by joint: it misses {errors} rms."

    def sentences(self) -> list[str]:
        """Return what there is to say, most important first."""
        return [*([self.refusal] if self.refusal else []), *self.notes]

    def plant(self, name: str = "identified") -> MechanismParameters:
        """Return the plant that the simulator reads.

        Raises:
            ParameterError: No body has the masses and inertias that were found.
        """
        start, model = self.model.plant, self.model
        known = {spec.name for spec in start.mechanism.parameters}
        changes = {n: model[n] for n in self.fit.free if n in known or n.endswith((".damping", ".coulomb_friction"))}
        delay = max(model[DELAY], 0.0) if DELAY in self.fit.free else None
        joints = tuple(replace(joint, static_friction=None) for joint in start.joints)
        plant = replace(start, joints=joints, name=name)
        for joint in plant.coordinates.driven_names:
            if delay is not None:
                changes[f"{joint}.transport_delay"] = delay
            if LAG in self.fit.free:
                changes[f"{joint}.{LAG}"] = model[LAG]
        return plant.with_values(changes)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON values."""
        model = self.model

        def table(found: Mapping[str, Score]) -> dict[str, Any]:
            joints = model.plant.coordinates.names
            return {
                name: {
                    "window_rms": score.total,
                    "joints": dict(zip(joints, map(float, score.rms), strict=True)),
                    "straight_lines": dict(zip(joints, map(float, score.lines), strict=True)),
                }
                for name, score in found.items()
            }

        return {
            "format": FORMAT,
            "method": "output error, multiple shooting",
            "mechanism": model.plant.mechanism.name,
            "window": self.window,
            "fitted": list(self.fit.free),
            "parameters": {name: model[name] for name in model.names},
            "units": {name: model.unit(name) for name in model.names},
            "intervals": {name: found.to_json() for name, found in self.intervals.items()},
            "extras": self.extras,
            "candidates": dict(self.candidates),
            "training": table(self.training),
            "held_out": table(self.held_out),
            "refused": self.refused,
            "sentences": self.sentences(),
            "data": list(self.sources),
        }

    def write(self, path: str | Path, *, name: str = "identified") -> Path:
        """Write the plant file with intervals and provenance, and everything else as JSON beside it.

        Raises:
            DataError: The fit is refused, or the name does not end in .yaml.
            ParameterError: No body has these masses and inertias.
        """
        target = Path(path)
        if self.refusal is not None:
            raise DataError(f"{self.refusal} No plant file is written.")
        if target.suffix not in {".yaml", ".yml"}:
            raise DataError(f"plant file is {target.name!r}; expected a name that ends in .yaml")
        plant = self.plant(name)
        intervals = {
            key: (found.low, found.high)
            for key, found in self.intervals.items()
            if key not in {DELAY, LAG} and not key.endswith("_offset") and found.low < found.high
        }
        left_out = {
            f"{key} [{self.model.unit(key)}]": self.model[key]
            for key in self.fit.free
            if key in {DELAY, LAG} or key.endswith("_offset")
        }
        provenance = {
            "method": "output error, multiple shooting",
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "data": list(self.sources),
            "not_in_the_plant": left_out,
            "remarks": self.sentences(),
        }
        write_mechanism(target, plant, provenance=provenance, intervals=intervals)
        write_json(target.with_suffix(".json"), self.to_dict())
        return target


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_mechanism(
    plant: MechanismParameters,
    recordings: Sequence[JointRecording],
    *,
    held_out: Sequence[JointRecording] = (),
    window: float | None = None,
    extras: str | None = None,
    stride: int = 1,
) -> MechanismResult:
    """Identify a mechanism by output error and judge the result.

    Args:
        plant: Start, and what is held: lengths, gears, gravity, masses that the motion cannot tell.
        recordings: Data to fit, all of one machine.
        held_out: Recordings to score only.
        window: Length of the windows [s]; by default a sixth of the data, between 0.5 and 5 s, or what
            neighbouring motions stay together for.
        extras: One of ``EXTRAS``; None lets held-out windows choose.
        stride: Take every so manieth position.

    Raises:
        DataError: A recording is too short, of other joints, or one joint of it does not move.
    """
    if window is not None and not (np.isfinite(window) and window > 0.0):
        raise DataError(f"window is {window} s; expected > 0")
    for recording in (*recordings, *held_out):
        recording.check(plant.coordinates)
    _check_distinct(recordings, held_out)
    start = MechanismModel.of(plant)
    seconds = sum(float(recording.time[-1] - recording.time[0]) for recording in recordings)
    longest = window or float(np.clip(seconds / 6.0, *_WINDOW))
    measured = all(recording.velocity is not None for recording in recordings)
    shortest = _SHORTEST_BY_VELOCITY if measured else _SHORTEST
    length = window or max(window_length(start, recordings, longest), shortest)
    if extras is None and measured and all(np.median(np.diff(r.time)) * stride <= _FAST for r in recordings):
        # Measured to their velocity, the recordings show these: left out, they would bias what is left.
        extras = ALL_EXTRAS
    search = _Search(plant, recordings, extras, stride)
    found, chosen, candidates, data, length = search.best(length, fixed=window is not None)
    found, data, pushed = _without_pushes(found, data)
    # Now that the errors are known, each measurement counts by its own; of a fit to be refused none does.
    weights = error_weights(found, data)
    for _ in range(0 if _worst(found, data) > LARGEST_SHARE else 2 if measured else 1):
        weights = error_weights(found, data)
        found = fit(found.model, data, found.free, weights, states=found.states)
    found, held = _hold_undetermined(start, found, data, weights)
    names = _names([*recordings, *held_out])
    training = {name: Score.of(left, part) for name, left, part in zip(names, found.residuals, data, strict=False)}
    others = [prepare_windows(recording, length, stride=stride) for recording in held_out]
    outside = {
        n: Score(s, line_errors(p), noise_of(p.recording.position))
        for n, s, p in zip(names[len(data) :], scores(found.model, others, weights), others, strict=True)
    }
    intervals = _intervals(found)
    refused = refusal(plant, found, data, training, outside)
    if refused is None and not found.converged:
        refused = f"{REFUSED}: the search had not ended after {MOST} steps; expected a start nearer to the machine"
    notes = notes_of(plant, found, recordings, intervals, training, held=held, pushed=pushed)
    if window is None and length < longest:
        notes.append(f"Windows of {length:.2g} s: over longer ones neighbouring motions part (chaos, or no balance).")
    sources = tuple(recording.source or recording.name for recording in recordings)
    result = MechanismResult(
        found, chosen, candidates, intervals, training, outside, length, refused, tuple(notes), sources
    )
    if refused is None:
        try:
            lost = undetermined(result.plant(), {n: (found.low, found.high) for n, found in intervals.items()})
        except ParameterError as error:
            return replace(result, refusal=f"{REFUSED}: {error}")
        if lost:
            listing = ", ".join(f"{name} ({intervals[name].text} {found.model.unit(name)})" for name in lost)
            return replace(result, refusal=f"{REFUSED}: the recordings do not determine {listing}")
    return result


@dataclass(frozen=True)
class _Search:
    """A fit from the start, or by way of shorter windows where that ends in a poor minimum."""

    plant: MechanismParameters
    recordings: Sequence[JointRecording]
    extras: str | None
    stride: int

    def best(self, length: float, *, fixed: bool) -> tuple[MechanismFit, str, dict[str, float], list[Windows], float]:
        """Return the fit, its extras, the candidates, the windows and their length [s].

        Args:
            length: Length of the windows [s].
            fixed: Whether it was asked for, and no shorter one is an answer.

        Raises:
            DataError: There are too few windows, or none is explained.
        """
        start = MechanismModel.of(self.plant)
        data = self._windows(length)
        tried: list[tuple[float, MechanismFit, str, dict[str, float], list[Windows], float]] = []
        error = self._attempt(start, data, length, tried)
        shortest = None
        for shorter in (length / 3.0, length / 9.0):
            if (tried and min(one[0] for one in tried) <= _POOR) or shorter < _SHORTEST:
                break
            # Short windows have fewer minima: what they find is another start.
            near: list[tuple[float, MechanismFit, str, dict[str, float], list[Windows], float]] = []
            self._attempt(start, self._windows(shorter), shorter, near)
            if not near or near[0][0] > DOUBTFUL_SHARE:
                continue
            self._attempt(near[0][1].model, data, length, tried)
            shortest = None if fixed else near[0]
        best = min(tried, key=lambda one: one[0]) if tried else None
        # What long windows show, if poorly, predicts better than what short ones do.
        if shortest is not None and (best is None or best[0] > LARGEST_SHARE):
            best = shortest
        if best is None:
            better = better_reading(self.plant, data)
            raise DataError(better or str(error))
        return best[1:]

    def _windows(self, length: float) -> list[Windows]:
        data = [prepare_windows(recording, length, stride=self.stride) for recording in self.recordings]
        total = sum(len(part.time) for part in data)
        if total < _FEWEST:
            raise DataError(
                f"the recordings hold {total} windows of {length:.3g} s; expected at least {_FEWEST}: record for "
                "longer, or say a shorter --window"
            )
        return data

    def _attempt(
        self,
        start: MechanismModel,
        data: list[Windows],
        length: float,
        tried: list[tuple[float, MechanismFit, str, dict[str, float], list[Windows], float]],
    ) -> DataError | None:
        try:
            found, chosen, candidates = choose(start, data, first_weights(data), self.extras)
        except DataError as error:
            return error
        tried.append((_worst(found, data), found, chosen, candidates, data, length))
        return None


def _worst(found: MechanismFit, data: Sequence[Windows]) -> float:
    """Return what a fit misses over what straight lines miss, of the joint and recording where it is worst."""
    return max(Score.of(left, part).share for left, part in zip(found.residuals, data, strict=True))


def _without_pushes(
    found: MechanismFit, data: list[Windows]
) -> tuple[MechanismFit, list[Windows], list[tuple[str, float, float]]]:
    """Return the fit, its windows, and those left out since something else moves the machine there.

    Left out is what makes the difference: without a few windows the fit has to explain the rest.
    """
    total = sum(len(part.time) for part in data)
    share = _worst(found, data)
    if share <= DOUBTFUL_SHARE or total < 8:
        return found, data, []
    lines = np.sqrt(np.mean([line_errors(part) ** 2 for part in data], axis=0))
    now, kept = found, data
    out: list[tuple[str, float, float]] = []
    while len(out) < _PUSHED * total:
        errors = [np.sqrt(np.sum((left / lines) ** 2, axis=(1, 2))) for left in now.residuals]
        piece = int(np.argmax([np.max(each) for each in errors]))
        window = int(np.argmax(errors[piece]))
        part = kept[piece]
        if len(part.time) < 2:
            break
        since = part.recording.time[0]
        inside = part.time[window][part.inside[window]]
        out.append((part.recording.name, float(inside[0] - since), float(inside[-1] - since)))
        rest = np.delete(np.arange(len(part.time)), window)
        kept = [p.subset(rest) if i == piece else p for i, p in enumerate(kept)]
        states = [np.delete(x, window, axis=0) if i == piece else x for i, x in enumerate(now.states)]
        now = fit(now.model, kept, now.free, 1.0 / np.maximum(lines, 1e-9), states=states, most=10, tolerance=1e-3)
        if _worst(now, kept) <= min(DOUBTFUL_SHARE, _CLEARS * share):
            return now, kept, sorted(out)
    return found, data, []


def _hold_undetermined(
    start: MechanismModel, found: MechanismFit, data: Sequence[Windows], weights: Array
) -> tuple[MechanismFit, list[str]]:
    """Return the fit with sizes that the recordings do not determine held at the start's, and their names."""
    own, held = set(tellable(start.plant)), list[str]()
    if _worst(found, data) > DOUBTFUL_SHARE:
        return found, held
    for _ in range(len(own) - 1):
        intervals = _intervals(found)
        open_ended = {
            n: found.relative
            for n, found in intervals.items()
            if n in own and (found.low <= 0.0 or found.high > SPAN * found.low)
        }
        if not open_ended:
            break
        worst = max(open_ended, key=lambda name: open_ended[name])
        values = found.model.values.copy()
        values[found.model.index([worst])] = start[worst]
        free = tuple(name for name in found.free if name != worst)
        try:
            trial = fit(found.model.with_values(values), data, free, weights, states=found.states)
        except DataError:
            break
        if trial.cost > 1.1 * found.cost:
            # The start's value is no answer: the recordings refuse it, though they know no better.
            break
        found = trial
        held.append(worst)
    return found, held


def _names(recordings: Sequence[JointRecording]) -> list[str]:
    names = [recording.name for recording in recordings]
    return [n if names.count(n) == 1 else f"{n} ({i + 1})" for i, n in enumerate(names)]


def _check_distinct(recordings: Sequence[JointRecording], held_out: Sequence[JointRecording]) -> None:
    everything = [*recordings, *held_out]
    for i, one in enumerate(everything):
        for other in everything[:i]:
            if one.position.shape == other.position.shape and np.array_equal(one.position, other.position):
                raise DataError(f"{one.name} has the same samples as {other.name}; expected each recording once")


def _intervals(found: MechanismFit) -> dict[str, Interval]:
    """Return 95 % intervals that coloured residuals and differences between recordings widen, cut at the domain's edge.

    The largest of three errors counts: white residuals; windows as clusters (a sandwich), since within a window the
    residuals are coloured; recordings as clusters, where there are three or more.
    """
    free = found.free
    if not free:
        return {}
    matrix = np.diag(Prior.of(found.model, free).weights) + sum(b.matrices.sum(axis=0) for b in found.blocks)
    # Each in its own error, were the others known: what the data hardly see is no rounding of what they see well.
    size = np.array([found.model.size(name) for name in free])
    own = np.diag(matrix)
    size = np.where(own > 0.0, 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0)), size)
    prior = np.diag(Prior.of(found.model, free).weights * size**2)
    matrix = matrix * np.outer(size, size)
    level, axes = np.linalg.eigh(matrix)
    # A direction that the data do not see has a wide interval, not none.
    inverse = (axes / np.maximum(level, 1e-12 * max(float(level[-1]), 1e-300))) @ axes.T
    scores_by_window = np.concatenate([b.gradients for b in found.blocks]) * size
    samples = sum(b.samples for b in found.blocks)
    windows = len(scores_by_window)
    states = found.states[0].shape[1]
    variance = found.cost / max(samples - states * windows - len(free), 1)
    errors = [variance * np.diag(inverse)]
    groups = [scores_by_window]
    if len(found.blocks) >= 3:
        groups.append(np.array([b.gradients.sum(axis=0) for b in found.blocks]) * size)
    for group in groups:
        count = len(group)
        spread = (group.T @ group) * count / (count - 1) + prior
        errors.append(np.diag(inverse @ spread @ inverse))
    largest = np.sqrt(np.maximum(np.max(errors, axis=0), 0.0)) * size
    white = np.sqrt(np.maximum(errors[0], 0.0)) * size
    factor = float(student_quantile(0.975, max(windows - len(free), 3)))
    return {
        name: Interval(
            found.model[name],
            max(found.model[name] - factor * e, found.model.lowest(name)),
            found.model[name] + factor * e,
            float(e),
            float(w),
        )
        for name, e, w in zip(free, largest, white, strict=True)
    }
