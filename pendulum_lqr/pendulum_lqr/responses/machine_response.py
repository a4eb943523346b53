"""A measured machine on a dense grid of frequencies: between its lines, and below the lowest.

The plant is smooth between lines, but a lightly damped closed loop is not: so the plant is interpolated, and loops are
computed from that. One joint is interpolated by its inverse, (-stiffness + inertia, damping times frequency), which is
nearly polynomial. Outputs of several joints have zeros, so the ratio to a model's response is interpolated instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_lqr.responses.sampled_response import model_response

__all__ = ["LEAST_DAMPING", "Machine"]

LEAST_DAMPING = 0.001
"""Damping ratio of the sharpest resonance considered between lines; a steel frame has 0.001 to 0.005."""

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BELOW = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
"""Frequencies of the extrapolation below the lowest line, relative to it."""
_NEARLY_ZERO = 0.01
"""The lowest of these for several joints: a plant that can roll away has no response at 0."""
_FIT_UP_TO = 4.0
"""Lines up to this multiple of the lowest are used for the extrapolation."""
_LEAST_FIT = 4
_NEAR_NYQUIST = 0.9
"""Share of the Nyquist frequency above which the highest line counts as reaching it."""
_RATIO = 1.012
"""Largest ratio of neighbouring grid frequencies."""
_NARROW = 0.25
"""Largest relative distance of lines between which resonances are considered: smooth plants bend over larger ones."""
_LEFT_OUT = 0.25
"""Share of the leave-one-out error assumed between lines, at half the distance: a cubic spline errs by its fourth
power, so a sixteenth would suffice for a smooth plant.
"""


@dataclass(frozen=True)
class Machine:
    """A measured plant on a dense grid.

    Attributes:
        frequency: Shape (n,), from 0 [Hz], or of several joints from nearly 0.
        response: Sampled plant from torque to angle and velocity, shape (outputs, n).
        radius: Radius of the joint confidence discs, including interpolation, shape (outputs, n).
        period: Sampling period [s].
        lowest: Lowest measured line [Hz].
        confidence: Of the discs.
        ringing: Possible contribution of a resonance of the least damping between two lines: visible as deviation of
            these lines from a smooth plant in opposite directions, and hidden by their error, shape (2, outputs, n).
            Its peak in the middle is that deviation times half the distance of the lines over damping times frequency.
    """

    frequency: Array
    response: Complex
    radius: Array
    period: float
    lowest: float
    confidence: float = 0.95
    ringing: Array | None = None

    @property
    def up_to_nyquist(self) -> bool:
        """Whether the highest line is so near the Nyquist frequency that little can happen beyond it."""
        return 2.0 * self.period * float(self.frequency[-1]) >= _NEAR_NYQUIST

    @classmethod
    def of(cls, measured: MeasuredResponse) -> Machine:
        """Return the machine of a measurement of one joint."""
        radius = measured.radius()
        lines = measured.frequency
        inside, response, discs, apart = _between(measured, radius)
        ringing = _ringing(lines, apart, measured.response, radius, inside)
        low = lines[0] * _BELOW
        near = np.flatnonzero(lines <= _FIT_UP_TO * lines[0])
        if near.size < _LEAST_FIT:
            near = np.arange(min(_LEAST_FIT, lines.size))
        inverse = 1.0 / measured.response[0, near]
        spread = radius[0, near] / np.abs(measured.response[0, near]) ** 2
        omega = 2.0 * np.pi * low
        below = _continued(2.0 * np.pi * lines[near], inverse, spread, omega)
        if below is not None:
            values, error = below
            angle = 1.0 / values
            disc, hold = error * np.abs(angle) ** 2, omega * measured.period * np.abs(angle)
            inside = np.concatenate([low, inside])
            # At low frequency the measured velocity is the derivative of the angle, except for the hold.
            response = np.hstack([np.vstack([angle, 1j * omega * angle]), response])
            discs = np.hstack([np.vstack([disc, omega * (disc + hold)]), discs])
            ringing = np.concatenate([np.zeros((*ringing.shape[:2], low.size)), ringing], axis=2)
        return cls(inside, response, discs, measured.period, float(lines[0]), ringing=ringing)

    @classmethod
    def relative_to(cls, measured: MeasuredResponse, model: LinearModel) -> Machine:
        """Return the machine of several joints, interpolated relative to a model with the same outputs."""
        lines, period = measured.frequency, measured.period
        own = model_response(model, lines, period)
        ratio, spread = measured.response / own, measured.radius() / np.abs(own)
        below = lines[0] * np.concatenate([[_NEARLY_ZERO], _BELOW[1:]])
        whole = np.concatenate([below, _grid(lines)])
        on_line = np.isin(whole, lines)
        # The response at -f is the conjugate of that at f: there are lines on both sides of 0.
        mirrored = np.concatenate([-lines[::-1], lines])
        # Largest effect of errors within these radii on the spline.
        weights = np.abs(scipy.interpolate.CubicSpline(mirrored, np.eye(mirrored.size))(whole))
        # Near 0, where friction matters, half the distance does not reduce the error as much.
        near_zero = np.where(whole < lines[1], 1.0 / _LEFT_OUT, 1.0)
        rows, discs, errors = [], [], []
        for curve, radius in zip(ratio, spread, strict=True):
            values, error = _splined(mirrored, np.concatenate([np.conj(curve[::-1]), curve]), whole)
            between = np.abs(values) * near_zero * _larger_neighbour(mirrored, _LEFT_OUT * np.abs(error), whole)
            disc = weights @ np.concatenate([radius[::-1], radius]) + np.where(on_line, 0.0, between)
            values[on_line], disc[on_line] = curve, radius
            rows.append(values)
            discs.append(disc)
            errors.append(error[lines.size :])
        on_grid = model_response(model, whole, period)
        ringing = _ringing(lines, np.array([errors]), measured.response, measured.radius(), whole)
        return cls(
            whole, np.array(rows) * on_grid, np.array(discs) * np.abs(on_grid), period, float(lines[0]), ringing=ringing
        )


def _ringing(lines: Array, error: Complex, response: Complex, radius: Array, grid: Array) -> Array:
    """Return :attr:`Machine.ringing` from relative leave-one-out errors, computed in one or several ways."""
    if lines.size < 2:
        return np.zeros((2, *response.shape[:1], grid.size))
    right = np.clip(np.searchsorted(lines, grid, side="left"), 1, lines.size - 1)
    a, b = lines[right - 1], lines[right]
    peak = np.where((b - a <= _NARROW * a) & (grid >= lines[0]), 0.5 * (b - a) / np.sqrt(a * b) / LEAST_DAMPING, 0.0)
    # A resonance moves neighbouring lines in opposite directions, a smooth bend in one. A line and the spline through
    # the others both have errors.
    size = 0.5 * (np.abs(response[:, right]) + np.abs(response[:, right - 1]))
    apart = 0.5 * np.min(np.abs(error[..., right] - error[..., right - 1]), axis=0) * size
    noise = np.array([_larger_neighbour(lines, row, grid) for row in radius])
    return peak * np.array([np.maximum(apart - 2.0 * noise, 0.0), noise])


def _between(measured: MeasuredResponse, radius: Array) -> tuple[Array, Complex, Array, Complex]:
    """Return grid, response and discs between lowest and highest line, and relative leave-one-out errors (ways, 2, n).

    The errors are those of the response itself, and without the phase of its delay.
    """
    lines = measured.frequency
    if lines.size < 5:
        return lines, measured.response, radius, np.zeros_like(measured.response)[None]
    grid = _grid(lines)
    inverse = 1.0 / measured.response[0]
    ratio = measured.response[1] / measured.response[0]
    relative = radius / np.abs(measured.response)
    values, errors = [], []
    for curve in (inverse, ratio):
        spline, error = _splined(lines, curve, grid)
        values.append(spline)
        errors.append(error)
    # A delay rotates the response from line to line, which a spline cannot follow; a resonance shows either way.
    slope = np.diff(np.unwrap(np.angle(inverse))) / np.diff(lines)
    turn = np.exp(-1j * lines * np.median(slope[slope.size // 2 :]))
    still = _splined(lines, inverse * turn, lines)[1]
    on_line = np.isin(grid, lines)
    angle = 1.0 / values[0]
    response = np.vstack([angle, values[1] * angle])
    bend = [_larger_neighbour(lines, _LEFT_OUT * np.abs(error), grid) for error in errors]
    share = np.vstack([bend[0], bend[0] + bend[1]])
    noise = np.vstack([_larger_neighbour(lines, row, grid) for row in relative])
    discs = np.abs(response) * (noise + np.where(on_line, 0.0, share))
    response[:, on_line], discs[:, on_line] = measured.response, radius
    return grid, response, discs, np.array([[-one, errors[1] - one] for one in (errors[0], still)])


def _grid(lines: Array) -> Array:
    """Return the dense grid between lowest and highest line, including the lines."""
    pieces = [
        np.geomspace(a, b, max(2, int(np.ceil(np.log(b / a) / np.log(_RATIO))) + 1))[:-1] for a, b in pairwise(lines)
    ]
    return np.concatenate([*pieces, lines[-1:]])


def _splined(lines: Array, curve: Complex, grid: Array) -> tuple[Complex, Complex]:
    """Return a curve on the grid, and the relative leave-one-out error of each line, shape (lines,).

    Mirrored lines are left out with their image, which is no measurement of its own.
    """
    left_out = np.zeros(lines.size, dtype=np.complex128)
    for i in range(1, lines.size - 1):
        others = np.flatnonzero(np.abs(lines) != abs(lines[i]))
        left_out[i] = scipy.interpolate.CubicSpline(lines[others], curve[others])(lines[i]) / curve[i] - 1.0
    left_out[0], left_out[-1] = left_out[1], left_out[-2]
    return np.asarray(scipy.interpolate.CubicSpline(lines, curve)(grid)), left_out


def _larger_neighbour(lines: Array, values: Array, grid: Array) -> Array:
    """Return at each point the larger of the values at the neighbouring lines."""
    right = np.clip(np.searchsorted(lines, grid, side="left"), 1, lines.size - 1)
    return np.asarray(np.maximum(values[right - 1], values[right]), dtype=np.float64)


def _continued(x: Array, inverse: Complex, spread: Array, wanted: Array) -> tuple[Complex, Array] | None:
    """Extrapolate 1/P = (k + m w^2) + j w (b + c w^2) towards 0 by weighted least squares; values and error radii."""
    if x.size < 3:
        return None
    weight = 1.0 / np.maximum(spread, 1e-9 * float(np.abs(inverse).max()))
    even, odd = np.stack([np.ones_like(x), x**2], axis=1), np.stack([x, x**3], axis=1)
    target_even, target_odd = (
        np.stack([np.ones_like(wanted), wanted**2], axis=1),
        np.stack([wanted, wanted**3], axis=1),
    )
    values = np.zeros(wanted.size, dtype=np.complex128)
    error = np.zeros(wanted.size)
    for design, target, part, unit in ((even, target_even, inverse.real, 1.0), (odd, target_odd, inverse.imag, 1j)):
        scaled = design * weight[:, None]
        solver = np.linalg.pinv(scaled)
        coefficients = solver @ (part * weight)
        misfit = float(np.sqrt(np.mean((scaled @ coefficients - part * weight) ** 2)))
        values += unit * (target @ coefficients)
        # Errors from the discs of the lines, increased by the misfit if larger.
        error += np.linalg.norm(target @ solver, axis=1) * max(1.0, misfit)
    return values, error
