"""Output-error identification: simulate, compare angles, adjust; friction chosen by held-out windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.arrowhead import robust_cost
from pendulum_bags.identification.covariance import information
from pendulum_bags.identification.cross_validation import COARSE, cross_validate, predicted
from pendulum_bags.identification.model import BOUNDS, FRICTION_MODELS, FURTHER_TERMS, SERVO_ONLY, TORQUES, FitModel
from pendulum_bags.identification.options import DEFAULTS, Geometry, Options, default_window
from pendulum_bags.identification.own_offsets import OwnOffsets, align
from pendulum_bags.identification.problem import Piece, prepare
from pendulum_bags.identification.readings import misfit_cause
from pendulum_bags.identification.selection import Candidate, by_window, choose, effective_samples
from pendulum_bags.identification.solver import Solution, angle_motions, refine, residuals, solve
from pendulum_bags.identification.starts import first_models, rank
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.errors import DataError

__all__ = ["DEFAULTS", "OFFSETS", "Geometry", "Options", "OutputErrorFit", "fit_output_error"]

OFFSETS = ("angle_offset", "torque_offset")
"""What may be left out: zero errors of the angle and of the torque."""

_PROMISING = 0.01
"""Share by which a torque must promise to lower the held-out rms to be fitted."""

_FRICTION_STARTS: Mapping[str, tuple[Mapping[str, float], ...]] = {
    # As shares of the Coulomb friction found before, and velocities in rad/s.
    "stribeck": tuple({"stribeck_excess": 0.3, "stribeck_velocity": v} for v in (0.1, 1.0)),
    "load": ({"load_friction": 0.02}, {"load_friction": 0.1}),
    "gear_load": (
        {"load_friction": 0.02, "drive_load_friction": 0.02},
        {"load_friction": 0.1, "drive_load_friction": 0.3},
    ),
    "gear_load_stribeck": (
        {"load_friction": 0.02, "drive_load_friction": 0.02, "load_stribeck": 0.2, "stribeck_velocity": 0.3},
        {"load_friction": 0.2, "drive_load_friction": 0.3, "load_stribeck": 0.4, "stribeck_velocity": 0.3},
    ),
}


@dataclass(frozen=True)
class OutputErrorFit:
    """The chosen candidate and all others, with the data as cut.

    Args:
        chosen: The fit that counts.
        candidates: One for each friction model that was tried, with the chosen offsets.
        pieces: The recordings with their windows.
        scale: Of the robust loss [rad].
        options: Choices.
        window: Length of the windows [s]; None for whole recordings.
        sign_flipped: Whether the recorded effort counts with sign -1.
        offset_candidates: Fits with Coulomb friction, one for each set of offsets that was tried.
        reading: How the angle seems to be measured, if not in rad from hanging.
        zeros: Offsets of the recordings from their mean, where they differ; ``pieces`` are without them.
        recordings: As they were read.
    """

    chosen: Candidate
    candidates: tuple[Candidate, ...]
    pieces: tuple[Piece, ...]
    scale: float
    options: Options
    window: float | None
    sign_flipped: bool
    offset_candidates: tuple[Candidate, ...] = ()
    reading: str | None = None
    zeros: OwnOffsets | None = None
    recordings: tuple[Recording, ...] = ()

    @property
    def free(self) -> tuple[str, ...]:
        """Names of what was fitted."""
        return self.chosen.free

    @property
    def model(self) -> FitModel:
        """The fitted model."""
        return self.chosen.solution.model


def fit_output_error(recordings: Sequence[Recording], options: Options = DEFAULTS) -> OutputErrorFit:
    """Fit the model to recordings of one and the same pendulum with one kind of input.

    Raises:
        DataError: for no data, mixed inputs, or a recording in which nothing moves.
    """
    fixed, free = _frame(recordings, options)
    window = options.window or default_window(fixed.input_kind, sum(recording.duration for recording in recordings))
    pieces = [prepare(recording, window) for recording in recordings]
    longest = max(recordings, key=lambda r: r.duration)
    base = (*free, "coulomb_friction")
    models = first_models(longest, fixed, base, spread=options.multi_start)
    # Ranked twice: by a loss that can pull from far, and by one that a single pushed window cannot sway.
    starts = [start for scale in (0.3, 0.03) for start in rank(models, pieces, base, scale=scale, keep=2)]
    best, scale = _anneal(starts, pieces, base)
    best, pieces, zeros = align(best, pieces, base, window, scale, coarse=COARSE)
    if zeros is not None:
        scale = _robust_scale(best, pieces)
        best = solve(best.model, pieces, base, states=best.states, scale=scale, tolerance=1e-7, coarse=COARSE)
    reading = misfit_cause(best, pieces, fixed, base, window)
    names = [options.friction]
    if reading is not None:
        # Refused: what follows is only to be shown, not to be believed.
        options, names = replace(options, angle_offset=False, torque_offset=False, folds=1), ["coulomb"]
        free = tuple(n for n in free if n not in OFFSETS)
    elif options.friction == "auto":
        left_out = {*FURTHER_TERMS, *(() if fixed.input_kind == "position_goal" else SERVO_ONLY)}
        names = [name for name in FRICTION_MODELS if name not in left_out]
    gains: dict[str, float] = {}
    starts, own = [best], list[tuple[str, ...]]([()])
    if options.friction == "auto" and reading is None and fixed.input_kind != "position_goal":
        turned, torques, gains = _torques(best, pieces, free, scale, options)
        if torques:
            # Friction and offsets are chosen with them and without: either may stand in for the other.
            starts, own = [best, turned], [(), torques]
    candidates: list[Candidate] = []
    tried = []
    for start, torques in zip(starts, own, strict=True):
        kept, begin, offsets = _offsets(start, pieces, (*free, *torques), scale, options)
        inner: list[Candidate] = []
        if names[0] != "viscous":  # friction by name: what every other one contains is tried before it all the same
            inner = [_fit_friction("viscous", begin, pieces, kept, scale, (), replace(options, folds=1))]
        for name in names:
            inner.append(_fit_friction(name, begin, pieces, kept, scale, inner, options))
        tried.append((inner[-len(names) :], offsets))
        candidates += tried[-1][0]
    first = choose(candidates)
    offsets = next(these for some, these in tried if any(one is first for one in some))
    chosen = replace(_finish(first, pieces, scale), gains=gains)
    candidates[[one is first for one in candidates].index(True)] = chosen
    flipped = fixed.input_kind in {"effort", "voltage"} and chosen.solution.model["input_gain"] < 0.0
    return OutputErrorFit(
        chosen,
        tuple(candidates),
        tuple(pieces),
        scale,
        options,
        window,
        flipped,
        offset_candidates=offsets,
        reading=reading,
        zeros=zeros,
        recordings=tuple(recordings),
    )


def _torques(
    best: Solution, pieces: Sequence[Piece], free: Sequence[str], scale: float, options: Options
) -> tuple[Solution, tuple[str, ...], dict[str, float]]:
    """Return a fit with the torques that held-out windows ask for, their parameters, and what each tried one brings.

    To first order the sensitivities show what each would bring; what promises little is not fitted. Schwarz's penalty
    keeps few that are chosen by luck. The third is the share by which each lowers the held-out rms.
    """
    own: tuple[str, ...] = ()
    gains: dict[str, float] = {}
    chosen = _fit_friction("coulomb", best, pieces, free, scale, (), options)
    for _ in TORQUES:
        if chosen.validation is None:
            break
        fits = []
        for words, gain in _promised(chosen, pieces, scale).items():
            gains.setdefault(words, max(gain, 0.0))
            if gain > _PROMISING:
                names = (*free, *own, *TORQUES[words])
                fit = _fit_friction("coulomb", chosen.solution, pieces, names, scale, (), options)
                gains[words] = max(gains[words], 1.0 - fit.score / chosen.score)
                # What is there shows in every part of the data; what is there by luck does not.
                if (
                    fit.validation is not None
                    and np.all(fit.validation.losses < chosen.validation.losses)
                    and _determined(fit.solution.model, fit.validation.vectors, TORQUES[words])
                ):
                    fits.append(fit)
        better = choose([chosen, *fits], strict=True)
        if better is chosen:
            break
        chosen = better
        own = tuple(name for name in chosen.free if name in JOINT_TORQUES)
    return (chosen.solution if own else best), own, gains


def _determined(model: FitModel, vectors: Array, names: Sequence[str]) -> bool:
    """Return whether fits without a fold, shape (f, parameters), agree that one of some amplitudes is not 0."""
    index, count = model.index(names), len(vectors)
    apart = vectors[:, index] - vectors[:, index].mean(axis=0)
    error = np.sqrt((count - 1) / count * np.sum(apart**2, axis=0))
    return bool(np.any(np.abs(model.vector[index]) > student_quantile(0.975, count - 1) * error))


def _promised(candidate: Candidate, pieces: Sequence[Piece], scale: float) -> dict[str, float]:
    """Return the share by which each torque that it has not lowers the held-out rms of a candidate, to first order."""
    solution, k = candidate.solution, len(candidate.free)
    model, found = solution.model, {}
    motions = angle_motions(model, pieces, scale, COARSE)
    names = (*candidate.free, *(name for name in JOINT_TORQUES if name not in candidate.free))
    seen = information([model] * len(pieces), motions, solution.states, names)
    before, _ = predicted(seen.windows, pieces, range(k), np.zeros(0))
    for words, own in TORQUES.items():
        if set(own) <= set(candidate.free):
            continue
        after, step = predicted(seen.windows, pieces, [*range(k), *(names.index(name) for name in own)], np.zeros(0))
        allowed = all(-value >= BOUNDS[name][0] for name, value in zip(own, step[k:], strict=True))
        found[words] = 1.0 - float(np.sqrt(after.sum() / before.sum())) if allowed and before.any() else 0.0
    return found


def _frame(recordings: Sequence[Recording], options: Options) -> tuple[FitModel, tuple[str, ...]]:
    """Return what is fixed, and the names of what is fitted apart from dry friction."""
    if not recordings:
        raise DataError("there is no recording to identify from; expected at least one")
    kinds = {recording.input_kind for recording in recordings}
    if len(kinds) > 1:
        raise DataError(f"the recordings have different inputs ({', '.join(sorted(kinds))}); expected one kind")
    for recording in recordings:
        if np.ptp(recording.position) < 1e-2:
            raise DataError(
                f"{recording.name} moves by {np.ptp(recording.position):.2g} rad only; expected a moving pendulum"
            )
    kind = kinds.pop()
    geometry = options.geometry
    values: dict[str, float] = {}
    free = ["damping", "gravity"]
    duty_gain = 0.0
    if kind == "position_goal":
        geometry = geometry if geometry.gravity is not None else _geometry_of(recordings)
        values.update(gravity=geometry.gravity or 1.0, inertia=geometry.inertia or geometry.least_inertia or 1.0)
        duty_gain = float(np.median([_duty_gain(recording) for recording in recordings]))
        # The bob fixes the scale; its arm's zero is an angle, so a torque offset would only double it.
        free = ["damping", "inertia", "input_gain", "drive_damping"]
    elif options.fix_scale and kind == "none":
        values["gravity"] = float(geometry.gravity or 1.0)
        free = ["damping", "inertia"]
    elif kind == "none" or (kind == "voltage" and not options.fix_scale):
        values["inertia"] = geometry.inertia or 1.0
        if kind == "voltage":
            free.append("input_gain")
    elif options.fix_scale:
        values["gravity"] = float(geometry.gravity or 1.0)
        free = ["damping", "inertia", "input_gain"]
    else:
        free.append("inertia")
    # A constant input has no delay to be seen, and a gain of its own is an offset.
    varies = kind != "none" and any(np.ptp(recording.input) > 0.0 for recording in recordings)
    if options.torque_offset and kind in {"effort", "voltage"} and (varies or "input_gain" not in free):
        free.append("torque_offset")
    if options.angle_offset:
        free.append("angle_offset")
    if varies:
        free.append("transport_delay")
    return FitModel(values, kind, "coulomb", duty_gain), tuple(free)


def _geometry_of(recordings: Sequence[Recording]) -> Geometry:
    known = {
        (float(r.meta["mass"]), float(r.meta["length"])) for r in recordings if {"mass", "length"} <= r.meta.keys()
    }
    if len(known) != 1:
        raise DataError(
            f"the servo logs name {len(known)} pairs of mass and length; expected one, or --mass and --length"
        )
    mass, length = known.pop()
    return Geometry(mass, length)


def _duty_gain(recording: Recording) -> float:
    """Return duty cycle per set-point error and firmware gain [1/rad], from the servo's own load report."""
    if "load" not in recording.meta:
        # P gain / 128 in encoder steps (4096 a turn) to PWM units (885 full), by the servo's control table.
        return 4096.0 / (2.0 * np.pi) / (128.0 * 885.0)
    # A part of a log keeps the whole input: the rows of its own samples are wanted.
    own = np.isin(recording.input_stamps, recording.time)
    load, error = np.asarray(recording.meta["load"])[own], recording.input[own] - recording.position
    use = np.abs(load) < 0.8
    if recording.enabled is not None:
        use &= recording.enabled[own] > 0.5
    kp = float(recording.meta.get("kp", 1.0))
    slopes = load[use][np.abs(error[use]) > 0.03] / error[use][np.abs(error[use]) > 0.03]
    return float(np.median(slopes) / kp) if slopes.size > 10 else 0.0025


