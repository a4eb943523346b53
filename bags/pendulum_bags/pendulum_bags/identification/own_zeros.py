"""Several recordings in one fit, each with a zero of its own: homing or a torque sensor's tare moves between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, prepare
from pendulum_bags.identification.selection import effective_samples
from pendulum_bags.identification.solver import Solution, residuals, solve
from pendulum_bags.runs.datasets import Recording

__all__ = ["OwnZeros", "align"]

ROUNDS = 10
"""Zeros and parameters are found in turn, at most so often."""

SETTLED = 2e-5
"""Change of the zeros [rad, or unit of the torques] that ends the rounds."""


@dataclass(frozen=True)
class OwnZeros:
    """Zeros of the recordings beside their mean.

    Args:
        name: ``angle_offset`` [rad] or ``torque_offset`` [unit of the torques].
        values: By recording, sum 0, shape (n,).
    """

    name: str
    values: Array


def align(
    found: Solution,
    pieces: Sequence[Piece],
    free: Sequence[str],
    window: float | None,
    scale: float,
    *,
    coarse: float,
) -> tuple[Solution, list[Piece], OwnZeros | None]:
    """Return the fit and the recordings with their zeros moved onto each other, where the data ask for it.

    Asked for is what Schwarz's criterion on effective samples pays for: one more parameter for each recording but one.
    Their errors are in no interval; those of the common offset are.

    Args:
        found: Fit with common offsets.
        pieces: Recordings, cut.
        free: Fitted parameters.
        window: Length of the windows [s].
        scale: Of the robust loss [rad].
        coarse: Factor on the integration step.
    """
    kept = list(pieces)
    # A servo compares its set point with the same encoder: another zero there is another set point.
    if len(pieces) < 2 or found.model.input_kind == "position_goal":
        return found, kept, None
    best: tuple[Solution, list[Piece], OwnZeros] | None = None
    for name in ("angle_offset", "torque_offset"):
        if name not in free:
            continue
        solution, moved, total = found, kept, np.zeros(len(pieces))
        for _ in range(ROUNDS):
            single = [
                solve(
                    solution.model,
                    [piece],
                    (name,),
                    states=[state],
                    scale=scale,
                    tolerance=1e-5,
                    coarse=coarse,
                )
                for piece, state in zip(moved, solution.states, strict=True)
            ]
            own = np.array([one.model[name] for one in single])
            own -= own.mean()
            total += own
            moved = [
                prepare(_moved(piece.recording, name, float(value), solution.model), window)
                for piece, value in zip(moved, own, strict=True)
            ]
            states = [
                one.states[0] - np.array([value, 0.0]) * (name == "angle_offset")
                for one, value in zip(single, own, strict=True)
            ]
            solution = solve(solution.model, moved, free, states=states, scale=scale, tolerance=1e-6, coarse=coarse)
            if float(np.max(np.abs(own))) < SETTLED:
                break
        if best is None or solution.cost < best[0].cost:
            best = solution, moved, OwnZeros(name, total)
    if best is None:
        return found, kept, None
    solution, moved, zeros = best
    count = effective_samples(residuals(solution.model, moved, solution.states), moved)
    gain = count * float(np.log(found.cost / max(solution.cost, 1e-300)))
    if gain < max(np.log(count), 2.0) * 2.0 * (len(pieces) - 1):
        return found, kept, None
    return solution, moved, zeros


def _moved(recording: Recording, name: str, value: float, model: FitModel) -> Recording:
    """Return the recording as it would be had its zero been the common one."""
    if name == "torque_offset":
        gain = model["input_gain"] or 1.0
        return replace(recording, input=recording.input + value / gain)
    return replace(recording, position=recording.position - value)
