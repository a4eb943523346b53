"""What recordings do not determine, of one joint or several, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.joint_fit import JointFit
from pendulum_bags.identification.model import BOUNDS
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.selection import at_bounds

__all__ = ["Interval", "edge_sentences", "held_sentences", "open_sentences", "scale_sentences"]


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval.

    Args:
        value: Estimate.
        low, high: Ends of the interval.
        standard_error: One standard error, all sources that count included.
        white: The part that white residuals alone would give.
    """

    value: float
    low: float
    high: float
    standard_error: float
    white: float

    @property
    def relative(self) -> float:
        """Half width over value, inf at zero."""
        return 0.5 * (self.high - self.low) / abs(self.value) if self.value else float("inf")

    @property
    def text(self) -> str:
        """Its ends in words."""
        if not np.isfinite(self.high):
            return f"{self.low:.4g} or more" if np.isfinite(self.low) else "anything"
        digits = next((n for n in (4, 6, 8) if f"{self.low:.{n}g}" != f"{self.high:.{n}g}"), 10)
        return f"{self.low:.{digits}g} to {self.high:.{digits}g}"

    def to_json(self) -> dict[str, float]:
        """Return value, ends and standard error as JSON values."""
        return {"value": self.value, "low": self.low, "high": self.high, "standard_error": self.standard_error}


def open_sentences(
    intervals: Mapping[str, Interval],
    names: Sequence[str],
    correlation: Array,
    condition: float,
    weakest: Array,
    delay: str,
) -> list[str]:
    """Return what the recordings leave open, in words.

    ``correlation``, shape (k, k), is of the parameters ``names``, as is ``weakest``, the direction seen least.
    """
    said = []
    late = intervals.get(delay)
    if late is not None and late.high < 0.0:
        said.append(
            f"The input acts {-1e3 * late.value:.3g} ms before its stamps ({-1e3 * late.high:.3g} to "
            f"{-1e3 * late.low:.3g} ms): it was stamped late, by a filter or another clock. That belongs to the "
            "recording, not to the pendulum: a plant file gets no delay from it."
        )
    weak = []
    for name in names:
        interval = intervals[name]
        if interval.relative > 0.3 and name != delay and not name.endswith("_offset"):
            none = "; the data are compatible with none at all" if interval.low <= 0.0 else ""
            weak.append(f"{name} ({interval.text}{none})")
    if weak:
        said.append(f"Weakly determined: {', '.join(weak)}.")
    pairs = [
        f"{names[j]} and {first} ({correlation[i, j]:+.3f})"
        for i, first in enumerate(names)
        for j in range(i)
        if abs(correlation[i, j]) > 0.95
    ]
    if pairs:
        said.append(f"Correlated: {', '.join(pairs)}; the data determine a combination of them better than either.")
    if condition > 1e8:
        parts = ", ".join(f"{names[i]} ({weakest[i]:+.2f})" for i in np.argsort(-np.abs(weakest))[:3])
        said.append(f"There is a direction that the data hardly see, made of {parts}.")
    return said


def scale_sentences(intervals: Mapping[str, Interval], names: Sequence[str], fit: OutputErrorFit) -> list[str]:
    """Return what fixes the scale of all torques of a pendulum, and how well, in words."""
    said = []
    kind = fit.pieces[0].recording.input_kind
    if kind == "none" and "inertia" in names:
        said.append("The pendulum swings freely: the scale of all torques is that of the given mass and length.")
    elif kind == "none":
        said.append(
            "The pendulum swings freely: only ratios to the inertia can be determined, not the absolute scale of "
            "inertia, gravity and friction; give mass and length with --fix-scale, or record a run with a known torque."
        )
    elif kind == "voltage" and "inertia" not in names:
        said.append(
            "The input is a voltage: all torques are per unit of inertia (inertia is set to "
            f"{fit.model['inertia']:g} kg m^2); --mass and --length with --fix-scale fix it."
        )
    scale = [n for n in ("inertia", "gravity") if n in intervals]
    frequency = intervals.get("natural_frequency")
    if len(scale) == 2 and frequency is not None:
        common = max(intervals[n].relative for n in scale)
        if common > max(3.0 * frequency.relative, 0.02):
            said.append(
                f"The common scale of inertia and gravity is uncertain by +-{100 * common:.0f} %, their ratio by "
                f"less: w0 = {frequency.value:.3f} rad/s +-{100 * frequency.relative:.1f} %. A torque known "
                "independently, or a known mass and length, would fix the scale."
            )
    return said


def edge_sentences(intervals: Mapping[str, Interval], fit: OutputErrorFit, unresolved: str | None = None) -> list[str]:
    """Return which parameters of a pendulum ended at the edge of their domain, and which offset stands for two.

    ``unresolved`` is an offset that was left out, though it would have done as well as the one in the fit.
    """
    said = []
    edges = [_edge(name, fit, intervals) for name in at_bounds(fit.chosen)]
    if edges:
        said.append(f"At the edge of their domain: {'; '.join(edges)}.")
    if unresolved is not None:
        said.append(_unresolved(unresolved, intervals, fit))
    return said


def held_sentences(found: JointFit, undetermined: Sequence[str]) -> list[str]:
    """Return what was held in the fit of several joints, ``undetermined`` or known, and what no file of it has."""
    said, model = [], found.model
    if undetermined:
        said.append(
            f"The recordings do not determine {', '.join(undetermined)}: held at the start's value, without interval."
        )
    said.append(model.held(found.free))
    offsets = [f"{n} {model[n]:+.3g} {model.unit(n)}" for n in (*found.free, *found.own) if n.endswith("effort_offset")]
    if offsets:
        said.append(f"The recorded efforts have offsets, which the file leaves out: {', '.join(offsets)}.")
    return said


def _edge(name: str, fit: OutputErrorFit, intervals: Mapping[str, Interval]) -> str:
    value, (low, high) = fit.model[name], BOUNDS[name]
    if value <= low and low == 0.0:
        most = f", and allow up to {intervals[name].high:.3g} {fit.model.units[name]}" if name in intervals else ""
        return f"{name} is 0 (the data want none of it{most})"
    why = f"the data want {'less' if value <= low else 'more'} than the {low:g} to {high:g} in which it is sought"
    return f"{name} is {value:.3g} {fit.model.units[name]} ({why}; it has no interval)"


def _unresolved(dropped: str, intervals: Mapping[str, Interval], fit: OutputErrorFit) -> str:
    """Return what is known where a torque offset and an angle offset do the same to the motion."""
    model = fit.model
    angles = np.concatenate([piece.recording.position[piece.mask] for piece in fit.pieces])
    cosine = float(np.mean(np.cos(angles)))
    total = model["torque_offset"] + model["gravity"] * cosine * model["angle_offset"]
    kept = "angle_offset" if dropped == "torque_offset" else "torque_offset"
    interval = intervals.get(kept)
    reach = f", though either could hold it (interval {interval.low:.3g} to {interval.high:.3g})" if interval else ""
    return (
        f"torque_offset and angle_offset cannot be told apart: over the angles of this recording both shift the motion "
        f"alike. Known is their sum as a torque, torque_offset + {cosine:.2f} gravity angle_offset = {total:.3g}; the "
        f"fit puts all of it into {kept}{reach}. Larger swings, or an angle known to be hanging, would tell."
    )
