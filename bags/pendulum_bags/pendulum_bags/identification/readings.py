"""Why does a fit miss the motion? Causes (unit and zero of the angle, stamps of the torque, a hand), each tried."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import BOUNDS, FitModel
from pendulum_bags.identification.options import default_window
from pendulum_bags.identification.problem import Piece, off_line, prepare
from pendulum_bags.identification.solver import Solution, residuals, solve
from pendulum_bags.identification.starts import equation_residual, first_models, rank
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError

__all__ = ["DOUBTFUL_SHARE", "errors_by_window", "misfit_cause"]

DOUBTFUL_SHARE = 0.1
"""From here on the fit misses what can be seen with the eye, and other readings of the recording are tried."""

_FEW = 10
"""Windows that a quick fit is made to."""

_BETTER = 0.5
"""A cause is named where without it the fit misses less than this share of what it misses with it."""

_UNITS: tuple[tuple[str, str, float], ...] = (
    ("", "", 1.0),
    ("in degrees", "`unit: deg`", math.pi / 180.0),
    ("in revolutions", "`unit: rev`", 2.0 * math.pi),
)
"""What an angle may be instead of radians: words, advice, factor."""

_MOST_TURNS = 10.0
"""Travel in revolutions beyond which an angle is not taken for one."""

_LONGEST_SHIFT = 2.0
"""Largest error of the torque's stamps that is tried [s]."""


def errors_by_window(parts: Sequence[Array], pieces: Sequence[Piece]) -> tuple[Array, Array]:
    """Return rms errors of the model and of straight lines, by window, shape (w,) each [rad]."""
    errors, lines = [], []
    for part, piece in zip(parts, pieces, strict=True):
        time, angle = piece.recording.time, piece.recording.position
        for first, stop in piece.windows:
            errors.append(float(np.sqrt(np.mean(part[first:stop] ** 2))))
            lines.append(float(np.sqrt(np.mean(off_line(time[first:stop], angle[first:stop]) ** 2))))
    return np.array(errors), np.array(lines)


def misfit_cause(
    found: Solution, pieces: Sequence[Piece], fixed: FitModel, free: Sequence[str], window: float | None
) -> str | None:
    """Return in words why a fit misses the motion, with what mends it; None where all is well or nothing tried helps.

    A cause is named only where a fit to all of the data without it explains the motion, by a torque that moves the
    pendulum: following the advice leads to a fit that is taken. ``found`` is a first fit, with Coulomb friction.
    """
    share = _share(found, pieces)
    static = _is_static(found, pieces)
    gravity_lost = "gravity" in free and found.model["gravity"] <= 0.02 * found.model["inertia"]
    zero_lost = "angle_offset" in free and abs(found.model["angle_offset"]) >= BOUNDS["angle_offset"][1]
    if not (gravity_lost or zero_lost or static or share > DOUBTFUL_SHARE):
        return None
    for cause in (_other_reading, _other_stamps, _other_window):
        said = cause(pieces, fixed, free, window, share)
        if said is not None:
            best, words, advice = said
            return (
                f"{words}. Read so, a fit misses {100.0 * best:.2g} % of the motion instead of "
                f"{100.0 * min(share, 99.0):.2g} %. {advice}"
            )
    if static or (share > DOUBTFUL_SHARE and _torque_of_angle(found.model, pieces)):
        return (
            "the recorded torque is a function of the angle alone, as of gravity compensation or a spring, which "
            "nothing tells from the weight, and what else moves the pendulum (a hand?) is not recorded. Excite it by a "
            "torque that does not follow from its angle."
        )
    return None


def _share(found: Solution, pieces: Sequence[Piece]) -> float:
    errors, lines = errors_by_window(residuals(found.model, pieces, found.states), pieces)
    if not np.all(np.isfinite(errors)):
        return math.inf
    return float(np.sqrt(np.mean(errors**2) / max(float(np.mean(lines**2)), 1e-300)))


