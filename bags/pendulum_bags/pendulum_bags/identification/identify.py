"""Identification from recordings to the judged result, of one joint or several."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from pendulum_bags.identification.between_recordings import Alone, excluding
from pendulum_bags.identification.covariance import FREQUENCY, candidate_errors
from pendulum_bags.identification.explained import REFUSED, Explained, explained, undetermined_fit
from pendulum_bags.identification.geometry import check_geometry
from pendulum_bags.identification.joint_fit import JointFit, prepare_windows
from pendulum_bags.identification.joint_fit import scores as joint_scores
from pendulum_bags.identification.joint_model import JointModel
from pendulum_bags.identification.joint_readings import explained_joints, refusal, undetermined_joints
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.joint_search import search
from pendulum_bags.identification.joint_uncertainty import assess_joints, each_alone, hold_undetermined
from pendulum_bags.identification.motion_model import DELAY, MotionModel
from pendulum_bags.identification.options import DEFAULTS, Options
from pendulum_bags.identification.output_error import OutputErrorFit, fit_output_error
from pendulum_bags.identification.own_offsets import OwnOffsets
from pendulum_bags.identification.problem import prepare
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import residual_tests
from pendulum_bags.identification.result import (
    IdentificationResult,
    PendulumResult,
    check_distinct,
    data_sentences,
    fingerprint,
    held_sentence,
    looks_held,
)
from pendulum_bags.identification.solver import solve
from pendulum_bags.identification.uncertainty import Uncertainty, assess
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.runs.datasets import Recording, distinct_names
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["RATIOS", "identify", "identify_joints", "identify_motions"]

R = TypeVar("R", bound=IdentificationResult)

_ONE_MACHINE = {FREQUENCY: 1.1, "inertia": 1.35, "gravity": 1.35}
"""Ratios up to which what differs from recording to recording may be one machine's: what the model lacks moves them."""


RATIOS = (
    "Volts show only ratios of masses, friction and motor: the motor's gain in the plant file fixes their scale, and "
    "with another all would be larger or smaller alike."
)
"""Said of recordings in volts before and after the fit, and in the plant file."""

_ONE_SIZE = 1.1
"""The same for a size of several joints, which share no scale."""


# BLAS splits long sums by the cores that it finds, and a fit magnifies the last digits: on one core, a recording has
# the same result on every worker.
@threadpool_limits.wrap(limits=1, user_api="blas")
def identify(
    recordings: Sequence[Recording],
    options: Options = DEFAULTS,
    *,
    held_out: Sequence[Recording] = (),
    profiles: int = 2,
) -> PendulumResult:
    """Identify a pendulum by output error and judge the result.

    The recordings are of one pendulum with one kind of input, those held out are scored only, and ``profiles`` weak
    parameters get profile intervals.
    """
    check_distinct(recordings, held_out)
    if recordings and all(r.input_kind == "effort" and not np.any(r.input) for r in recordings):
        # A column of zeros is no drive: a gain or a delay of it could be anything.
        recordings = [replace(r, input_kind="none", meta={**r.meta, "no_torque": True}) for r in recordings]
        held_out = [replace(r, input_kind="none") if not np.any(r.input) else r for r in held_out]
    levels = {(r.input_kind, float(r.input[0])) if np.ptp(r.input) == 0.0 else None for r in recordings}
    if len(levels) == 1 and (one := levels.pop()) is not None and one[0] == "effort":
        raise DataError(
            f"{recordings[0].name}: the torque is {one[1]:.4g} N m throughout, which no fit can tell from a zero error "
            "of the torque; expected a torque that varies"
        )
    fit = fit_output_error(recordings, options)
    tests = residual_tests(fit)
    account = explained(fit, tests.outliers)
    explains = account.share <= DOUBTFUL_SHARE
    alone = _alone(fit)
    profiles = 0 if account.refusal is not None else profiles
    uncertainty = assess(fit, tests, profiles=profiles, explains=explains, alone=alone)
    if account.refusal is None and (lost := undetermined_fit(fit, uncertainty)) is not None:
        account = replace(account, refusal=lost)
    account, two = _one_machine(account, excluding(alone, _ONE_MACHINE, fit.model.unit))
    geometry = check_geometry(fit.model, uncertainty, options.geometry)
    scores = {}
    for name, recording in zip(distinct_names(held_out), held_out, strict=True):
        if recording.input_kind == "position_goal":
            scores[name] = free_run(fit.model, recording, fitted=False)
        else:
            scores[name] = window_score(fit.model, recording, fit.window)
    moved = {
        name: found
        for name, recording in zip(scores, held_out, strict=True)
        if (found := _moved_zero(fit, recording, scores[name].rms)) is not None
    }
    delay = uncertainty.intervals.get("transport_delay")
    return PendulumResult(
        fit,
        fit.chosen.label,
        {c.label: (c.validation.rms if c.validation else None, c.training_rms) for c in fit.candidates},
        uncertainty,
        account,
        {},
        scores,
        fit.window,
        _now(),
        tuple(map(fingerprint, fit.recordings)),
        (
            *data_sentences(fit, delay, refused=account.refusal is not None),
            *_tried(fit.chosen.gains, fit.chosen.torques),
        ),
        two,
        tests,
        geometry,
        moved,
    )