def _anneal(starts: Sequence[Solution], pieces: Sequence[Piece], free: Sequence[str]) -> tuple[Solution, float]:
    """Return the best fit and the scale of its loss, tightened step by step so that a push by hand loses its pull."""
    finalists = []
    for start in starts:
        for first_scale in (0.3, 0.03):
            s = solve(start.model, pieces, free, scale=first_scale, tolerance=1e-4, max_iterations=25, coarse=COARSE)
            finalists.append(
                solve(
                    s.model, pieces, free, states=s.states, scale=0.03, tolerance=1e-5, max_iterations=30, coarse=COARSE
                )
            )
    best = min(finalists, key=lambda s: s.cost)
    scale = _robust_scale(best, pieces)
    polished = solve(best.model, pieces, free, states=best.states, scale=scale, tolerance=1e-7, coarse=COARSE)
    return polished, scale


def _offsets(
    best: Solution, pieces: Sequence[Piece], free: tuple[str, ...], scale: float, options: Options
) -> tuple[tuple[str, ...], Solution, tuple[Candidate, ...]]:
    """Return the free parameters without the offsets that the held-out windows do not ask for.

    An offset of torque and one of angle do nearly the same to a swing: together they chase each other's errors.
    """
    offsets = [name for name in OFFSETS if name in free]
    subsets = [tuple(o for o in offsets if o not in left_out) for left_out in ((), *((o,) for o in offsets), offsets)]
    candidates = []
    for kept in dict.fromkeys(subsets):
        names = tuple(n for n in free if n not in offsets or n in kept)
        values = {k: v for k, v in best.model.values.items() if k not in offsets or k in kept}
        start = replace(best, model=replace(best.model, values=values, friction="coulomb"))
        candidates.append(_fit_friction("coulomb", start, pieces, names, scale, (), options))
    # An offset that is chosen by luck biases all others: the stricter penalty (Schwarz) keeps few of those.
    chosen = choose(candidates, strict=True)
    return tuple(n for n in chosen.free if n in free), chosen.solution, tuple(candidates)


