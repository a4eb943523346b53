"""Why a fit of a mechanism is no model of the machine: columns, signs or angles, values far off, units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.explained import LARGEST_SHARE, REFUSED, Explained
from pendulum_bags.identification.joint_fit import MOST, JointFit, Score, Windows, first_weights, fit, noise_of
from pendulum_bags.identification.joint_model import JointModel
from pendulum_bags.identification.motion_model import DELAY, MotionModel
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.determined import undetermined

__all__ = ["better_reading", "explained_joints", "far_off", "refusal", "undetermined_joints"]

_BETTER = 0.5
"""Another reading of the recording explains better where it misses less than this share of what the fit misses."""

_FAR = 10.0
"""Factor beyond which a fitted mass, length or inertia is not that of a machine near the start."""

_NUMBERS_OF_DEGREES = 4.0
"""Travel from which on an angle may be in degrees [rad]: made small enough, any swing is linear."""

_LATE = 0.02
"""Delay beyond the start's up to which other readings are fitted [s]."""

_QUICK = 6
"""Windows of each recording that another reading is fitted to."""


@dataclass(frozen=True)
class _Reading:
    """Another reading of the columns: q' = Q q + s and u' = U u, in words and what to do about it."""

    words: str
    advice: str
    position: Array
    effort: Array
    shift: Array

    def of(self, data: Windows) -> Windows:
        """Return the windows as this reading has them."""
        r, half = data.recording, len(self.position)
        states = np.concatenate(
            (data.states[:, :half] @ self.position.T + self.shift, data.states[:, half:] @ self.position.T), axis=1
        )
        read = replace(r, position=r.position @ self.position.T + self.shift, effort=r.effort @ self.effort.T)
        return replace(
            data,
            recording=read,
            position=data.position @ self.position.T + self.shift,
            velocity=None if data.velocity is None else data.velocity @ self.position.T,
            states=states,
            area=data.area @ self.effort.T,
        )


def _readings(coordinates: Coordinates, data: Sequence[Windows]) -> Iterator[_Reading]:
    """Yield what a mapping file gets wrong without a trace: order, signs, units, zeros, an angle against the world."""
    names, driven, joints = coordinates.names, coordinates.driven, coordinates.joints
    count = len(joints)
    unit, zero = np.eye(count), np.zeros(count)
    if count > 1:
        swap = unit[[1, 0, *range(2, count)]]
        words = f"the columns of {names[0]} and {names[1]} exchanged"
        advice = "expected each joint's own columns: correct the mapping file"
        yield _Reading(words, advice, swap, swap if {0, 1} <= set(driven) else unit, zero)
    signs = "expected an effort that is positive where it pushes the joint in its positive direction: correct its sign"
    if driven:
        every = "every effort" if len(driven) > 1 else f"the effort of {names[driven[0]]}"
        yield _Reading(f"{every} negated", signs, unit, -unit, zero)
        milli = f"expected {coordinates.drive_unit}: correct its unit in the mapping file"
        yield _Reading(f"{every} in m{coordinates.drive_unit}", milli, unit, 1e-3 * unit, zero)
    for i in driven if len(driven) > 1 else ():
        yield _Reading(f"the effort of {names[i]} negated", signs, unit, unit - 2.0 * np.diag(unit[i]), zero)
    for i in range(1, count):
        if joints[i].turns and joints[i - 1].turns:
            relative = unit.copy()
            relative[i, i - 1] = -1.0
            words = f"the angle of {names[i]} less that of {names[i - 1]}"
            advice = f"expected the angle of {names[i]} against the link before it, this one is against the world"
            yield _Reading(words, advice, relative, unit, zero)
    turning = [i for i in range(count) if joints[i].turns]
    degrees = "expected rad: say `unit: deg` in the mapping file"
    wide = [i for i in turning if max(np.ptp(p.recording.position[:, i]) for p in data) > _NUMBERS_OF_DEGREES]
    for some in dict.fromkeys([tuple(wide), *((i,) for i in wide)]):
        scale = unit.copy()
        scale[some, some] = math.pi / 180.0
        words = " and ".join(names[i] for i in some)
        if some:
            yield _Reading(f"{words} in degrees", degrees, scale, unit, zero)
    for i in turning:
        words = f"the angle of {names[i]} measured from the opposite direction"
        advice = "expected the zero of the mechanism: add half a turn as `offset` in the mapping file"
        yield _Reading(words, advice, unit, unit, math.pi * unit[i])


