"""Does the model explain the motion at all?

A fit always ends somewhere. Its error means something only next to what no model at all would leave: the error of the
best straight line through each window, whose two numbers are those of the window's initial state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.identification.model import to_plant
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.problem import sensor_noise
from pendulum_bags.identification.readings import DOUBTFUL_SHARE, errors_by_window
from pendulum_bags.identification.residual_tests import INCOMPLETE
from pendulum_bags.identification.selection import at_bounds
from pendulum_bags.identification.solver import residuals
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.plants.determined import SPAN, undetermined

__all__ = ["REFUSED", "Explained", "explained", "undetermined_fit"]

REFUSED = "REFUSED"
"""How the sentence begins that a fit is no model of the recorded motion."""

LARGEST_SHARE = 0.5
"""Error of the model over that of straight lines from which on it counts as no model; a good fit is at 0.01 to 0.05."""


@dataclass(frozen=True)
class Explained:
    """How much of the motion a fit explains.

    Args:
        rms: Error of the model over the windows without outliers, of each joint [rad or m].
        lines: Error of the best straight line through each of those windows.
        share: Their ratio, of the joint where it is worst: 0 explains everything, 1 as much as no model at all.
        refusal: Sentence that the fit is no model of this motion; None where it is one.
        incomplete: Sentence that a part of the motion is not explained; None where it is, or where noise hides it.
        joints: Of the plant.
    """

    rms: tuple[float, ...]
    lines: tuple[float, ...]
    share: float
    refusal: str | None
    incomplete: str | None = None
    joints: tuple[Joint, ...] = ONE_JOINT.joints

    @property
    def sentence(self) -> str:
        """How much it explains, in words, without the full stop."""
        several = len(self.joints) > 1
        missed, straight = (
            ", ".join(
                f"{joint.name + ' ' if several else ''}{1e3 * value:.3g} m{joint.unit}"
                for joint, value in zip(self.joints, values, strict=True)
            )
            for values in (self.rms, self.lines)
        )
        least = " or more, joint by joint" if several else ""
        fits = f"Fits {100.0 * (1.0 - self.share):.3g} % of the motion{least}"
        return f"{fits}: it misses {missed} rms where straight lines miss {straight}"


def explained(fit: OutputErrorFit, outliers: Sequence[tuple[str, float, float, float]] = ()) -> Explained:
    """Return how much of the motion a fit explains, and refuse it where that is next to nothing.

    A hand in a few windows, the ``outliers`` of :class:`ResidualTests`, is no fault of the model.
    """
    parts = residuals(fit.model, fit.pieces, fit.chosen.solution.states)
    errors, lines = errors_by_window(parts, fit.pieces)
    keep = np.ones(errors.size, dtype=bool)
    if 0 < len(outliers) <= 0.25 * errors.size:
        keep[np.argsort(errors)[-len(outliers) :]] = False
    rms, straight = (float(np.sqrt(np.mean(values[keep] ** 2))) for values in (errors, lines))
    share = rms / straight if straight > 0.0 else 1.0
    noise = float(np.sqrt(np.mean([sensor_noise(piece.recording.position) ** 2 for piece in fit.pieces])))
    refusal = None
    if fit.reading is not None:
        refusal = f"{REFUSED}: {fit.reading}"
    elif share > DOUBTFUL_SHARE and any(piece.recording.meta.get("no_torque") for piece in fit.pieces):
        refusal = (
            f"{REFUSED}: the recorded torque is 0 throughout, yet no free swing explains the motion: it misses "
            f"{100.0 * share:.0f} % of it. Is the column of the torque another one?"
        )
    elif straight > 3.0 * noise and share > LARGEST_SHARE:
        refusal = (
            f"{REFUSED}: the model explains next to nothing. It misses the angle by {rms:.3g} rad rms over the "
            f"windows, and straight lines without any model miss it by {straight:.3g} rad. No other unit, zero or sign "
            "of the angle, no other time of the input and no other length of the windows explains it: something else "
            "moves this pendulum, or the columns are of something else."
        )
    excess = math.sqrt(max(rms**2 - noise**2, 0.0))
    incomplete = None
    if refusal is None and straight > 3.0 * noise and excess > DOUBTFUL_SHARE * straight:
        incomplete = (
            f"{INCOMPLETE}: the fit misses {100.0 * share:.0f} % of the motion ({rms:.3g} rad rms; "
            f"straight lines miss {straight:.3g} rad, and the sensor's noise is {noise:.2g} rad). Something moves the "
            "pendulum that is not in the model or not in the recording; no interval covers it."
        )
    return Explained((rms,), (straight,), share, refusal, incomplete)


def undetermined_fit(fit: OutputErrorFit, uncertainty: Uncertainty) -> str | None:
    """Return the sentence that the recording does not determine what a plant file needs; None where it does."""
    model = fit.model
    free = model.input_kind == "none"
    lost: dict[str, str] = {}
    # Of a free swing or a voltage only ratios to the inertia are fitted: it has no interval.
    intervals = {name: (found.low, found.high) for name, found in uncertainty.intervals.items()}
    drive = model["input_gain"] * np.concatenate([piece.recording.input for piece in fit.pieces])
    largest = float(np.max(np.abs(drive)))
    for name, (_, high) in undetermined(to_plant(model, effort_limit=largest or 1.0), intervals).items():
        # Where the estimate's neighbourhood alone was asked, that it reaches 0 says little of 0.
        if name in uncertainty.profiles or not 0.0 < high <= SPAN * model[name]:
            lost[name] = uncertainty.intervals[name].text
    gain = uncertainty.intervals.get("input_gain")
    if gain is not None and gain.low <= 0.0 <= gain.high:
        lost["input_gain"] = gain.text
    offset = uncertainty.intervals.get("torque_offset")
    if offset is not None and not free and offset.high - offset.low > 2.0 * largest:
        lost["torque_offset"] = f"{offset.text}, more than all of the recorded torque"
    level, spread = float(np.mean(drive)), float(np.std(drive))
    if not free and abs(level + model["torque_offset"]) < 0.1 * abs(level) > model["gravity"] and abs(level) > spread:
        lost["gravity"] = "torque_offset takes away the recorded torque, which may be what holds the weight"
    for name in at_bounds(fit.chosen):
        # A strength of 0 is a result; the end of a range that was never meant to be reached is none.
        if name in {"inertia", "gravity", "torque_offset", "angle_offset", "input_gain"} and model[name] != 0.0:
            lost[name] = "at the end of the range in which it is sought"
    if not lost:
        return None
    listing = ", ".join(f"{name} {model[name]:.4g} {model.units[name]} ({why})" for name, why in lost.items())
    more = "a swing from a larger angle" if free else "a torque that moves it to and fro through larger angles"
    return f"{REFUSED}: the recording does not determine {listing}; no plant can be made of it. Record {more}."