def _robust_scale(solution: Solution, pieces: Sequence[Piece]) -> float:
    """Return three robust standard deviations of the residual: the loss leaves good samples quadratic [rad]."""
    inside = _inside(solution, pieces)
    spread = 1.4826 * float(np.median(np.abs(inside - np.median(inside))))
    return max(3.0 * spread, 1e-6)


def _fit_friction(
    name: str,
    start: Solution,
    pieces: Sequence[Piece],
    free: Sequence[str],
    scale: float,
    simpler: Sequence[Candidate],
    options: Options,
) -> Candidate:
    names = FRICTION_MODELS[name]
    everything = (*free, *names)
    begin: list[tuple[FitModel, list[Array]]] = []
    # A simpler model is contained in this one: starting there, the cost cannot end above it.
    for previous in (start, *(c.solution for c in simpler if set(FRICTION_MODELS[c.friction]) <= set(names))):
        model = previous.model
        values = {k: v for k, v in model.values.items() if k in free or not _is_friction(k) or k in names}
        begin.append((replace(model, values=values, friction=name), previous.states))
    contained = len(begin)
    kind = name.replace("stribeck_", "") if name != "stribeck" else name
    additions = _FRICTION_STARTS.get(kind, ()) + (_FRICTION_STARTS["stribeck"] if name.startswith("stribeck_") else ())
    coulomb = max(start.model["coulomb_friction"], 1e-3 * abs(start.model["gravity"]))
    for addition in additions:
        values = {**start.model.values, **addition}
        if "stribeck_excess" in addition:
            values["stribeck_excess"] = addition["stribeck_excess"] * coulomb
        else:
            values["coulomb_friction"] = 0.5 * coulomb
        begin.append((replace(start.model, values=values, friction=name), start.states))
    solutions = [solve(m, pieces, everything, states=s, scale=scale, tolerance=1e-7, coarse=COARSE) for m, s in begin]
    # Long steps may have found what short ones do not confirm: those decide, between finds and starts too.
    solutions += [replace(start, model=m, states=s) for m, s in begin[:contained]]
    insides = [_inside(s, pieces) for s in solutions]
    costs = [robust_cost(inside, scale) for inside in insides]
    number = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
    best, inside = replace(solutions[number], cost=costs[number]), insides[number]
    best = replace(best, model=replace(best.model, friction=name))
    parts = residuals(best.model, pieces, best.states)
    validation = cross_validate(best.model, pieces, best.states, everything, scale, count=options.folds)
    mean_cost = robust_cost(inside, scale) / inside.size
    rms = float(np.sqrt(np.mean(inside**2)))
    return Candidate(name, everything, best, rms, validation, mean_cost, effective_samples(by_window(parts, pieces)))


def _inside(solution: Solution, pieces: Sequence[Piece]) -> Array:
    parts = residuals(solution.model, pieces, solution.states)
    return np.concatenate([part[piece.mask] for part, piece in zip(parts, pieces, strict=True)])


def _is_friction(name: str) -> bool:
    return any(name in names for names in FRICTION_MODELS.values())


def _finish(candidate: Candidate, pieces: Sequence[Piece], scale: float) -> Candidate:
    """Return the candidate fitted to the end with fine integration steps, single windows tried again."""
    found = candidate.solution
    final = solve(found.model, pieces, candidate.free, states=found.states, scale=scale, tolerance=1e-8)
    final = refine(final, pieces, candidate.free, scale=scale)
    final = replace(final, model=replace(final.model, friction=candidate.friction))
    rms = float(np.sqrt(np.mean(_inside(final, pieces) ** 2)))
    return replace(candidate, solution=final, searched=found, training_rms=rms)