def refusal(found: JointFit, training: Mapping[str, Score], held_out: Mapping[str, Score]) -> str | None:
    """Return why a fit is no model of the machine, by its scores, in a sentence; None where it may be one."""
    data = found.data
    far = far_off(found)
    if far is not None or max(score.share for score in training.values()) > DOUBTFUL_SHARE:
        better = better_reading(found.model.start, data, found)
        if better is not None:
            return f"{REFUSED}: {better}"
    noise = 6.0 * np.max([noise_of(part.recording.position) for part in data], axis=0)
    # What the fit misses in its own data is no fault of a recording in which a joint hardly moves.
    usual = np.sqrt(np.mean([score.rms**2 for score in training.values()], axis=0))
    for name, score, least in (
        *((n, s, noise) for n, s in training.items()),
        *((f"{n}, held out", s, np.maximum(noise, 4.0 * usual)) for n, s in held_out.items()),
    ):
        shares = score.shares(least)
        worst = int(np.argmax(shares))
        if shares[worst] > LARGEST_SHARE:
            joint = found.model.coordinates.joints[worst]
            return (
                f"{REFUSED}: {name}: the model misses {joint.name} by {score.rms[worst]:.3g} {joint.unit}, "
                f"{100.0 * shares[worst]:.0f} % of what straight lines miss; expected less than "
                f"{100.0 * LARGEST_SHARE:.0f} %. No other order, sign, unit or zero of the columns explains it better: "
                "something that was not recorded moves the machine, or it is another one"
            )
    if far is None and not found.converged:
        return f"{REFUSED}: the search had not ended after {MOST} steps; expected a start nearer to the machine"
    return far


def explained_joints(found: JointFit, refused: str | None) -> Explained:
    """Return how much of the motion a fit explains."""
    incomplete = None
    if refused is None and found.worst > DOUBTFUL_SHARE:
        incomplete = (
            f"{INCOMPLETE}: the model misses up to {100.0 * found.worst:.0f} % of what straight lines miss: something "
            "acts on the machine that is not in it."
        )
    rms, lines = (
        tuple(np.sqrt(np.mean(np.square(values), axis=0)).tolist())
        for values in zip(*((one.rms, one.lines) for one in found.scores), strict=True)
    )
    return Explained(rms, lines, found.worst, refused, incomplete, found.model.coordinates.joints)


def undetermined_joints(found: JointFit, uncertainty: Uncertainty) -> str | None:
    """Return the sentence that the recordings do not determine what a plant file needs; None where they do."""
    intervals, model = uncertainty.intervals, found.model
    assert isinstance(model, JointModel)
    try:
        identified = model.identified(found.free, model.plant.name)
    except ParameterError as error:
        return f"{REFUSED}: {error}"
    ends = {name: (one.low, one.high) for name, one in intervals.items()}
    lost = [f"{name} ({intervals[name].text} {model.unit(name)})" for name in undetermined(identified, ends)]
    return f"{REFUSED}: the recordings do not determine {', '.join(lost)}" if lost else None


def far_off(found: JointFit) -> str | None:
    """Return the first fitted size that is not that of a machine near the start, in a sentence; None without one."""
    model, begin = found.model, found.model.start
    for name in model.near:
        start, value = begin[name], model[name]
        if name in found.free and start > 0.0 and not start / _FAR < value < start * _FAR:
            unit = model.unit(name)
            times = f"{value / start:.0f}" if value > start else f"{value / start:.2g}"
            return (
                f"{REFUSED}: {name} is {value:.4g} {unit}, {times} times the starting plant's {start:.4g} {unit}; "
                "expected a plant that is near, or a start that is"
            )
    return None


def better_reading(start: MotionModel, data: Sequence[Windows], found: JointFit | None = None) -> str | None:
    """Return how the columns are to be read, with what mends it, where that alone explains the motion; else None.

    Each reading is fitted to a few short windows, and so is the given one: a fit that ended in a poor minimum is no
    fault of the columns. What is named has then explained all of the data.
    """
    own = math.inf
    if found is not None:
        own = _share(found)
    few = [part.subset(range(0, len(part.time), max(1, len(part.time) // _QUICK))) for part in data]
    unit = np.eye(len(start.coordinates.joints))
    given = _Reading("", "", unit, unit, np.zeros(len(unit)))
    least, best = math.inf, None
    for reading in (given, *_readings(start.coordinates, data)):
        share = _fits(start, reading, few)
        # Another reading has to be far better than the given one.
        if share < (least if best is not None or reading is given else _BETTER * least):
            least, best = share, reading
    if best is None or best is given:
        return None
    whole = _fits(start, best, data)
    if whole > DOUBTFUL_SHARE or whole > _BETTER * own:
        return None
    instead = f" instead of {100.0 * own:.2g} %" if math.isfinite(own) else ""
    return (
        f"with {best.words} the motion is explained far better (a fit misses {100.0 * whole:.2g} %{instead}); "
        f"{best.advice}"
    )


def _fits(model: MotionModel, reading: _Reading, data: Sequence[Windows]) -> float:
    """Return the share that a quick fit under a reading misses, inf where it ends far from the start.

    The delay of a loop of 500 Hz, 5 ms, hides the sign of an effort that balances a machine: it is fitted, too.
    """
    others = [reading.of(part) for part in data]
    weights = first_weights(others)
    free, shares = model.fitted(), [math.inf]
    with suppress(DataError, np.linalg.LinAlgError):
        shares.append(_share(fit(model, others, free, weights, most=15, tolerance=1e-3)))
        late = fit(model, others, (DELAY,), weights, most=8, tolerance=1e-3)
        # Half a period late, a sine is its negative.
        for found in (late, fit(late.model, others, (*free, DELAY), weights, most=15, tolerance=1e-3)):
            shares += [_share(found)] * (abs(found.model[DELAY] - model[DELAY]) < _LATE)
    return min(shares)


def _share(found: JointFit) -> float:
    return math.inf if far_off(found) is not None else float(np.mean([score.share for score in found.scores]))
