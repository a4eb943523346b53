"""What a motion says of its columns: which is the derivative of which, in what unit, and where an angle hangs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.clock import longest_step
from pendulum_bags.recordings.units import UNITS

__all__ = ["ALIKE", "FASTEST", "Balance", "Slope", "balance_of", "derivative", "moves", "turn_of", "units_by_slope"]

ALIKE = 0.9
"""Correlation from which on one column is the derivative of another, whatever its unit."""
FASTEST = 300.0
"""Speed that no pendulum on a drive reaches [rad/s]."""
_STRIDE = 0.1
"""Over stretches as long the quantisation of an angle and the noise of a velocity average out [s]."""
_CLOSE = 0.3
"""Largest relative distance of a slope from that of two units that are taken for them."""
_WINDOW = 0.2
"""Length of the test functions of the equation of motion [s]."""
_LEAST_EXPLAINED = 0.5


class Slope(NamedTuple):
    """Integrated velocity against travelled position: slope (1 in consistent units) and correlation (``alike``)."""

    slope: float
    alike: float


def derivative(time: Array, position: Array, velocity: Array) -> Slope:
    """Return how a column compares with the derivative of another; 0 where nothing moves."""
    step = np.diff(time)
    integrated = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * step)))
    taken = slice(None, None, max(1, round(_STRIDE / float(np.median(step)))))
    passed = np.concatenate(([0], np.cumsum(step > longest_step(time))))
    whole = np.diff(passed[taken]) == 0
    moved, expected = np.diff(position[taken])[whole], np.diff(integrated[taken])[whole]
    power = float(moved @ moved)
    if not power > 0.0:
        return Slope(0.0, 0.0)
    product = float(expected @ moved)
    return Slope(product / power, product / max(math.sqrt(power * float(expected @ expected)), 1e-300))


def moves(values: Array) -> bool:
    """Return whether a column has more than one value."""
    known = values[np.isfinite(values)]
    return bool(known.size and np.ptp(known) > 1e-9 * max(1.0, float(np.abs(known).max())))


def turn_of(values: Array) -> float:
    """Return the size of the jumps of an angle that is wrapped, 0 where it has none."""
    steps = np.abs(np.diff(values))
    span = float(np.ptp(values)) if values.size else 0.0
    far = steps[steps > 0.8 * span]
    ordinary = float(np.quantile(steps, 0.9)) if steps.size else 0.0
    return float(np.median(far)) if far.size and float(far.min()) > 4.0 * max(ordinary, 1e-12) else 0.0


def units_by_slope(slope: float, position: str, velocity: str) -> list[tuple[str, str, int]]:
    """Return the units of position and velocity, and the velocity's sign, that a slope allows; empty is not known."""
    sliding = position in UNITS["place"] or velocity in UNITS["speed"]
    places, speeds = ("place", "speed") if sliding else ("angle", "velocity")
    found = []
    for one, size in UNITS[places].items():
        for other, rate in UNITS[speeds].items():
            if position not in {"", one} or velocity not in {"", other}:
                continue
            expected = size / rate
            distance = abs(math.log(abs(slope) / expected)) if slope else math.inf
            if distance < _CLOSE:
                found.append((distance, (one, other, 1 if slope > 0.0 else -1)))
    return [units for _, units in sorted(found, key=lambda one: round(one[0], 1))]


class Balance(NamedTuple):
    """The pull of gravity in q'' = pull sin q + damping q' + gain u + rest, by least squares.

    Attributes:
        pull: Negative where the angle is 0 hanging down, positive where it is 0 upright [1/s^2].
        t: Of it, Student's.
        explained: Share of the variance of q'' that is explained.
        longer: The pull by test functions twice as long: that of gravity is the same, that of noise a quarter [1/s^2].
    """

    pull: float
    t: float
    explained: float
    longer: float = 0.0

    @property
    def hangs_at(self) -> str:
        """``0`` or ``pi``, by where the pull is restoring; empty where the motion does not say."""
        if abs(self.t) < 5.0 or self.explained < _LEAST_EXPLAINED or not 0.5 < self.longer / self.pull < 2.0:
            return ""
        return "0" if self.pull < 0.0 else "pi"


def balance_of(
    time: Array, angle: Array, drives: Sequence[tuple[Array, Array]], others: Sequence[Array] = ()
) -> Balance | None:
    """Return the balance of a motion; None for one too short.

    No signal is differentiated: the equation is integrated with test functions of a fifth of a second (modulating
    functions; Shinbrot, Trans. ASME 79, 1957).

    Args:
        time: Stamps, shape (n,) [s].
        angle: Unwrapped, shape (n,) [rad].
        drives: Stamps [s] and values of each input.
        others: Positions of the other joints, whose accelerations pull at this one, each of shape (n,).
    """
    found = _balance_of(time, angle, drives, others, _WINDOW)
    longer = found and _balance_of(time, angle, drives, others, 2.0 * _WINDOW)
    return found and found._replace(longer=longer.pull if longer else 0.0)


def _balance_of(
    time: Array, angle: Array, drives: Sequence[tuple[Array, Array]], others: Sequence[Array], window: float
) -> Balance | None:
    period = float(np.median(np.diff(time)))
    length = max(round(window / period), round(10 * window / _WINDOW))
    count = int((time[-1] - time[0]) / period) + 1
    if count < 8 * length or count > 5_000_000:
        return None
    even = time[0] + period * np.arange(count)
    x = np.linspace(0.0, 1.0, length + 1)
    bump = (x * (1.0 - x)) ** 3
    width = period * length
    first = np.gradient(bump, x) / width
    second = np.gradient(np.gradient(bump, x), x) / width**2
    starts = np.arange(0, count - length, max(length // 2, 1))
    stamps = np.searchsorted(time, even[starts + length]) - np.searchsorted(time, even[starts])
    starts = starts[stamps > 0.5 * length]  # no window across a gap
    if starts.size < 12:
        return None
    rows = starts[:, None] + np.arange(length + 1)
    q = np.interp(even, time, angle)

    def weighed(values: Array, by: NDArray[Any]) -> Array:
        return np.asarray(values[rows] @ by)

    columns = [weighed(np.sin(q), bump), -weighed(q - q.mean(), first), np.full(starts.size, bump.sum())]
    for other in others:
        x = np.asarray(np.interp(even, time, other), dtype=float)
        columns += [weighed(x - x.mean(), by) for by in (first, second)]
    for stamp, values in drives:
        columns.append(weighed(np.asarray(np.interp(even, stamp, values), dtype=float), bump))
    a, y = np.stack(columns, axis=1), weighed(q - q.mean(), second)
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    solution, _, rank, _ = np.linalg.lstsq(a / scale, y, rcond=1e-8)
    if rank < a.shape[1]:
        return None
    left = y - (a / scale) @ solution
    freedom = max(0.5 * starts.size - a.shape[1], 1.0)  # half of each window is in the next one
    errors = np.sqrt(np.diag(np.linalg.inv((a / scale).T @ (a / scale))) * float(left @ left) / freedom)
    explained = 1.0 - float(left @ left) / max(float((y - y.mean()) @ (y - y.mean())), 1e-300)
    return Balance(float(solution[0] / scale[0]), float(solution[0] / max(errors[0], 1e-300)), explained)
