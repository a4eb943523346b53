"""Identification of a mechanism from recordings of all its joints: intervals, scores, refusals, a plant file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pendulum_bags.identification.explained import REFUSED
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_doubt import Score, refusal, unit_hint
from pendulum_bags.identification.mechanism_fit import (
    MechanismFit,
    Windows,
    fit,
    line_errors,
    prepare_windows,
    scores,
)
from pendulum_bags.identification.mechanism_model import DELAY, MechanismModel
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.wording import Interval
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, write_mechanism

__all__ = ["EXTRAS", "MechanismResult", "Score", "identify_mechanism"]

Array = NDArray[np.float64]

FORMAT = "pendulum_mechanism_identification/1"

EXTRAS: Mapping[str, Mapping[str, bool]] = {
    "friction": {},
    "friction, offsets": {"offsets": True},
    "friction, delay": {"delay": True},
    "friction, offsets, delay": {"offsets": True, "delay": True},
}
"""Candidates: what is fitted beside masses and friction."""

_WORTH = 0.98
"""A candidate with more parameters must bring the held-out error below this share of that of one with fewer."""

_WINDOW = (0.5, 5.0)
"""Shortest and longest window by default [s]. Each window's start takes up two numbers per joint: parameters from long
windows predict short ones better than those from short ones."""

_FEWEST = 5
"""Windows below which no fit is tried."""

_WIDE = 0.5
"""Half width over value from which on the recordings do not determine a parameter."""


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
        if delay is not None:
            changes.update({f"{joint}.transport_delay": delay for joint in plant.coordinates.driven_names})
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
            "intervals": {
                n: {"value": i.value, "low": i.low, "high": i.high, "standard_error": i.standard_error}
                for n, i in self.intervals.items()
            },
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
            key: (max(found.low, self.model.lowest(key)), found.high)
            for key, found in self.intervals.items()
            if key != DELAY and not key.endswith("_offset")
        }
        left_out = {
            f"{key} [{self.model.unit(key)}]": self.model[key]
            for key in self.fit.free
            if key == DELAY or key.endswith("_offset")
        }
        provenance = {
            "method": "output error, multiple shooting",
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "data": list(self.sources),
            "not_in_the_plant": left_out,
            "remarks": self.sentences(),
        }
        write_mechanism(target, plant, provenance=provenance, intervals=intervals)
        target.with_suffix(".json").write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")
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
        window: Length of the windows [s]; by default a sixth of the data, between 0.5 and 5 s.
        extras: One of ``EXTRAS``; None lets held-out windows choose.
        stride: Take every so manieth position.

    Raises:
        DataError: A recording is too short, of other joints, or one joint of it does not move.
    """
    if window is not None and not (np.isfinite(window) and window > 0.0):
        raise DataError(f"window is {window} s; expected > 0")
    seconds = sum(float(recording.time[-1] - recording.time[0]) for recording in recordings)
    length = window or float(np.clip(seconds / 6.0, *_WINDOW))
    for recording in (*recordings, *held_out):
        recording.check(plant.coordinates)
    _check_distinct(recordings, held_out)
    data = [prepare_windows(recording, length, stride=stride) for recording in recordings]
    total = sum(len(part.time) for part in data)
    if total < _FEWEST:
        raise DataError(
            f"the recordings hold {total} windows of {length} s; expected at least {_FEWEST}: record for longer, or "
            "say a shorter --window"
        )
    start = MechanismModel.of(plant)
    lines = np.sqrt(np.mean([line_errors(part) ** 2 for part in data], axis=0))
    try:
        found, chosen, candidates = _choose(start, data, 1.0 / np.maximum(lines, 1e-9), extras)
    except DataError as error:
        hint = unit_hint(plant, recordings)
        raise DataError(f"{error}: {hint}") if hint else error from None
    # Now that the errors are known, each joint counts by its own.
    rms = np.sqrt(np.mean([s**2 for s in _training(found, data)], axis=0))
    found = fit(found.model, data, found.free, 1.0 / np.maximum(rms, 1e-9), states=found.states)
    names = _names([*recordings, *held_out])
    training = {n: Score(s, line_errors(p)) for n, s, p in zip(names, _training(found, data), data, strict=False)}
    others = [prepare_windows(recording, length, stride=stride) for recording in held_out]
    outside = {
        n: Score(s, line_errors(p))
        for n, s, p in zip(names[len(data) :], scores(found.model, others), others, strict=True)
    }
    intervals = _intervals(found)
    refused = refusal(plant, found, data, training, outside)
    notes = _notes(plant, found, recordings, intervals, training)
    sources = tuple(recording.source or recording.name for recording in recordings)
    result = MechanismResult(
        found, chosen, candidates, intervals, training, outside, length, refused, tuple(notes), sources
    )
    if refused is None:
        try:
            result.plant()
        except ParameterError as error:
            return replace(result, refusal=f"{REFUSED}: {error}")
    return result


