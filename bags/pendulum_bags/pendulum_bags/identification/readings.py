"""Would another reading of the angle (from upright, in degrees) explain the motion far better than the given one?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, prepare
from pendulum_bags.identification.solver import Solution, residuals, solve
from pendulum_bags.identification.starts import first_models, rank
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError

__all__ = ["DOUBTFUL_SHARE", "errors_by_window", "other_reading"]

DOUBTFUL_SHARE = 0.1
"""From here on the fit misses what can be seen with the eye, and other readings of the angle are tried."""

_FEW = 10
"""Windows that a quick fit looks at."""

_READINGS: tuple[tuple[str, float, float], ...] = (
    ("measured from upright", 1.0, math.pi),
    ("in degrees", math.pi / 180.0, 0.0),
    ("in degrees and measured from upright", math.pi / 180.0, math.pi),
    ("measured from the horizontal", 1.0, 0.5 * math.pi),
    ("measured from the horizontal", 1.0, -0.5 * math.pi),
    ("in revolutions", 2.0 * math.pi, 0.0),
)
"""What an angle may be instead of radians from hanging: words, factor, shift [rad]."""

_ADVICE = {
    "measured from upright": "`offset: 180` with `unit: deg` (or 3.14159 with rad)",
    "in degrees": "`unit: deg`",
    "in degrees and measured from upright": "`unit: deg` with `offset: 180`",
    "measured from the horizontal": "`offset` of a quarter of a turn",
    "in revolutions": "`unit: rev`",
}


def errors_by_window(parts: Sequence[Array], pieces: Sequence[Piece]) -> tuple[Array, Array]:
    """Return rms errors of the model and of straight lines, by window, shape (w,) each [rad]."""
    errors, lines = [], []
    for part, piece in zip(parts, pieces, strict=True):
        time, angle = piece.recording.time, piece.recording.position
        for first, stop in piece.windows:
            errors.append(float(np.sqrt(np.mean(part[first:stop] ** 2))))
            t = time[first:stop] - np.mean(time[first:stop])
            y = angle[first:stop] - np.mean(angle[first:stop])
            slope = float(t @ y) / max(float(t @ t), 1e-300)
            lines.append(float(np.sqrt(np.mean((y - slope * t) ** 2))))
    return np.array(errors), np.array(lines)


def other_reading(
    found: Solution, pieces: Sequence[Piece], fixed: FitModel, free: Sequence[str], window: float | None
) -> str | None:
    """Return in words how the angle seems to be measured if not in rad from hanging; None where all is well.

    Args:
        found: First fit, with Coulomb friction.
        pieces: Data.
        fixed: Values of what is not free.
        free: Fitted parameters.
        window: Length of the windows [s].
    """
    share = _share(found, pieces)
    gravity_lost = "gravity" in free and found.model["gravity"] <= 0.02 * found.model["inertia"]
    if not (gravity_lost or share > DOUBTFUL_SHARE):
        return None
    best, words = 0.5 * min(share, 1.0), ""
    travel = max(float(np.ptp(piece.recording.position)) for piece in pieces)
    for name, factor, shift in _READINGS:
        # Made small enough any swing is linear, and an offset does the rest: only where the numbers look like it.
        if (name.startswith("in degrees") and travel < 4.0) or (name == "in revolutions" and travel > 2.0):
            continue
        other = _share_if(pieces, fixed, free, window, factor, shift)
        if other < best:
            best, words = other, name
        if best < 0.05:
            break
    if not words:
        return None
    return (
        f"the angle seems to be {words}; expected rad, 0 hanging down. Read so, a first fit misses "
        f"{100.0 * best:.0f} % of the motion instead of {100.0 * share:.0f} %. Say so in a mapping file: "
        f"{_ADVICE[words]} for `position`."
    )


def _share(found: Solution, pieces: Sequence[Piece]) -> float:
    """Return the error of a fit over that of straight lines."""
    errors, lines = errors_by_window(residuals(found.model, pieces, found.states), pieces)
    if not np.all(np.isfinite(errors)):
        return math.inf
    return float(np.sqrt(np.mean(errors**2) / max(float(np.mean(lines**2)), 1e-300)))


def _share_if(
    pieces: Sequence[Piece],
    fixed: FitModel,
    free: Sequence[str],
    window: float | None,
    factor: float,
    shift: float,
) -> float:
    """Return the share that a quick fit to some windows misses if the angle is read otherwise."""

    def read(recording: Recording) -> Recording:
        drive = recording.input
        if recording.input_kind == "position_goal":
            drive = factor * drive + shift
        return replace(recording, position=factor * recording.position + shift, velocity=None, input=drive)

    other = [prepare(read(piece.recording), window) for piece in pieces]
    longest = max((piece.recording for piece in other), key=lambda r: r.duration)
    stride = max(1, sum(len(piece.windows) for piece in other) // _FEW)
    few = [piece.subset(range(0, len(piece.windows), stride)) for piece in other]
    try:
        start = rank(first_models(longest, fixed, free), few, free, keep=1)[0]
        found = solve(
            start.model,
            few,
            free,
            states=start.states,
            scale=0.3,
            tolerance=1e-3,
            max_iterations=15,
            coarse=3.0,
        )
    except (DataError, np.linalg.LinAlgError):
        return math.inf
    return _share(found, few)
