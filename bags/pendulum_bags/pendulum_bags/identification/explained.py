"""Does the model explain the motion at all?

A fit always ends somewhere. Its error means something only beside what no model at all would leave: the error of the
best straight line through each window, whose two numbers are those of the window's initial state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.readings import DOUBTFUL_SHARE, errors_by_window
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.solver import residuals

__all__ = ["REFUSED", "Explained", "explained"]

REFUSED = "REFUSED"
"""How the sentence begins that a fit is no model of the recorded motion."""

LARGEST_SHARE = 0.5
"""Error of the model over that of straight lines from which on it counts as no model; a good fit is at 0.01 to 0.05."""


@dataclass(frozen=True)
class Explained:
    """How much of the motion a fit explains.

    Args:
        rms: Error of the model over the windows without outliers [rad].
        lines: Error of the best straight line through each of those windows [rad].
        share: Their ratio: 0 explains everything, 1 as much as no model at all.
        refusal: Sentence that the fit is no model of this motion; None where it is one.
        doubt: Sentence that a part of the motion is not explained; None where it is, or where noise hides it.
    """

    rms: float
    lines: float
    share: float
    refusal: str | None
    doubt: str | None = None


def explained(fit: OutputErrorFit, outliers: Sequence[tuple[str, float, float, float]] = ()) -> Explained:
    """Return how much of the motion a fit explains, and refuse it where that is next to nothing.

    Args:
        fit: The fit.
        outliers: Windows that stand out, as :class:`ResidualTests` names them: a hand in a few of them is no fault of
            the model, as long as they are few.
    """
    parts = residuals(fit.model, fit.pieces, fit.chosen.solution.states)
    errors, lines = errors_by_window(parts, fit.pieces)
    keep = np.ones(errors.size, dtype=bool)
    if 0 < len(outliers) <= 0.25 * errors.size:
        keep[np.argsort(errors)[-len(outliers) :]] = False
    rms, straight = (float(np.sqrt(np.mean(values[keep] ** 2))) for values in (errors, lines))
    share = rms / straight if straight > 0.0 else 1.0
    noise = _noise(fit.pieces)
    refusal = None
    if fit.reading is not None:
        refusal = f"{REFUSED}: {fit.reading}"
    elif _is_static(fit, parts):
        refusal = (
            f"{REFUSED}: the recorded torque is a function of the angle alone, as of gravity compensation or a spring, "
            "and the fit has no inertia left: the motion does not come from this torque (a hand?). Excite the pendulum "
            "by a torque that does not follow from its angle."
        )
    if refusal is None and straight > 3.0 * noise and share > LARGEST_SHARE:
        refusal = (
            f"{REFUSED}: the model explains next to nothing. It misses the angle by {rms:.3g} rad rms over the "
            f"windows, and straight lines without any model miss it by {straight:.3g} rad. Is the recorded input what "
            "drives this motion (its unit, its sign, its stamps, a hand, another joint), and is the angle in rad from "
            "hanging?"
        )
    excess = math.sqrt(max(rms**2 - noise**2, 0.0))
    doubt = None
    if refusal is None and straight > 3.0 * noise and excess > DOUBTFUL_SHARE * straight:
        doubt = (
            f"{INCOMPLETE}: the fit misses {100.0 * share:.0f} % of the motion ({rms:.3g} rad rms; "
            f"straight lines miss {straight:.3g} rad, and the sensor's noise is {noise:.2g} rad). Something moves the "
            "pendulum that is not in the model or not in the recording; no interval covers it."
        )
    return Explained(rms, straight, share, refusal, doubt)


def _is_static(fit: OutputErrorFit, parts: Sequence[Array]) -> bool:
    """Return whether angle and input are one function of each other, to 1 %, in a fit without torque of inertia."""
    if fit.model.input_kind not in {"effort", "voltage"}:
        return False
    drive, inertial = [], []
    angles = []
    for part, piece in zip(parts, fit.pieces, strict=True):
        recording = piece.recording
        inside = piece.mask()
        u = np.interp(recording.time, recording.input_stamps, recording.input)
        theta = np.where(inside, part + recording.position, recording.position)
        speed = np.gradient(theta, recording.time)
        drive.append(fit.model["input_gain"] * u[inside])
        inertial.append(fit.model["inertia"] * np.gradient(speed, recording.time)[inside])
        angles.append(recording.position[inside])
    u, angle, accelerating = np.concatenate(drive), np.concatenate(angles), np.concatenate(inertial)
    if np.std(u) <= 0.0 or np.median(np.abs(accelerating)) > 0.02 * np.std(u):
        return False
    columns = np.stack((np.ones_like(angle), np.sin(angle), np.cos(angle), angle), axis=1)
    rest = u - columns @ np.linalg.lstsq(columns, u, rcond=None)[0]
    return bool(np.std(rest) < 0.1 * np.std(u))


def _noise(pieces: Sequence[Piece]) -> float:
    """Return the sensor's noise by third differences, in which a smooth motion all but vanishes [rad]."""
    thirds = np.concatenate([np.diff(piece.recording.position, 3) for piece in pieces])
    return float(np.std(thirds) / math.sqrt(20.0))
