"""What ranks: controllers with the costs of their runs on both sides, by seed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.runs.series import Array
from pendulum_msgs_py.errors import DataError

__all__ = ["PARTS", "Contender", "Interval", "compared_runs", "contenders_of", "refuse_no_number"]

PARTS = ("angle", "velocity", "torque")
"""Parts of the cost: q11 e^2, q22 v^2 and r u^2, each a mean over the run."""


@dataclass(frozen=True)
class Contender:
    """One controller with one set of parameters.

    Attributes:
        name: Its name.
        sim, hw: Parts of the cost, one row for each run (by seed), shape (runs, 3); no rows for a side that failed.
        sim_failed, hw_failed: How many runs failed on each side.
        sim_seeds, hw_seeds: Seeds of the rows; none where they are not known.
        emulated: Whether an emulator stood in for the hardware, in all runs.
    """

    name: str
    sim: Array
    hw: Array
    sim_failed: int = 0
    hw_failed: int = 0
    sim_seeds: tuple[int, ...] = ()
    hw_seeds: tuple[int, ...] = ()
    emulated: bool = True

    def cost(self, side: str) -> float:
        """Return the mean cost on a side; infinity where a run failed there."""
        rows, failed = (self.sim, self.sim_failed) if side == "sim" else (self.hw, self.hw_failed)
        return float("inf") if failed or not rows.size else float(rows.sum(axis=1).mean())

    def parts(self, side: str) -> Array:
        """Return the mean parts on a side, shape (3,)."""
        rows = self.sim if side == "sim" else self.hw
        return np.asarray(rows.mean(axis=0), dtype=np.float64)


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


def contenders_of(
    costs: Mapping[str, Mapping[str, Sequence[tuple[int, Array | None]]]], real: Collection[str] = ()
) -> list[Contender]:
    """Return the contenders that have runs on both sides.

    Args:
        costs: Name -> side (``sim``, ``hw``) -> (seed, parts of the cost, or None for a run that failed).
        real: Names that have runs on real hardware.
    """
    found = []
    for name, sides in costs.items():
        if not (sides.get("sim") and sides.get("hw")):
            continue
        rows: dict[str, Array] = {}
        failed: dict[str, int] = {}
        seeds: dict[str, tuple[int, ...]] = {}
        for side in ("sim", "hw"):
            runs = sorted(sides[side], key=lambda run: run[0])
            kept = [parts for _, parts in runs if parts is not None]
            rows[side] = np.array(kept, dtype=np.float64).reshape(-1, len(PARTS))
            failed[side] = len(runs) - len(kept)
            seeds[side] = tuple(seed for seed, parts in runs if parts is not None)
        found.append(
            Contender(
                name, rows["sim"], rows["hw"], failed["sim"], failed["hw"], seeds["sim"], seeds["hw"], name not in real
            )
        )
    return found


def refuse_no_number(contenders: Sequence[Contender]) -> None:
    """Refuse costs that are no finite number: one would pass for a controller that failed.

    Raises:
        DataError: There is one; the sentence names contender, side and seed.
    """
    for one in contenders:
        for side, rows, seeds in (("sim", one.sim, one.sim_seeds), ("hw", one.hw, one.hw_seeds)):
            for i, row in enumerate(rows):
                if not np.all(np.isfinite(row)):
                    run = f"under seed {seeds[i]}" if seeds else f"in run {i + 1} of {len(rows)}"
                    told = ", ".join(f"{part} {value:g}" for part, value in zip(PARTS, row, strict=True))
                    raise DataError(f"the cost of {one.name} on {side} {run} is {told}; expected finite numbers")


def compared_runs(one: Contender, other: Contender) -> tuple[Array, Array, bool]:
    """Return the costs of two on the hardware, and whether they are pairs under the same seeds.

    Runs under one seed share their disturbance. Where both ran under two common seeds or more, these alone are
    compared, with the mean of what was repeated under a seed; otherwise all runs of both, as independent ones.
    """
    both = sorted(set(one.hw_seeds) & set(other.hw_seeds))
    if len(both) < 2:
        return one.hw.sum(axis=1), other.hw.sum(axis=1), False
    first, second = (
        np.array([who.hw.sum(axis=1)[np.array(who.hw_seeds) == seed].mean() for seed in both]) for who in (one, other)
    )
    return first, second, True
