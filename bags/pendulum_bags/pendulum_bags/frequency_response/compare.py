"""The difference of two measured plants, or of a plant and a model, by frequency, with its significance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array, Complex
from pendulum_bags.distributions import Interval, f_quantile, f_tail
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.gap_metric import DEFAULT_SCALING, SignalScaling, chordal_distance, nu_gap
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_lqr.responses.sampled_response import brought_to
from pendulum_msgs_py.errors import DataError

__all__ = ["SMALLEST", "Difference", "compare_responses", "continuous"]

SMALLEST = 0.1
"""Difference that counts, as a share of the response: 0.9 dB, where a sound design has 6 dB of gain margin. Smaller
ones are often real and never matter: an encoder's steps, or friction under a slightly different motion."""
_LEAST_LINES = 5
_ERROR = 0.05
"""Probability of an error over all lines together."""


@dataclass(frozen=True)
class Difference:
    """The difference of two plants, both at the second one's sampling period.

    Attributes:
        frequency: Shape (n,) [Hz].
        first, second: Responses, shape (outputs, n) [rad/(N m), rad/s/(N m)].
        ratio: Second over first by the (driven joint's) velocity, shape (n,).
        probability: Of at least this difference at a line if the plants differed by at most ``SMALLEST``, shape
            (outputs, n).
        gap: Chordal distance at each frequency, shape (n,).
        gap_high: Its upper joint limit, shape (n,).
        nu_gap: Largest gap with its joint interval; 1 if the winding number condition fails.
        gap_at: Frequency of the largest gap [Hz].
        delay: Of the second's response relative to the first's [s].
        gain: Second's response over the first's, over the octaves [-].
    """

    frequency: Array
    first: Complex
    second: Complex
    ratio: Complex
    probability: Array
    gap: Array
    gap_high: Array
    nu_gap: Interval
    gap_at: float
    delay: Interval
    gain: Interval
    scaling: SignalScaling

    @property
    def found(self) -> bool:
        """Whether any relevant difference was found, with an error of at most 5 % over all lines (Bonferroni)."""
        return bool(self.probability.size * float(self.probability.min()) < _ERROR)

    @property
    def lines_that_differ(self) -> int:
        """Number of lines at which angle or velocity differ."""
        return int(np.sum(np.any(self.probability < _ERROR / self.probability.size, axis=0)))

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        return {
            "frequency_hz": self.frequency.tolist(),
            "gap": self.gap.tolist(),
            "gap_high": self.gap_high.tolist(),
            "nu_gap": [self.nu_gap.value, self.nu_gap.low, self.nu_gap.high],
            "gap_at_hz": self.gap_at,
            "delay_s": [self.delay.value, self.delay.low, self.delay.high],
            "gain": [self.gain.value, self.gain.low, self.gain.high],
            "found": self.found,
            "lines_that_differ": self.lines_that_differ,
            "scaling": self.scaling.to_json(),
        }


def continuous(measured: MeasuredResponse, model: LinearModel) -> Complex:
    """Return a measured response without hold and aliasing, by a model's ratio, shape (outputs, n)."""
    return brought_to(measured.response, model, measured.frequency, measured=measured.period)


def compare_responses(
    first: MeasuredResponse, second: MeasuredResponse, model: LinearModel, scaling: SignalScaling = DEFAULT_SCALING
) -> Difference:
    """Return the difference of simulation and hardware, at the sampling period of the second, or a DataError."""
    lines, one, spread_one, two, spread_two = _at_common_lines(first, second)
    moved = brought_to(one, model, lines, measured=first.period, period=second.period)
    spread_one = spread_one * np.abs(moved / one)
    variance = spread_one**2 + spread_two**2
    # Welch and Satterthwaite: effective degrees of freedom of a sum of two estimated variances.
    freedom = variance**2 / (spread_one**4 / (first.blocks - 1.0) + spread_two**4 / (second.blocks - 1.0))
    excess = np.maximum(np.abs(two - moved) - SMALLEST * np.abs(moved), 0.0)
    probability = f_tail(excess**2 / variance, 2.0, 2.0 * freedom)
    quantile = np.sqrt(f_quantile(1.0 - _ERROR / probability.size, 2.0, 2.0 * freedom))
    moves = second.driven_velocity
    ratio = two[moves] / moved[moves]
    relative = np.sqrt(variance[moves]) / np.abs(moved[moves])
    gap, low, high = _gaps(moved, two, quantile * spread_one, quantile * spread_two, scaling)
    found = nu_gap(scaling.plant(moved), scaling.plant(two))
    at = int(np.argmax(gap))
    whole = Interval(found.value, float(low.max()), float(high.max())) if found.winding else Interval(1.0, 1.0, 1.0)
    return Difference(
        lines, moved, two, ratio, np.asarray(probability, dtype=np.float64), gap, high, whole,
        float(lines[at]), _delay(lines, ratio, relative), _gain(ratio, relative), scaling,
    )  # fmt: skip