def _one_machine(account: Explained, two: str | None) -> tuple[Explained, str | None]:
    """Return how much is explained: what one fit to two machines lacks is no fault of either recording."""
    if account.refusal is not None and two is not None:
        account = replace(account, refusal=f"{REFUSED}: {two[0].lower()}{two[1:]}")
    return account, two


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def _alone(fit: OutputErrorFit) -> list[Alone]:
    if len(fit.pieces) < 2 or fit.reading is not None:
        return []
    chosen, found = fit.chosen, []
    names = distinct_names([piece.recording for piece in fit.pieces])
    for label, piece, state in zip(names, fit.pieces, chosen.solution.states, strict=True):
        alone = solve(fit.model, [piece], chosen.free, states=[state], scale=fit.scale, tolerance=1e-5)
        errors = candidate_errors(replace(chosen, solution=alone, validation=None), [piece], fit.scale, white=False)
        values = {n: alone.model.natural_frequency if n == FREQUENCY else alone.model[n] for n in errors.deviation}
        found.append(Alone(label, values, errors.deviation))
    return found


def _moved_zero(fit: OutputErrorFit, recording: Recording, rms: float) -> tuple[float, float] | None:
    """Return how far the zero of a recording lies from that of the fit [rad] and its rms with it, if that is better."""
    if recording.input_kind == "position_goal":
        return None
    piece = prepare(recording, fit.window)
    found = solve(fit.model, [piece], ("angle_offset",), scale=fit.scale, tolerance=1e-5, max_iterations=20)
    own = window_score(found.model, recording, fit.window).rms
    return (found.model["angle_offset"] - fit.model["angle_offset"], own) if own < 0.8 * rms else None


