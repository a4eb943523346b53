"""Several recordings in one fit, each with offsets of its own: homing or a torque sensor's tare moves between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.problem import Piece, prepare
from pendulum_bags.identification.selection import by_window, effective_samples
from pendulum_bags.identification.solver import Solution, residuals, solve
from pendulum_bags.runs.datasets import Recording

__all__ = ["OwnOffsets", "align", "pay"]


@dataclass(frozen=True)
class OwnOffsets:
    """Offsets of the recordings from their mean.

    Args:
        names: Of the offsets, m of them.
        values: By recording, sum 0, shape (recordings, m) [rad, or unit of the efforts].
    """

    names: tuple[str, ...]
    values: Array

    def sentence(self, labels: Sequence[str], unit: Callable[[str], str]) -> str:
        """Return the offsets of the recordings of these names in words."""
        listings = [
            f"{name} is {', '.join(f'{label} {value:+.4f}' for label, value in zip(labels, column, strict=True))} "
            f"{unit(name)}"
            for name, column in zip(self.names, self.values.T, strict=True)
        ]
        return (
            "Each recording has a zero of its own (homing, or the tare of the torque): "
            f"{'; '.join(listings)} from the common one, which is their mean."
        )


def pay(before: float, after: float, count: float, parameters: int) -> bool:
    """Return whether Schwarz's criterion pays for more parameters: costs without and with, effective samples."""
    gain = count * float(np.log(before / max(after, 1e-300)))
    return gain >= max(float(np.log(count)), 2.0) * parameters


def align(
    found: Solution, pieces: Sequence[Piece], free: Sequence[str], window: float | None, scale: float, *, coarse: float
) -> tuple[Solution, list[Piece], OwnOffsets | None]:
    """Return the fit and the recordings of one joint with their zeros moved onto each other, where the data ask for it.

    Their errors are in no interval; those of the common offset are. Other arguments are those of the first fit, and
    ``window`` the length of its windows [s].
    """
    # A servo compares its set point with the same encoder: another zero there is another set point.
    offsets = [name for name in ("angle_offset", "torque_offset") if name in free]
    if len(pieces) < 2 or not offsets or found.model.input_kind == "position_goal":
        return found, list(pieces), None

    def search(name: str) -> tuple[Solution, str]:
        rest = [other for other in free if other != name]
        states = found.states
        return solve(
            found.model, pieces, rest, own=(name,), states=states, scale=scale, tolerance=1e-7, coarse=coarse
        ), name

    best, name = min(map(search, offsets), key=lambda one: one[0].cost)
    count = effective_samples(by_window(residuals(found.model, pieces, found.states), pieces))
    if not pay(found.cost, best.cost, count, len(pieces) - 1):
        return found, list(pieces), None
    zeros = OwnOffsets((name,), best.offsets - best.offsets.mean(axis=0))
    shifts = zeros.values[:, 0].tolist()
    moved = [
        prepare(_moved(piece.recording, name, value, best.model), window)
        for piece, value in zip(pieces, shifts, strict=True)
    ]
    states = [
        each - np.array([value, 0.0]) * (name == "angle_offset")
        for each, value in zip(best.states, shifts, strict=True)
    ]
    return replace(best, states=states), moved, zeros


def _moved(recording: Recording, name: str, value: float, model: FitModel) -> Recording:
    if name == "torque_offset":
        gain = model["input_gain"] or 1.0
        return replace(recording, input=recording.input + value / gain)
    return replace(recording, position=recording.position - value)
