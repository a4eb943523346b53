"""Identification of a mechanism from recordings of all its joints: intervals, scores, refusals, a plant file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.explained import REFUSED
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_choice import choose
from pendulum_bags.identification.mechanism_doubt import Score, refusal, unit_hint
from pendulum_bags.identification.mechanism_fit import (
    MechanismFit,
    fit,
    line_errors,
    prepare_windows,
    rms_by_joint,
    scores,
)
from pendulum_bags.identification.mechanism_model import DELAY, MechanismModel
from pendulum_bags.identification.mechanism_notes import notes_of
from pendulum_bags.identification.wording import Interval
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, write_mechanism

__all__ = ["MechanismResult", "Score", "identify_mechanism"]

FORMAT = "pendulum_mechanism_identification/1"

_WINDOW = (0.5, 5.0)
"""Shortest and longest window by default [s]. Each window's start takes up two numbers per joint: parameters from long
windows predict short ones better than those from short ones."""

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
        found, chosen, candidates = choose(start, data, 1.0 / np.maximum(lines, 1e-9), extras)
    except DataError as error:
        hint = unit_hint(plant, recordings)
        raise DataError(f"{error}: {hint}") if hint else error from None
    # Now that the errors are known, each joint counts by its own.
    errors = [rms_by_joint(left, part) for left, part in zip(found.residuals, data, strict=True)]
    rms = np.sqrt(np.mean([each**2 for each in errors], axis=0))
    found = fit(found.model, data, found.free, 1.0 / np.maximum(rms, 1e-9), states=found.states)
    names = _names([*recordings, *held_out])
    training = {
        name: Score(rms_by_joint(left, part), line_errors(part))
        for name, left, part in zip(names, found.residuals, data, strict=False)
    }
    others = [prepare_windows(recording, length, stride=stride) for recording in held_out]
    outside = {
        n: Score(s, line_errors(p))
        for n, s, p in zip(names[len(data) :], scores(found.model, others), others, strict=True)
    }
    intervals = _intervals(found)
    refused = refusal(plant, found, data, training, outside)
    notes = notes_of(plant, found, recordings, intervals, training)
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
    factor = float(student_quantile(0.975, max(windows - len(free), 3)))
    return {
        name: Interval(
            found.model[name], found.model[name] - factor * e, found.model[name] + factor * e, float(e), float(w)
        )
        for name, e, w in zip(free, largest, white, strict=True)
    }
