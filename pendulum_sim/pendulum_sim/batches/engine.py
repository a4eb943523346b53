"""Runs a batch on the processor's cores or on a GPU: what is the same for all plants is stored once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.contract.noise import MAX_SEED
from pendulum_msgs_py.errors import ParameterError
from pendulum_sim.batches.devices import resolve_device
from pendulum_sim.stepping.plant import check_step

if TYPE_CHECKING:
    from pendulum_sim.batches.batch_kernels import Layout

__all__ = ["Batch", "Results", "batch_size", "finite_columns", "seed_column"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Results:
    """Results of a batch of B plants of n joints, m of them driven.

    Attributes:
        position: Final positions, shape (B, n), not wrapped [rad or m].
        velocity: Final velocities, shape (B, n).
        max_effort: Largest |K x| before noise and limit, shape (B, m) [N m or N].
        max_deviation: Largest |q - goal|, wrapped where it turns, shape (B, n).
        mean_deviation: Mean of q - goal over the steps, shape (B, n).
        std_deviation: Its standard deviation, shape (B, n).
        mean_velocity: Mean of the velocity, shape (B, n).
        std_velocity: Its standard deviation, shape (B, n).
        trajectories: Positions, velocities and applied efforts of all joints at the start of each step, shape
            (steps, 3 n, B); None unless requested.
    """

    position: Array
    velocity: Array
    max_effort: Array
    max_deviation: Array
    mean_deviation: Array
    std_deviation: Array
    mean_velocity: Array
    std_velocity: Array
    trajectories: Array | None = None


@dataclass(frozen=True)
class Batch:
    """How a batch is run, whatever its plants.

    Attributes:
        steps: Steps to take, >= 1.
        dt: Step, over which control and noise are held [s].
        substeps: Integration steps in a step.
        hold: Steps for which a noise sample is held, >= 1.
        record: Return the trajectories.
        threads: Threads to use; None for numba's default.
        device: ``cpu``, ``cuda`` for the GPU, or ``auto`` for the GPU where there is one.

    Raises:
        ParameterError: A value is outside its domain.
        FaultError: There is no GPU.
    """

    steps: int
    dt: float
    substeps: int
    hold: int
    record: bool
    threads: int | None
    device: str

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        check_step(self.dt, self.substeps)
        counts = {"steps": self.steps, "hold": self.hold, **({} if self.threads is None else {"threads": self.threads})}
        for name, value in counts.items():
            if not isinstance(value, (int, np.integer)) or isinstance(value, (bool, np.bool_)) or value < 1:
                raise ParameterError(f"{name} is {value!r}; expected a whole number >= 1")
        resolve_device(self.device)

    def run(
        self, layout: Layout, columns: Mapping[str, Sequence[Array]], seeds: NDArray[np.uint64], *, smooth: bool
    ) -> Results:
        """Run it.

        Args:
            layout: Of its plants.
            columns: Rows of the layout's quantities by name, each of shape (1,) for all plants or (B,).
            seeds: Of the noise, shape (1,) or (B,).
            smooth: No plant has dry friction, end stops, lag or delay.
        """
        starts, n, m = layout.starts, len(layout.turns), len(layout.driven)
        size = max(len(seeds), *(len(row) for rows in columns.values() for row in rows))
        constants = np.zeros(starts["end"])
        source = np.full(starts["end"], -1)
        varied: list[Array] = []
        for name, rows in columns.items():
            for row, values in enumerate(rows, starts[name]):
                if len(values) == 1:
                    constants[row] = values[0]
                else:
                    source[row] = len(varied)
                    varied.append(values)
        results = np.empty((starts["results"], size))
        record = np.empty((self.steps if self.record else 0, 3 * n, size))
        depth = 0 if smooth else math.floor(float(columns["delay"][0].max()) / self.dt + 1e-9) + 2
        timing = self.dt, self.steps, self.hold, self.substeps
        if resolve_device(self.device) == "cuda":
            from pendulum_sim.batches.cuda_kernels import run_gpu

            run_gpu(layout, smooth, (constants, source, varied, seeds, results), timing, record, depth)
        else:
            from pendulum_sim.batches.batch_kernels import BLOCK, loop, run_threads

            arguments = constants, source, np.array(varied).reshape(-1, size), seeds, results, *timing, record, depth
            run_threads(loop(layout, smooth=smooth), BLOCK if smooth else 1, self.threads, size, *arguments)

        def rows_of(name: str, count: int) -> Array:
            return results[starts[name] : starts[name] + count].T

        def moments(total: str, squares: str) -> tuple[Array, Array]:
            mean = rows_of(total, n) / self.steps
            return mean, np.sqrt(np.maximum(0.0, rows_of(squares, n) / self.steps - mean**2))

        ends = rows_of("q", n), rows_of("v", n), rows_of("max_effort", m), rows_of("max", n)
        return Results(*ends, *moments("sum", "square"), *moments("sum_v", "square_v"), record if self.record else None)


def batch_size(lengths: Mapping[str, int]) -> int:
    """Return the size of a batch, that of its longest argument; all others have one entry, or as many.

    Raises:
        ParameterError: One has another number of them.
    """
    size = max(lengths.values())
    for name, length in lengths.items():
        if length not in {1, size}:
            raise ParameterError(f"{name} has {length} entries; expected 1 or {size}")
    return size


def seed_column(seeds: ArrayLike) -> NDArray[np.uint64]:
    """Return seeds of the noise, shape (1,) or (B,).

    Raises:
        ParameterError: A seed is no whole number from 0 to 2^64 - 1.
    """
    given = np.atleast_1d(np.asarray(seeds))
    if given.dtype.kind not in "iu":
        # Whole numbers beyond 63 bits come as objects, or as floats that have lost digits.
        given = np.atleast_1d(np.asarray(seeds, dtype=object))
        wrong = [
            seed for seed in given if isinstance(seed, (bool, np.bool_)) or not isinstance(seed, (int, np.integer))
        ]
    else:
        wrong = []
    wrong = wrong or list(given[(given < 0) | (given > MAX_SEED)][:1])
    if wrong:
        raise ParameterError(f"seeds has {wrong[0]}; expected whole numbers from 0 to 2^64 - 1")
    return given.astype(np.uint64)


def finite_columns(name: str, values: ArrayLike, width: int) -> Array:
    """Return values as rows of a given width, (1, width) or (B, width); a scalar holds for all.

    Raises:
        ParameterError: They have another shape, or one is not finite.
    """
    given = np.asarray(values, dtype=np.float64)
    if given.ndim == 0:
        given = np.full(width, given)
    table = given[:, None] if width == 1 and given.ndim == 1 else np.atleast_2d(given)
    if table.ndim != 2 or table.shape[1] != width:
        raise ParameterError(f"{name} has shape {np.shape(values)}; expected ({width},) or (B, {width})")
    if not np.isfinite(table).all():
        raise ParameterError(f"{name} has a value that is not finite; expected numbers")
    return table