def _names(recordings: Sequence[JointRecording]) -> list[str]:
    names = [recording.name for recording in recordings]
    return [n if names.count(n) == 1 else f"{n} ({i + 1})" for i, n in enumerate(names)]


def _check_distinct(recordings: Sequence[JointRecording], held_out: Sequence[JointRecording]) -> None:
    everything = [*recordings, *held_out]
    for i, one in enumerate(everything):
        for other in everything[:i]:
            if one.position.shape == other.position.shape and np.array_equal(one.position, other.position):
                raise DataError(f"{one.name} has the same samples as {other.name}; expected each recording once")


def _training(found: MechanismFit, data: Sequence[Windows]) -> list[Array]:
    return [
        np.sqrt(np.mean(errors[part.inside] ** 2, axis=0)) for errors, part in zip(found.residuals, data, strict=True)
    ]


def _choose(
    start: MechanismModel, data: Sequence[Windows], weights: Array, extras: str | None
) -> tuple[MechanismFit, str, dict[str, float]]:
    """Return the fit that predicts what it has not seen best; each further parameter must be worth it."""
    best: tuple[float, MechanismFit, str] | None = None
    errors: dict[str, float] = {}
    model, states = start, None
    for name, wanted in EXTRAS.items():
        free = start.fitted(**wanted)
        if (extras is not None and name != extras) or free in [b[1].free for b in ([best] if best else [])]:
            continue
        found = fit(model, data, free, weights, states=states)
        if extras is not None:
            return found, name, {}
        model, states = (found.model, found.states) if best is None else (model, states)
        errors[name] = _held_out_error(found, data, weights)
        if best is None or errors[name] < _WORTH * best[0]:
            best = (errors[name], found, name)
    if best is None:
        raise DataError(f"extras is {extras!r}; expected one of {', '.join(EXTRAS)}")
    return best[1], best[2], errors


def _held_out_error(found: MechanismFit, data: Sequence[Windows], weights: Array) -> float:
    """Return the weighted rms of windows predicted by the others: recordings in turn, or thirds of a single one.

    The parameters without a fold are one Gauss-Newton step from those of all data, where their gradient is known.
    """
    index = found.model.index(found.free)
    size = np.array([found.model.size(name) for name in found.free])
    if len(data) > 1:
        folds = [
            [np.arange(len(p.time)) if i == j else np.zeros(0, dtype=int) for j, p in enumerate(data)]
            for i in range(len(data))
        ]
    else:
        folds = [[part] for part in np.array_split(np.arange(len(data[0].time)), 3)]
    cost, samples = 0.0, 0
    for fold in folds:
        matrix, gradient = np.zeros((len(index), len(index))), np.zeros(len(index))
        for blocks, out in zip(found.blocks, fold, strict=True):
            stays = np.ones(len(blocks.gradients), dtype=bool)
            stays[out] = False
            matrix += blocks.matrices[stays].sum(axis=0)
            gradient += blocks.gradients[stays].sum(axis=0)
        values = found.model.values.copy()
        values[index] -= size * (np.linalg.pinv(matrix * np.outer(size, size), rcond=1e-10) @ (size * gradient))
        values[index] = np.maximum(values[index], [found.model.lowest(name) for name in found.free])
        for part, states, out in zip(data, found.states, fold, strict=True):
            if not out.size:
                continue
            one = fit(
                found.model.with_values(values), [part.subset(out)], (), weights, states=[states[out]], most=8,
                tolerance=1e-3,
            )  # fmt: skip
            cost += one.cost
            samples += one.blocks[0].samples
    return float(np.sqrt(cost / samples))


