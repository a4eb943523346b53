"""What a map of starts is, whatever the plant: a grid of them, run for many plants in chunks with their own streams."""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.chunks import Connect, open_results, run_chunks, write_columns
from pendulum_bags.studies.random_runs import Columns, on_device
from pendulum_msgs_py.errors import ParameterError

__all__ = ["StartGrid", "inside_ellipse", "run_map", "share_inside"]


@dataclass(frozen=True)
class StartGrid(ABC):
    """What to map; plant 0 is the nominal one.

    Attributes:
        plant: Preset or file of the nominal plant; the controller is designed on it.
        plants: Plants at each start, the nominal one first; 1 leaves the uncertainty out.
        points: Points along each axis of the grid; an odd number has upright at rest among them.
        duration: Of each run [s].
        dt: Period of the loop [s].
        tolerance: Largest distance of a position from upright [rad or m] and of a velocity from rest at the end at
            which upright is reached.
        seed: Seed of the plants.
        device: Where the batches run, ``cpu`` or ``cuda``.
    """

    RUNS_OF_CHUNK: ClassVar[int]
    """Runs of a chunk, about."""

    plant: str
    plants: int = 100
    points: int = 61
    duration: float = 8.0
    dt: float = 0.002
    tolerance: tuple[float, float] = (0.1, 0.2)
    seed: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        for name, value, unit, low, high in (
            ("plants", self.plants, "", 1, 1_000_000),
            ("points", self.points, "", 3, 2001),
            ("seed", self.seed, "", 0, 2**63 - 1),
            ("duration", self.duration, " s", self.dt, 1e4),
            *self.ranges,
        ):
            if not low <= value <= high:
                raise ParameterError(f"{name} is {value}{unit}; expected {low:g} to {high:g}{unit}")

    @property
    @abstractmethod
    def ranges(self) -> tuple[tuple[str, float, str, float, float], ...]:
        """What else has a range: name, value, unit with a space before it, lowest and highest."""

    @abstractmethod
    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant, for a fingerprint."""

    @abstractmethod
    def job(self) -> Any:
        """Return what a chunk needs besides these settings; it travels to the workers, as its files need not."""

    @abstractmethod
    def run_chunk(self, job: Any, index: int, threads: int | None) -> Columns:
        """Run a chunk and return its columns."""

    @abstractmethod
    def summarise(self, folder: Path) -> Any:
        """Return a folder's results: the figures by ``to_json``, the map, a row a start, by ``columns``."""

    @property
    def plants_of_chunk(self) -> int:
        """Plants in a chunk; part of the result's definition."""
        return max(1, self.RUNS_OF_CHUNK // self.points**2)

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.plants // self.plants_of_chunk)

    @property
    def steps(self) -> int:
        """Steps of each run."""
        return max(1, round(self.duration / self.dt))

    def chunk(self, index: int) -> tuple[NDArray[np.int32], np.random.Generator]:
        """Return the numbers of a chunk's plants, and what draws them."""
        first = index * self.plants_of_chunk
        numbers = np.arange(first, min(first + self.plants_of_chunk, self.plants), dtype=np.int32)
        return numbers, np.random.Generator(np.random.Philox(key=[self.seed, index]))

    def fingerprint(self) -> str:
        """Return a hash of all that the result depends on."""
        content = json.dumps([on_device(self), self.numbers_of_plant()], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def run_map(
    folder: Path,
    settings: StartGrid,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Any:
    """Run what is not on disk yet, one Parquet file for each chunk, and write the map and its figures.

    Args:
        folder: Where the files go; a folder of the same settings is continued.
        settings: What to map.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else.
        ParameterError: A start lies beyond an end stop, or a drawn plant has no positive inertia.
    """
    open_results(folder, "map", settings.fingerprint(), asdict(settings))
    job = (settings, settings.job())
    run_chunks(folder, _run_chunk, job, settings.chunks, connect=connect, on_progress=on_progress)
    result = settings.summarise(folder)
    write_columns(folder / "map.parquet", result.columns())
    write_json(folder / "region.json", result.to_json())
    return result


def _run_chunk(job: tuple[StartGrid, Any], index: int, threads: int | None) -> Columns:
    settings, rest = job
    return settings.run_chunk(rest, index, threads)


def inside_ellipse(S: Array, level: float, x: Array, y: Array) -> NDArray[np.bool_]:
    """Return which of the states (x, y) are in the ellipse (x, y) S (x, y)' <= level."""
    inside: NDArray[np.bool_] = S[0, 0] * x * x + 2.0 * S[0, 1] * x * y + S[1, 1] * y * y <= level
    return inside


def share_inside(hits: NDArray[np.int64], inside: NDArray[np.bool_], plants: int) -> float:
    """Return the share of all runs from some starts that reached upright; NaN without such a start."""
    return float(hits[inside].sum() / (plants * inside.sum())) if inside.any() else math.nan
