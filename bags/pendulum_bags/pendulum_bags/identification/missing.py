"""What torque is missing: does what the fit leaves over look like a torque that no candidate model has?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import student_quantile
from pendulum_bags.identification.model import TORQUES, FitModel
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.starts import bumps
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES

__all__ = ["missing_torques"]

_LEVEL = 0.01


def missing_torques(
    model: FitModel, pieces: Sequence[Piece], parts: Sequence[Array], free: Sequence[str] = ()
) -> list[str]:
    """Return in words the torques that the residuals show, such as drag by the square of speed; none for noise.

    To first order a residual r, simulated minus measured [rad], obeys J r'' + b r' + G cos(th) r = (missing torque).
    Its left side comes from the same modulating functions as the starts. It is regressed on torques that a pendulum may
    have and the fit of ``free`` parameters has not, next to those that it has; sums over blocks longer than the filter
    judge them, at 1 % over all. Noise of the sensor and torques that have nothing to do with the motion show none.

    Source:
        Engle, Wald, likelihood ratio, and Lagrange multiplier tests in econometrics, Handbook of Econometrics 2, 1984
        (test of an added term on the residuals of the fit without it).
    """
    left: list[Array] = []
    known: list[Array] = []
    added: list[Array] = []
    for piece, part in zip(pieces, parts, strict=True):
        rows = _rows(model, piece, part, free)
        for own, every in zip(rows, (left, known, added), strict=True):
            every.extend(own)
    if not left:
        return []
    response, nuisance = np.concatenate(left), np.concatenate(known)
    candidates = np.concatenate(added)
    size = np.linalg.norm(nuisance, axis=0)
    nuisance = nuisance[:, size > 0.0] / size[size > 0.0]
    basis, singular, _ = np.linalg.svd(nuisance, full_matrices=False)
    basis = basis[:, singular > 1e-6 * singular[0]]
    response = response - basis @ (basis.T @ response)
    found = []
    for words, index in _COLUMNS.items():
        terms = candidates[:, index]
        rest = terms - basis @ (basis.T @ terms)
        if np.linalg.norm(rest) < 0.02 * np.linalg.norm(terms) or not np.any(terms):
            # The motion cannot tell it from what the model has.
            continue
        # Of two amplitudes the combination that explains most: to be as rare by luck as one, it needs a stricter level.
        product = rest @ np.linalg.lstsq(rest, response, rcond=None)[0] * response
        tests = len(_COLUMNS) * len(index) ** 2
        start, sums = 0, []
        for one in left:
            edges = np.arange(0, one.size, max(1, one.size // 5))
            sums.append(np.add.reduceat(product[start : start + one.size], edges))
            start += one.size
        values = np.concatenate(sums)
        # Each block leaves out its own mean when the spread is taken, or a large dependence would hide itself.
        spread = float(np.std(values, ddof=1) * np.sqrt(values.size)) if values.size > 5 else np.inf
        if spread > 0.0 and abs(values.sum()) / spread > student_quantile(
            1.0 - 0.5 * _LEVEL / tests, max(values.size - 1, 1)
        ):
            found.append(words)
    return found


_COLUMNS = {
    **dict(zip(TORQUES, ([0], [1, 2], [3, 4]), strict=True)),
    "a friction that differs by direction": [5],
    "a spring that goes on with the angle": [6],
    "a gain that changes with the angle": [7],
    "a gain that changes with the input (saturation)": [8],
    "a drive that fades with speed": [9],
}
"""Columns of each torque, in words; the first ones are fitted where held-out windows ask for them."""

_FILTER = 0.1
"""Length of the modulating functions [s]."""


def _rows(
    model: FitModel, piece: Piece, part: Array, free: Sequence[str]
) -> tuple[list[Array], list[Array], list[Array]]:
    recording = piece.recording
    period = recording.period
    count = max(7, round(_FILTER / period) | 1)
    flat, first, second = bumps(count, period)
    stamps = recording.input_stamps
    if recording.hold == "linear":
        drive = np.interp(recording.time - model["transport_delay"], stamps, recording.input)
    else:
        at = np.searchsorted(stamps, recording.time - model["transport_delay"] + 1e-9, side="right") - 1
        drive = recording.input[np.clip(at, 0, stamps.size - 1)]
    left, known, added = [], [], []
    for begin, stop in piece.windows:
        if stop - begin < 3 * count:
            continue
        residual = part[begin:stop]
        angle = residual + recording.position[begin:stop] - model["angle_offset"]
        speed = np.gradient(angle, recording.time[begin:stop])
        u = drive[begin:stop]

        def smooth(values: Array, kernel: Array = flat) -> Array:
            return np.convolve(values, kernel, mode="valid")

        response = (
            model["inertia"] * smooth(residual, second)
            + model["damping"] * smooth(residual, first)
            + smooth(model["gravity"] * np.cos(angle) * residual)
        )
        direction = np.tanh(speed / 0.05)
        gravity = np.sin(angle)
        left.append(response)
        own = (
            np.ones_like(u),
            gravity,
            np.cos(angle),
            speed,
            direction,
            u,
            np.gradient(u),
            np.abs(gravity) * direction,
        )
        torques = (speed * np.abs(speed), *(f(k * angle) for k in (2.0, 3.0) for f in (np.cos, np.sin)))
        fitted = [values for name, values in zip(JOINT_TORQUES, torques, strict=True) if name in free]
        known.append(np.stack([*map(smooth, (*own, *fitted)), smooth(angle, second)], axis=1))
        others = (
            *torques,
            np.abs(speed),
            angle,
            u * np.cos(angle),
            u * np.abs(u),
            u * np.abs(speed),
        )
        added.append(np.stack([smooth(term) for term in others], axis=1))
    return left, known, added