def _intervals(found: MechanismFit) -> dict[str, Interval]:
    """Return 95 % intervals that coloured residuals and differences between recordings widen.

    The largest of three errors counts: white residuals; windows as clusters (a sandwich), since within a window the
    residuals are coloured; recordings as clusters, where there are three or more.
    """
    free = found.free
    if not free:
        return {}
    size = np.array([found.model.size(name) for name in free])
    matrix = sum((b.matrices.sum(axis=0) for b in found.blocks), np.zeros((len(free),) * 2)) * np.outer(size, size)
    inverse = np.linalg.pinv(matrix, rcond=1e-12)
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
        spread = (group.T @ group) * count / (count - 1)
        errors.append(np.diag(inverse @ spread @ inverse))
    largest = np.sqrt(np.maximum(np.max(errors, axis=0), 0.0)) * size
    white = np.sqrt(np.maximum(errors[0], 0.0)) * size
    factor = float(scipy.stats.t.ppf(0.975, max(windows - len(free), 3)))
    return {
        name: Interval(
            found.model[name], found.model[name] - factor * e, found.model[name] + factor * e, float(e), float(w)
        )
        for name, e, w in zip(free, largest, white, strict=True)
    }


def _notes(
    plant: MechanismParameters,
    found: MechanismFit,
    recordings: Sequence[JointRecording],
    intervals: Mapping[str, Interval],
    training: Mapping[str, Score],
) -> list[str]:
    model = found.model
    notes = [
        f"{r.name}: {r.left_out} rows with a NaN or a repeated stamp are left out." for r in recordings if r.left_out
    ]
    worst = max(score.share for score in training.values())
    if worst > DOUBTFUL_SHARE:
        notes.append(
            f"{INCOMPLETE}: the model misses up to {100.0 * worst:.0f} % of what straight lines miss: something acts "
            "on the machine that it has no word for."
        )
    edges = [n for n in found.free if model[n] <= model.lowest(n)]
    if edges:
        notes.append(f"At the edge of what it can be: {', '.join(edges)}; its interval is one-sided.")
    loose = [n for n in found.free if n not in edges and n != DELAY and not n.endswith("_offset")
             and intervals[n].relative > _WIDE]  # fmt: skip
    if loose:
        listing = ", ".join(f"{n} (+-{100.0 * min(intervals[n].relative, 99.0):.0f} %)" for n in loose)
        notes.append(f"The recordings do not determine {listing}.")
    notes.extend(_ridge(found))
    own = [spec.name for spec in plant.mechanism.parameters]
    held = [name for name in own if name not in found.free]
    notes.append(
        "Held at the values of the plant file, as known or since no motion tells them from the others: "
        f"{', '.join(held)}. Where one of them is wrong, the fitted ones carry its error."
    )
    if DELAY in found.free and model[DELAY] < 0.0:
        notes.append(
            f"The recorded effort comes {-1e3 * model[DELAY]:.2g} ms after its effect (a filter in its measurement?); "
            "the plant file has no such delay."
        )
    if any(name.endswith("effort_offset") for name in found.free):
        listing = ", ".join(f"{n} {model[n]:+.3g} {model.unit(n)}" for n in found.free if n.endswith("effort_offset"))
        notes.append(f"The recorded efforts have offsets, which the plant file leaves out: {listing}.")
    return notes


def _ridge(found: MechanismFit) -> list[str]:
    """Return in words the direction that the data see least, where it is far weaker than the others."""
    size = np.array([max(abs(found.model[name]), 1e-2 * found.model.size(name)) for name in found.free])
    matrix = sum((b.matrices.sum(axis=0) for b in found.blocks), np.zeros((len(size),) * 2)) * np.outer(size, size)
    values, vectors = np.linalg.eigh(matrix)
    samples = sum(b.samples for b in found.blocks)
    error = float(np.sqrt(found.cost / max(samples, 1) / max(values[0], 1e-300)))
    if error < 0.02:
        return []
    direction = vectors[:, 0] / np.max(np.abs(vectors[:, 0]))
    big = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.25]
    if len(big) < 2:
        return []
    told = ", ".join(f"{found.free[i]} by {100.0 * direction[i] * np.sign(direction[big[0]]):+.0f} %" for i in big)
    return [f"The motion hardly changes when these change together: {told}."]