def _at_common_lines(first: MeasuredResponse, second: MeasuredResponse) -> tuple[Array, Complex, Array, Complex, Array]:
    apart = np.abs(second.frequency[:, None] - first.frequency[None, :])
    nearest = apart.argmin(axis=1)
    same = apart[np.arange(second.frequency.size), nearest] < 1e-6 * second.frequency
    if same.sum() >= _LEAST_LINES:
        here, there = np.flatnonzero(same), nearest[same]
        return (
            second.frequency[here],
            first.response[:, there],
            first.deviation[:, there],
            second.response[:, here],
            second.deviation[:, here],
        )
    inside = (second.frequency >= first.frequency[0]) & (second.frequency <= first.frequency[-1])
    if inside.sum() < _LEAST_LINES or first.frequency.size < _LEAST_LINES:
        raise DataError(
            f"{first.label} was measured from {first.frequency[0]:.3g} to {first.frequency[-1]:.3g} Hz and "
            f"{second.label} from {second.frequency[0]:.3g} to {second.frequency[-1]:.3g} Hz; expected at least "
            f"{_LEAST_LINES} frequencies in common"
        )
    grid, lines = Machine.of(first), second.frequency[inside]
    response = np.stack([np.interp(lines, grid.frequency, row) for row in grid.response])
    quantile = float(first.radius().flat[0] / first.deviation.flat[0])
    spread = np.stack([np.interp(lines, grid.frequency, row) for row in grid.radius]) / quantile
    return lines, response, spread, second.response[:, inside], second.deviation[:, inside]


def _gaps(first: Complex, second: Complex, a: Array, b: Array, scaling: SignalScaling) -> tuple[Array, Array, Array]:
    one, two = scaling.plant(first), scaling.plant(second)
    gap = chordal_distance(one, two)
    room = np.zeros(gap.size)
    for centre, discs in ((one, np.abs(scaling.plant(a))), (two, np.abs(scaling.plant(b)))):
        spread = np.linalg.norm(discs, axis=0)
        nearest = np.maximum(np.linalg.norm(centre, axis=0) - spread, 0.0)
        room += np.arcsin(np.minimum(spread / np.sqrt(1.0 + nearest**2), 1.0))
    angle = np.arcsin(np.clip(gap, 0.0, 1.0))
    low, high = np.maximum(angle - room, 0.0), np.minimum(angle + room, np.pi / 2.0)
    return gap, np.sin(low), np.sin(high)


def _delay(lines: Array, ratio: Complex, relative: Array) -> Interval:
    found = _slope(2.0 * np.pi * lines, np.unwrap(np.angle(ratio)), relative)
    return Interval(-found.value, -found.high, -found.low)


def _gain(ratio: Complex, relative: Array) -> Interval:
    found = _slope(np.ones(ratio.size), np.log(np.abs(ratio)), relative)
    return Interval(float(np.exp(found.value)), float(np.exp(found.low)), float(np.exp(found.high)))


def _slope(x: Array, y: Array, deviation: Array) -> Interval:
    """Return the slope of y over x through 0, weighted by ``deviation``; unmodelled dynamics widen its interval."""
    weight = 1.0 / np.maximum(deviation, 1e-6) ** 2
    slope = float(np.sum(weight * x * y) / np.sum(weight * x**2))
    misfit = max(1.0, float(np.sum(weight * (y - slope * x) ** 2)) / max(1, x.size - 1))
    half = 1.96 * np.sqrt(misfit / float(np.sum(weight * x**2)))
    return Interval(slope, slope - half, slope + half)
