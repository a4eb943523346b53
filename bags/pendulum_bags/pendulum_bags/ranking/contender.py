"""What ranks: controllers with the costs of their runs on both sides, by seed."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_msgs_py.errors import DataError

__all__ = [
    "PARTS", "Contender", "compared_runs", "contenders_of", "error_of_difference", "refuse_no_number",
    "with_noise_of_their_own",
]  # fmt: skip

PARTS = ("angle", "velocity", "torque")
"""Parts of the cost: q11 e^2, q22 v^2 and r u^2, each a mean over the run."""


@dataclass(frozen=True)
class Contender:
    """One controller with one set of parameters.

    Attributes:
        name: Its name.
        sim, hw: Parts of the cost, one row for each run (by seed), shape (runs, 3); no rows for a side that failed. Of
            costs from a table shape (runs, 1), of scores their negatives.
        sim_failed, hw_failed: How many runs failed on each side.
        sim_seeds, hw_seeds: Seeds of the rows, negative where a file or a table does not state them; may be left out.
        emulated: Whether the hardware was emulated, in all runs.
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
        """Return the mean parts on a side, shape (3,); of costs from a table shape (1,)."""
        rows = self.sim if side == "sim" else self.hw
        return np.asarray(rows.mean(axis=0), dtype=np.float64)

    @property
    def shared_seeds(self) -> set[int]:
        """Seeds under which it ran on both sides."""
        return set(self.sim_seeds) & set(self.hw_seeds)

    def by_seed(self, side: str) -> dict[int, float]:
        """Return the mean cost under each seed on a side: runs that repeat a seed are no independent ones."""
        rows, seeds = (self.sim, self.sim_seeds) if side == "sim" else (self.hw, self.hw_seeds)
        costs = rows.sum(axis=1)
        return {seed: float(np.mean(costs[np.array(seeds) == seed])) for seed in sorted(set(seeds))}


def contenders_of(
    costs: Mapping[str, Mapping[str, Sequence[tuple[int, Array | None]]]], real: Collection[str] = ()
) -> list[Contender]:
    """Return the contenders that have runs on both sides.

    ``costs``: name -> side (``sim``, ``hw``) -> (seed, parts of the cost, None for a failed run); ``real``: names with
    runs on real hardware.
    """
    found = []
    for name, sides in costs.items():
        if not (sides.get("sim") and sides.get("hw")):
            continue
        (sim, sim_failed, sim_seeds), (hw, hw_failed, hw_seeds) = (_side(sides[side]) for side in ("sim", "hw"))
        found.append(Contender(name, sim, hw, sim_failed, hw_failed, sim_seeds, hw_seeds, name not in real))
    return found


def _side(runs: Sequence[tuple[int, Array | None]]) -> tuple[Array, int, tuple[int, ...]]:
    """Return rows by seed, how many runs failed, and the seeds of the rows."""
    kept = sorted(((seed, parts) for seed, parts in runs if parts is not None), key=lambda run: run[0])
    rows = np.array([parts for _, parts in kept], dtype=np.float64).reshape(len(kept), -1 if kept else len(PARTS))
    return rows, len(runs) - len(kept), tuple(seed for seed, _ in kept)


def with_noise_of_their_own(contenders: Sequence[Contender]) -> tuple[Sequence[Contender], bool]:
    """Return the contenders without simulated runs whose noise the hardware had too, and whether such may be left.

    They are left where a contender has no others, or where seeds are not stated: a simulation that picks under the
    noise that judges its pick picks what this noise favours.
    """
    if any(seed < 0 for one in contenders for seed in (*one.sim_seeds, *one.hw_seeds)):
        return contenders, True
    shared = any(one.shared_seeds for one in contenders)
    if not shared or any(one.sim_seeds and one.shared_seeds == set(one.sim_seeds) for one in contenders):
        return contenders, shared
    found = []
    for one in contenders:
        own = [i for i, seed in enumerate(one.sim_seeds) if seed not in one.shared_seeds]
        rest = replace(one, sim=one.sim[own], sim_seeds=tuple(one.sim_seeds[i] for i in own))
        found.append(rest if one.sim_seeds else one)  # (seeds that are not known are of no other run)
    return found, False


def refuse_no_number(contenders: Sequence[Contender]) -> None:
    """Refuse costs that are no finite number, by a DataError: one would pass for a controller that failed."""
    for one in contenders:
        for side, rows, seeds in (("sim", one.sim, one.sim_seeds), ("hw", one.hw, one.hw_seeds)):
            for i, row in enumerate(rows):
                if not np.all(np.isfinite(row)):
                    run = f"under seed {seeds[i]}" if seeds else f"in run {i + 1} of {len(rows)}"
                    named = PARTS if row.size == len(PARTS) else ("cost",)
                    costs = ", ".join(f"{part} {value:g}" for part, value in zip(named, row, strict=True))
                    raise DataError(f"the cost of {one.name} on {side} {run} is {costs}; expected finite numbers")


def compared_runs(one: Contender, other: Contender) -> tuple[Array, Array, bool]:
    """Return the costs of two on the hardware, and whether they are pairs under the same seeds.

    Runs under one seed share their disturbance. Where both ran under two common seeds or more, these alone are
    compared, with the mean of what was repeated under a seed; otherwise all runs of both, as independent ones.
    """
    ones, others = one.by_seed("hw"), other.by_seed("hw")
    both = sorted(ones.keys() & others.keys())
    if len(both) < 2:
        return one.hw.sum(axis=1), other.hw.sum(axis=1), False
    return np.array([ones[seed] for seed in both]), np.array([others[seed] for seed in both]), True


def error_of_difference(own: Array, other: Array, *, paired: bool) -> tuple[float, float]:
    """Return the standard error of the difference of two means of repeated runs, and its degrees of freedom."""
    if paired:
        return float(np.std(own - other, ddof=1)) / math.sqrt(own.size), own.size - 1.0
    parts = np.array([np.var(own, ddof=1) / own.size, np.var(other, ddof=1) / other.size])
    # Welch and Satterthwaite.
    freedom = parts.sum() ** 2 / max(1e-300, np.sum(parts**2 / (np.array([own.size, other.size]) - 1.0)))
    return math.sqrt(parts.sum()), float(freedom)
