"""What a recording cannot determine, said in plain sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.selection import at_bounds

__all__ = ["Interval", "plain_sentences"]

Array = NDArray[np.float64]


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


def plain_sentences(
    intervals: Mapping[str, Interval],
    names: Sequence[str],
    correlation: Array,
    condition: float,
    weakest: Array,
    profiles: Mapping[str, tuple[float, float]],
    fit: OutputErrorFit,
) -> list[str]:
    """Return what the recording cannot determine, in words.

    Args:
        intervals: By parameter, and for ``natural_frequency``.
        names: Order of the matrix.
        correlation: shape (k, k).
        condition: Condition number of the information matrix.
        weakest: Direction that the data see least, shape (k,).
        profiles: Profile intervals of the weak parameters.
        fit: The fit.
    """
    said = []
    pieces = fit.pieces
    kind = pieces[0].recording.input_kind
    if kind == "none":
        said.append(
            "The pendulum swings freely: only ratios to the inertia can be determined, not the absolute scale of "
            "inertia, gravity and friction; give mass and length, or record a run with a known torque."
        )
    elif kind == "voltage" and "inertia" not in names:
        said.append(
            "The input is a voltage: all torques are per unit of inertia (inertia is set to "
            f"{fit.model['inertia']:g} kg m^2); give mass and length to fix the scale."
        )
    scale = [n for n in ("inertia", "gravity") if n in intervals]
    frequency = intervals.get("natural_frequency")
    if len(scale) == 2 and frequency is not None:
        common = max(intervals[n].relative for n in scale)
        if common > max(3.0 * frequency.relative, 0.02):
            said.append(
                f"The common scale of inertia and gravity is uncertain by +-{100 * common:.0f} %, their ratio is "
                f"firm: w0 = {frequency.value:.3f} rad/s +-{100 * frequency.relative:.1f} %. A torque known "
                "independently, or a known mass and length, would fix the scale."
            )
    delay = intervals.get("transport_delay")
    if delay is not None and delay.high < 0.0:
        said.append(
            f"The input acts {-1e3 * delay.value:.3g} ms before its stamps ({-1e3 * delay.high:.3g} to "
            f"{-1e3 * delay.low:.3g} ms): it was stamped late, by a filter or another clock. That belongs to the "
            "recording, not to the pendulum: a plant file gets no delay from it."
        )
    for name in names:
        interval = intervals[name]
        if interval.relative > 0.3 and name not in {"torque_offset", "angle_offset", "transport_delay"}:
            ends = f"{interval.low:.3g} to {interval.high:.3g}"
            text = f"{name} is weakly determined: {interval.value:.3g}, 95 % interval {ends}"
            if interval.low <= 0.0:
                text += "; the data are compatible with none at all"
            if name in profiles:
                text += f" (profile {profiles[name][0]:.3g} to {profiles[name][1]:.3g})"
            said.append(text + ".")
    said.extend(
        f"{names[j]} and {first} are correlated by {correlation[i, j]:+.3f}: the data determine a "
        "combination of them better than either."
        for i, first in enumerate(names)
        for j in range(i)
        if abs(correlation[i, j]) > 0.95
    )
    if condition > 1e8:
        parts = ", ".join(f"{names[i]} ({weakest[i]:+.2f})" for i in np.argsort(-np.abs(weakest))[:3])
        said.append(
            f"The condition number is {condition:.1e}: there is a direction that the data do not see, made of {parts}."
        )
    said.extend(
        f"{name} ended at the edge of its domain, {fit.model[name]:.3g}: the data want no more of it, and it has "
        "no interval."
        for name in at_bounds(fit.chosen)
    )
    return said