def _quick(
    recordings: Sequence[Recording],
    fixed: FitModel,
    free: Sequence[str],
    window: float | None,
    *,
    whole: Solution | None = None,
) -> tuple[float, Solution | None]:
    """Return what share a fit misses, and the fit: to some windows, or from that to all of them."""
    try:
        every = [prepare(recording, window) for recording in recordings]
        if whole is not None:
            found = solve(whole.model, every, free, scale=0.3, tolerance=1e-4, max_iterations=40, coarse=3.0)
            return _share(found, every), None if _is_static(found, every) else found
        longest = max((piece.recording for piece in every), key=lambda r: r.duration)
        stride = max(1, sum(len(piece.windows) for piece in every) // _FEW)
        few = [piece.subset(range(0, len(piece.windows), stride)) for piece in every]
        start = rank(first_models(longest, fixed, free, spread=False), few, free, keep=1)[0]
        found = solve(
            start.model, few, free, states=start.states, scale=0.3, tolerance=1e-3, max_iterations=15, coarse=3.0
        )
    except (DataError, np.linalg.LinAlgError):
        return math.inf, None
    return _share(found, few), found


def _confirmed(
    recordings: Sequence[Recording],
    fixed: FitModel,
    free: Sequence[str],
    window: float | None,
    share: float,
    start: Solution | None = None,
) -> tuple[float, Solution] | None:
    """Return what share a fit to all windows misses, and the fit, where that is little and far less than before."""
    start = start or _quick(recordings, fixed, free, window)[1]
    if start is None:
        return None
    other, found = _quick(recordings, fixed, free, window, whole=start)
    return None if found is None or other > min(DOUBTFUL_SHARE, _BETTER * share) else (other, found)


_Cause = tuple[float, str, str]


def _other_reading(
    pieces: Sequence[Piece], fixed: FitModel, free: Sequence[str], window: float | None, share: float
) -> _Cause | None:
    """Return the unit and zero of the angle that explain the motion, where those given do not."""
    longest = max((piece.recording for piece in pieces), key=lambda r: r.duration)
    travel = max(float(np.ptp(piece.recording.position)) for piece in pieces)
    tried = []
    for words, advice, factor in _UNITS:
        # Made small enough any swing is linear, and an offset does the rest: only where the numbers look like it.
        if (words == "in degrees" and travel < 4.0) or (words == "in revolutions" and travel > _MOST_TURNS):
            continue
        try:
            zero = equation_residual(_read(longest, factor, 0.0))[1]
        except DataError:
            return None
        guesses = dict.fromkeys(() if factor == 1.0 else (0.0,))
        guesses |= dict.fromkeys(-z for z in (zero, math.remainder(zero + math.pi, math.tau)) if abs(z) > 0.4)
        for shift in guesses:
            recordings = [_read(piece.recording, factor, shift) for piece in pieces]
            other, found = _quick(recordings, fixed, free, window)
            if found is not None and other < _BETTER * min(share, 1.0):
                tried.append((other, words, advice, factor, shift, recordings, found))
    for _, words, advice, factor, shift, recordings, start in sorted(tried, key=lambda one: one[0])[:3]:
        confirmed = _confirmed(recordings, fixed, free, window, share, start)
        if confirmed is None:
            continue
        other, found = confirmed
        if "gravity" in free and found.model["gravity"] <= 0.02 * found.model["inertia"]:
            continue
        zero = math.remainder(shift - found.model["angle_offset"], math.tau)
        where, how = _zero_words(shift, zero, factor)
        said = " and ".join(part for part in (words, where) if part)
        mend = " with ".join(part for part in (advice, how) if part)
        return other, f"the angle seems to be {said}; expected rad, 0 hanging down", f"In a mapping file: {mend}."
    return None


def _read(recording: Recording, factor: float, shift: float) -> Recording:
    drive = recording.input
    if recording.input_kind == "position_goal":
        drive = factor * drive + shift
    return replace(recording, position=factor * recording.position + shift, velocity=None, input=drive)


def _zero_words(shift: float, zero: float, factor: float) -> tuple[str, str]:
    """Return where an angle is measured from, in words, and what to say of it for ``position``."""
    if shift == 0.0:
        return "", ""
    if abs(zero) > math.pi - 0.2:
        name, exact = "measured from upright", math.pi
    elif abs(abs(zero) - 0.5 * math.pi) < 0.2:
        name, exact = "measured from the horizontal", math.copysign(0.5 * math.pi, zero)
    else:
        name, exact = f"measured from {abs(zero):.2f} rad off hanging", zero
    return name, f"`offset: {exact / factor:.6g}`"


def _other_stamps(
    pieces: Sequence[Piece], fixed: FitModel, free: Sequence[str], window: float | None, share: float
) -> _Cause | None:
    """Return by how much the stamps of the torque are off, where another time explains the motion."""
    if "transport_delay" not in free:
        return None
    longest = max((piece.recording for piece in pieces), key=lambda r: r.duration)
    reach = min(_LONGEST_SHIFT, 0.3 * longest.duration)
    step = max(longest.period, 0.01)
    shifts = step * np.arange(-math.floor(reach / step), math.floor(reach / step) + 1)
    try:
        errors = [equation_residual(_shifted(longest, float(shift)))[0] for shift in shifts]
    except DataError:
        return None
    best = float(shifts[int(np.argmin(errors))])
    low, high = BOUNDS["transport_delay"]
    if low < -best < high:
        return None
    confirmed = _confirmed([_shifted(piece.recording, best) for piece in pieces], fixed, free, window, share)
    if confirmed is None:
        return None
    other, found = confirmed
    off = best - found.model["transport_delay"]
    where = "before" if off < 0.0 else "after"
    return (
        other,
        f"the stamps of the torque seem to be off: the motion follows it {abs(off):.3g} s {where} them",
        "Record torque and angle by one clock, or correct the stamps of one of them by this time.",
    )


def _shifted(recording: Recording, shift: float) -> Recording:
    stamps = recording.input_stamps - shift
    return replace(recording, input_time=stamps).between(float(stamps[0]), float(stamps[-1]) + 1e-9)


def _other_window(
    pieces: Sequence[Piece], fixed: FitModel, free: Sequence[str], window: float | None, share: float
) -> _Cause | None:
    """Return that the windows are too long for the motion, where those of the default explain it."""
    recordings = [piece.recording for piece in pieces]
    usual = default_window(fixed.input_kind, sum(recording.duration for recording in recordings))
    if usual is None or (window is not None and 0.5 * usual < window < 2.0 * usual):
        return None
    confirmed = _confirmed(recordings, fixed, free, usual, share)
    if confirmed is None:
        return None
    other = confirmed[0]
    given = "whole recordings" if window is None else f"windows of {window:g} s"
    return other, f"{given} do not show this motion to a fit", f"Leave out --window: {usual:g} s serve."


def _is_static(found: Solution, pieces: Sequence[Piece]) -> bool:
    """Return whether angle and input are one function of each other, to 1 %, in a fit without torque of inertia."""
    model = found.model
    if model.input_kind not in {"effort", "voltage"}:
        return False
    inertial = []
    for part, piece in zip(residuals(model, pieces, found.states), pieces, strict=True):
        time, inside = piece.recording.time, piece.mask
        theta = np.where(inside, part, 0.0) + piece.recording.position
        inertial.append(model["inertia"] * np.gradient(np.gradient(theta, time), time)[inside])
    drive = np.concatenate([_drive(model, piece) for piece in pieces])
    small = float(np.median(np.abs(np.concatenate(inertial)))) <= 0.02 * float(np.std(drive))
    return small and _torque_of_angle(model, pieces)


def _torque_of_angle(model: FitModel, pieces: Sequence[Piece]) -> bool:
    if model.input_kind not in {"effort", "voltage"}:
        return False
    u = np.concatenate([_drive(model, piece) for piece in pieces])
    angle = np.concatenate([piece.recording.position[piece.mask] for piece in pieces])
    if np.std(u) <= 0.0:
        return False
    columns = np.stack((np.ones_like(angle), np.sin(angle), np.cos(angle), angle), axis=1)
    rest = u - columns @ np.linalg.lstsq(columns, u, rcond=None)[0]
    return bool(np.std(rest) < 0.1 * np.std(u))


def _drive(model: FitModel, piece: Piece) -> Array:
    recording = piece.recording
    return model["input_gain"] * np.interp(recording.time, recording.input_stamps, recording.input)[piece.mask]