def _behind_motors(plant: PlantParameters, found: IdentificationResult) -> IdentificationResult:
    """Return the result of the plant behind its motors as one of the plant in volts."""
    notes = []
    for name, actuator in zip(plant.coordinates.driven_names, plant.actuators, strict=True):
        motor = actuator.motor
        assert motor is not None
        notes.append(
            f"The motor of {name} was given: {motor.gain:.4g} per volt. {name}.damping contains its back EMF, "
            f"{motor.damping:.3g}, which the plant file has apart."
        )
    found = replace(found, motors=plant, notes=(RATIOS, *notes, *found.notes))
    if not found.refused:
        try:
            found.plant(plant.name)
        except ParameterError as error:
            return replace(found, explained=replace(found.explained, refusal=f"{REFUSED}: {error}"))
    return found


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_joints(
    plant: PlantParameters,
    recordings: Sequence[JointRecording],
    *,
    held_out: Sequence[JointRecording] = (),
    window: float | None = None,
    extras: str | None = None,
) -> IdentificationResult:
    """Identify a mechanism by output error and judge the result.

    Args:
        plant: Start, and what is held: lengths, gears, gravity, masses that the motion does not determine.
        recordings: Data to fit, all of one machine.
        held_out: Recordings to score only.
        window: Length of the windows [s]; by default a sixth of the data, between 0.5 and 5 s, or what
            neighbouring motions stay together for.
        extras: One of ``EXTRAS``; None lets held-out windows choose.

    Raises:
        DataError: A recording is too short, of other joints, or one joint of it does not move.
    """
    if plant.coordinates.volts:
        fitted, kept = ([each.at_standstill(plant) for each in some] for some in (recordings, held_out))
        options: Any = {"held_out": kept, "window": window, "extras": extras}
        return _behind_motors(plant, identify_joints(plant.torque_plant, fitted, **options))
    return identify_motions(
        JointModel.of(plant), recordings, IdentificationResult, undetermined_joints,
        held_out=held_out, window=window, extras=extras,
    )  # fmt: skip


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_motions(
    start: MotionModel,
    recordings: Sequence[JointRecording],
    make: Callable[..., R],
    lost: Callable[[JointFit, Uncertainty], str | None],
    *,
    held_out: Sequence[JointRecording] = (),
    window: float | None = None,
    extras: str | None = None,
) -> R:
    """Identify any simulation of joints as :func:`identify_joints` does.

    ``make`` makes the result of its fields; ``lost`` says, in a sentence, what the recordings do not determine.
    """
    for recording in (*recordings, *held_out):
        recording.check(start.coordinates)
    check_distinct(recordings, held_out)
    best = search(start, recordings, window, extras)
    found, held = hold_undetermined(best.fit)
    names = distinct_names([*recordings, *held_out])
    training = dict(zip(names, found.scores, strict=False))
    others = [prepare_windows(recording, best.length) for recording in held_out]
    outside = dict(
        zip(names[len(recordings) :], joint_scores(found.model, others, found.weights, own=found.own), strict=True)
    )
    alone = each_alone(found)
    uncertainty = assess_joints(found, held, alone)
    account = explained_joints(found, refusal(found, training, outside) or lost(found, uncertainty))
    sizes = dict.fromkeys((name for name in start.sizes if name in found.free), _ONE_SIZE)
    account, two = _one_machine(account, excluding(alone, sizes, found.model.unit))
    notes, delay = _notes(recordings, best.pushed), uncertainty.intervals.get(DELAY)
    if delay is not None:
        notes += [held_sentence(one.name, delay, one) for one in recordings if looks_held(one, delay)]
    if found.own:
        zeros = OwnOffsets(found.own, found.offsets - found.offsets.mean(axis=0))
        notes.append(zeros.sentence(names[: len(recordings)], found.model.unit))
    if best.parted:
        notes.append(
            f"Windows of {best.length:.2g} s: over longer ones neighbouring motions part (chaos, or no balance)."
        )
    return make(
        found,
        best.extras,
        {name: (error, None) for name, error in best.candidates.items()},
        uncertainty,
        account,
        training,
        outside,
        best.length,
        _now(),
        tuple(map(fingerprint, recordings)),
        tuple(notes),
        two,
    )


def _tried(gains: Mapping[str, float], taken: Sequence[str]) -> list[str]:
    """Return which terms were tried, those in the fit first, with the share of the held-out error that each takes."""
    listings = [
        f"{'taken' if inside else 'not taken'}, {', '.join(each)}"
        for inside in (True, False)
        if (each := [f"{words} ({100.0 * gain:.2g} %)" for words, gain in gains.items() if (words in taken) == inside])
    ]
    said = "Terms that were tried, and by how much each lowers the rms of held-out windows"
    return [f"{said}: {'; '.join(listings)}."] if listings else []


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
