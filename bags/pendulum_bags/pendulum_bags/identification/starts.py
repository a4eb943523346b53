"""Where output-error searches begin: several starts, so that a poor one does not decide.

An equation-error estimate (filtered regression) gives the order of magnitude; it is biased by noise, delay and
friction, so starts spread around it in inertia, sign and delay, and a short search on few windows ranks them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, stretches_between_gaps
from pendulum_bags.identification.solver import Solution, solve
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError

__all__ = ["bumps", "equation_error", "equation_residual", "first_models", "rank"]

_BUMP = 0.2
"""Length of the modulating functions [s]."""

_CONSTANT = 0.1
"""Spread of an input, as a share of its mean, below which it is taken as constant."""


def equation_error(recording: Recording, *, window: float = _BUMP) -> Array:
    """Return least-squares (J, b, c, G, offset) of J th'' + b th' + c sgn th' + G sin th - offset = u, shape (5,).

    Both sides are multiplied by a bump of length ``window`` [s] that vanishes with its derivatives at both ends and
    integrated by parts: no signal is differentiated. Units are those of the input, or per unit of inertia without one.

    Source:
        Shinbrot, Trans. ASME 79, 1957; Preisig and Rippin, Computers chem. Engng 17, 1993 (modulating functions).
    """
    columns, drive = _filtered_equation(recording, window)
    columns = columns[:, :5]
    if recording.input_kind == "none":
        # Nothing drives it: the equation holds per unit of inertia.
        rest = np.linalg.lstsq(columns[:, 1:], -columns[:, 0], rcond=None)[0]
        return np.concatenate(([1.0], rest))
    if np.std(drive) < _CONSTANT * abs(np.mean(drive)):
        # An offset, or a dry friction in one direction, would explain such an input without inertia and weight.
        inertia, damping, gravity = np.linalg.lstsq(columns[:, (0, 1, 3)], drive, rcond=None)[0]
        return np.array([inertia, damping, 0.0, gravity, 0.0])
    return np.asarray(np.linalg.lstsq(columns, drive, rcond=None)[0], np.float64)


def equation_residual(recording: Recording) -> tuple[float, float]:
    """Return what :func:`equation_error` leaves over with any zero of the angle, and where that zero lies [rad].

    The rest is rms over rms, of the filtered input or, in a free swing, of the filtered acceleration.
    """
    columns, drive = _filtered_equation(recording, _BUMP)
    if recording.input_kind == "none":
        columns, drive = columns[:, 1:], -columns[:, 0]
    found = np.linalg.lstsq(columns, drive, rcond=None)[0]
    rest = drive - columns @ found
    # G sin(theta - zero) = G cos(zero) sin(theta) - G sin(zero) cos(theta), all of the sign of the inertia.
    sine, cosine = found[-3], found[-1]
    sign = 1.0 if recording.input_kind == "none" or found[0] >= 0.0 else -1.0
    return float(np.std(rest) / max(float(np.std(drive)), 1e-300)), math.atan2(-sign * cosine, sign * sine)


def _filtered_equation(recording: Recording, window: float) -> tuple[Array, Array]:
    """Return the regressors of J, b, c, G, the offset and the cosine, shape (n, 6), and the input, filtered.

    Of the longest stretch without a gap: a filter that reaches across one knows nothing of the time in it.
    """
    recording = recording.rows(*max(stretches_between_gaps(recording), key=lambda pair: pair[1] - pair[0]))
    time, theta = recording.time, recording.position
    stamps = recording.input_stamps
    drive = recording.input if stamps is time else np.interp(time, stamps, recording.input)
    period = recording.period
    count = max(7, round(window / period) | 1)
    if count >= time.size:
        raise DataError(f"{recording.name} lasts {recording.duration:.3g} s; expected more than {window} s")
    bump, bump_1, bump_2 = bumps(count, period)

    def filtered(values: Array, kernel: Array) -> Array:
        return np.convolve(values, kernel, mode="valid")

    smooth = np.convolve(np.pad(theta, count // 2, mode="edge"), bump, mode="valid")
    direction = np.tanh(np.gradient(smooth, time) / 0.1)
    columns = (
        filtered(theta, bump_2),
        filtered(theta, bump_1),
        filtered(direction, bump),
        filtered(np.sin(theta), bump),
        -np.ones(time.size - count + 1),
        filtered(np.cos(theta), bump),
    )
    return np.stack(columns, axis=1), filtered(drive, bump)


def bumps(count: int, period: float) -> tuple[Array, Array, Array]:
    """Return a bump (1 - x^2)^4 of unit sum and its first and second derivatives, shape (count,) [1, 1/s, 1/s^2]."""
    x = np.linspace(-1.0, 1.0, count + 2)[1:-1]
    rise = 1.0 - x * x
    slope = 2.0 / ((count + 1) * period)
    total = np.sum(rise**4)
    first = -8.0 * x * rise**3 * slope / total
    second = (48.0 * x * x * rise**2 - 8.0 * rise**3) * slope**2 / total
    return rise**4 / total, first, second


def first_models(recording: Recording, fixed: FitModel, free: Sequence[str], *, spread: bool = True) -> list[FitModel]:
    """Return start models around the equation-error estimate of the longest recording, one unless ``spread``."""
    period = recording.period
    delays = (0.0, period, 2.0 * period) if spread and "transport_delay" in free else (0.0,)
    if fixed.input_kind == "position_goal":
        return _servo_models(fixed, delays, spread)
    models: list[FitModel] = []
    for window in (0.2, 0.4) if spread else (0.3,):
        estimate = equation_error(recording, window=min(window, 0.2 * recording.duration))
        models += _around(estimate, recording, fixed, free, delays, spread)
    return models


def _around(
    estimate: Array, recording: Recording, fixed: FitModel, free: Sequence[str], delays: Sequence[float], spread: bool
) -> list[FitModel]:
    inertia, damping, coulomb, gravity, _ = map(float, estimate)
    sign = -1.0 if gravity < 0.0 and inertia < 0.0 else 1.0
    # At standstill or in noise the estimate may be nonsense: the input's torque gives the order of magnitude.
    torque = float(np.std(recording.input) or np.max(np.abs(recording.input))) or 1.0
    inertia = max(abs(inertia), 1e-3 * torque)
    gravity = max(abs(gravity), 1e-2 * torque)
    damping, coulomb = max(sign * damping, 0.0), max(sign * coulomb, 0.0)
    scale = 1.0
    if "input_gain" in free or recording.input_kind == "none":
        # The scale is fixed elsewhere: by a normalised inertia, or by a known gravity torque.
        scale = fixed["gravity"] / gravity if "gravity" not in free else fixed["inertia"] / inertia
    models = []
    for flip in (sign, -sign) if spread and recording.input_kind != "none" else (sign,):
        # Feedback through the input biases the scale low; the ratio G / J is firm, so both move together.
        for factor in (1.0, 2.5, 8.0) if spread else (1.0,):
            for delay in delays:
                scaled = 1.0 if "input_gain" in free else factor
                guess = {
                    "inertia": scaled * inertia * scale,
                    "damping": damping * scale,
                    "gravity": scaled * gravity * scale,
                    "coulomb_friction": max(coulomb, 1e-3 * gravity) * scale,
                    "transport_delay": delay,
                    "input_gain": flip * scale / (factor if "input_gain" in free else 1.0),
                }
                values = {**fixed.values, **{name: guess[name] for name in guess if name in free}}
                if "input_gain" not in free:
                    values["input_gain"] = flip * abs(fixed["input_gain"])
                models.append(replace(fixed, values=values, friction="coulomb"))
    return models


def _servo_models(fixed: FitModel, delays: Sequence[float], spread: bool) -> list[FitModel]:
    # A servo at its set point holds gravity with a fraction of its duty: gain and inertia follow from that.
    gravity = fixed["gravity"]
    models = []
    for gain in (0.2, 0.4, 0.8) if spread else (0.3,):
        for share in (1.3, 2.0) if spread else (1.5,):
            for delay in delays[:2]:
                values = {
                    **fixed.values,
                    "inertia": share * fixed["inertia"],
                    "damping": 0.02 * gravity,
                    "drive_damping": 0.05 * gravity,
                    "coulomb_friction": 0.02 * gravity,
                    "input_gain": gain * gravity,
                    "transport_delay": delay,
                }
                models.append(replace(fixed, values=values, friction="coulomb"))
    return models


def rank(
    models: Sequence[FitModel], pieces: Sequence[Piece], free: Sequence[str], *, keep: int = 3, scale: float = 0.3
) -> list[Solution]:
    """Return the ``keep`` most promising starts after a short search on some of the windows, best first."""
    total = sum(len(piece.windows) for piece in pieces)
    stride = max(1, total // 24)
    few = [piece.subset(range(0, len(piece.windows), stride)) for piece in pieces]
    trials = [solve(model, few, free, scale=scale, max_iterations=15, tolerance=1e-4, coarse=3.0) for model in models]
    trials.sort(key=lambda solution: solution.cost if np.isfinite(solution.cost) else np.inf)
    chosen: list[Solution] = []
    for trial in trials:
        # Starts that ran into the same valley count once.
        if any(np.isclose(trial.cost, other.cost, rtol=1e-3) for other in chosen):
            continue
        chosen.append(trial)
        if len(chosen) == keep:
            break
    return chosen or trials[:1]
