"""Why a fit of a mechanism is no model of the machine: columns, signs or angles, values far off, units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.explained import LARGEST_SHARE, REFUSED
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.mechanism_fit import MechanismFit, Windows, fit, line_errors, rms_by_joint
from pendulum_bags.identification.mechanism_model import MechanismModel, tellable
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["Score", "refusal", "unit_hint"]

_BETTER = 0.5
"""Another reading of the recording explains better where it misses less than this share of what the fit misses."""

_FAR = 10.0
"""Factor beyond which a fitted mass, length or inertia is not that of a machine near the start."""

_SPAN = 50.0
"""Travel from which on an angle is more likely in degrees: eight turns [rad]."""

_QUESTION = "is the plant's mechanism, a unit, a sign or a column another one?"

_EFFORT = 20.0
"""Efforts this many times beyond the actuator's limit are in another unit."""


@dataclass(frozen=True)
class Score:
    """How well a recording is predicted, the start of each window fitted.

    Attributes:
        rms: Of each joint, shape (n,) [rad or m].
        lines: What straight lines through the windows would leave, shape (n,).
    """

    rms: Array
    lines: Array

    @property
    def total(self) -> float:
        """Rms over all joints [rad or m]."""
        return float(np.sqrt(np.mean(self.rms**2)))

    @property
    def share(self) -> float:
        """Error over that of straight lines, of the joint where it is worst."""
        return float(np.max(self.rms / np.maximum(self.lines, 1e-12)))


@dataclass(frozen=True)
class _Reading:
    """Another reading of the columns: q' = Q q and u' = U u, in words and what to do about it."""

    words: str
    advice: str
    position: Array
    effort: Array

    def of(self, data: Windows) -> Windows:
        """Return the windows as this reading has them."""
        r, half = data.recording, len(self.position)
        states = np.concatenate(
            (data.states[:, :half] @ self.position.T, data.states[:, half:] @ self.position.T), axis=1
        )
        read = replace(r, position=r.position @ self.position.T, effort=r.effort @ self.effort.T)
        return replace(
            data,
            recording=read,
            position=data.position @ self.position.T,
            states=states,
            area=data.area @ self.effort.T,
        )


def _readings(plant: MechanismParameters) -> Iterator[_Reading]:
    """Yield what a mapping file gets wrong without a trace: order, signs, an angle against the world."""
    names, driven, count = plant.coordinates.names, plant.coordinates.driven, len(plant.joints)
    unit = np.eye(count)
    if count > 1:
        swap = unit[[1, 0, *range(2, count)]]
        words = f"the columns of {names[0]} and {names[1]} exchanged"
        advice = "expected each joint's own columns: correct the mapping file"
        yield _Reading(words, advice, swap, swap if {0, 1} <= set(driven) else unit)
    signs = "expected an effort that is positive where it pushes the joint in its positive direction: correct its sign"
    if driven:
        yield _Reading(
            "every effort negated" if len(driven) > 1 else f"the effort of {names[driven[0]]} negated",
            signs,
            unit,
            -unit,
        )
    for i in driven if len(driven) > 1 else ():
        yield _Reading(f"the effort of {names[i]} negated", signs, unit, unit - 2.0 * np.diag(unit[i]))
    joints = plant.coordinates.joints
    for i in range(1, count):
        if joints[i].turns and joints[i - 1].turns:
            relative = unit.copy()
            relative[i, i - 1] = -1.0
            words = f"the angle of {names[i]} less that of {names[i - 1]}"
            advice = f"expected the angle of {names[i]} against the link before it, this one is against the world"
            yield _Reading(words, advice, relative, unit)


def refusal(
    plant: MechanismParameters,
    found: MechanismFit,
    data: Sequence[Windows],
    training: Mapping[str, Score],
    held_out: Mapping[str, Score],
) -> str | None:
    """Return why a fit is no model of the machine, in a sentence; None where it may be one.

    Args:
        plant: The start.
        found: The fit.
        data: Its windows.
        training: Scores of the recordings of the fit, by name.
        held_out: Scores of recordings that took no part, by name.
    """
    if max(score.share for score in training.values()) > DOUBTFUL_SHARE:
        better = _better_reading(plant, found, data)
        if better is not None:
            return f"{REFUSED}: with {better.words} the motion is explained far better; {better.advice}"
    for name, score in [*training.items(), *((f"{n}, held out", s) for n, s in held_out.items())]:
        if score.share > LARGEST_SHARE:
            worst = int(np.argmax(score.rms / np.maximum(score.lines, 1e-12)))
            joint = plant.coordinates.joints[worst]
            hint = unit_hint(plant, [part.recording for part in data])
            return (
                f"{REFUSED}: {name}: the model misses {joint.name} by {score.rms[worst]:.3g} {joint.unit}, "
                f"{100.0 * score.share:.0f} % of what straight lines miss; expected less than "
                f"{100.0 * LARGEST_SHARE:.0f} %: "
                f"{hint or _QUESTION}"
            )
    return _far_off(plant, found)


def _far_off(plant: MechanismParameters, found: MechanismFit) -> str | None:
    for name in tellable(plant):
        start, value = plant.value(name), found.model[name]
        if name in found.free and start > 0.0 and value > _FAR * start:
            unit = found.model.unit(name)
            return (
                f"{REFUSED}: {name} is {value:.4g} {unit}, {value / start:.0f} times the starting plant's {start:.4g} "
                f"{unit}; expected a plant that is near, or a start that is: is a unit, a sign or a column another one?"
            )
    return None


def _better_reading(plant: MechanismParameters, found: MechanismFit, data: Sequence[Windows]) -> _Reading | None:
    """Return the reading that explains best, if far better than the fit, by quick fits to a few windows each."""
    few = [part.subset(range(0, len(part.time), max(1, len(part.time) // 6))) for part in data]
    least = _BETTER * float(np.mean([_share(e, p) for e, p in zip(found.residuals, data, strict=True)]))
    best = None
    for reading in _readings(plant):
        others = [reading.of(part) for part in few]
        weights = 1.0 / np.maximum(np.mean([line_errors(part) for part in others], axis=0), 1e-9)
        try:
            quick = fit(MechanismModel.of(plant), others, found.free, weights, most=15, tolerance=1e-3)
        except (DataError, np.linalg.LinAlgError):
            continue
        share = float(np.mean([_share(e, p) for e, p in zip(quick.residuals, others, strict=True)]))
        if share < least and _far_off(plant, quick) is None:
            least, best = share, reading
    return best


def _share(errors: Array, data: Windows) -> float:
    return Score(rms_by_joint(errors, data), line_errors(data)).share


def unit_hint(plant: MechanismParameters, recordings: Sequence[JointRecording]) -> str | None:
    """Return which column is probably in another unit, in a sentence's part; None where none stands out."""
    limits = dict(zip(plant.coordinates.driven, plant.effort_limits, strict=True))
    for recording in recordings:
        for i, joint in enumerate(plant.coordinates.joints):
            largest = float(np.max(np.abs(recording.effort[:, i])))
            if i in limits and largest > _EFFORT * limits[i]:
                milli = f"m{joint.effort_unit}"
                return (
                    f"the effort of {joint.name} reaches {largest:.3g} {joint.effort_unit}, {largest / limits[i]:.0f} "
                    f"times the actuator's limit; is it in {milli}?"
                )
            travel = float(np.ptp(recording.position[:, i]))
            if joint.turns and travel > _SPAN:
                return (
                    f"{joint.name} travels {travel:.3g} rad in {recording.name}, {travel / math.tau:.0f} turns; is it "
                    "in degrees?"
                )
    return None
