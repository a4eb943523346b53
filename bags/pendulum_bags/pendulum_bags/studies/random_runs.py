"""What a Monte Carlo is, whatever the plant: chunks with streams of their own, runs that can be added, its figures."""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import share_interval
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.chunks import (
    Connect,
    chunk_path,
    kept_settings,
    open_results,
    read_columns,
    run_chunks,
    write_results_marker,
)
from pendulum_msgs_py.errors import BagError, ParameterError

__all__ = [
    "Columns",
    "RandomRuns",
    "draw_chunk",
    "figures_of_runs",
    "on_device",
    "replay",
    "run_chunk",
    "run_monte_carlo",
]
Columns = dict[str, NDArray[Any]]
"""Columns of a table by name, shape (n,) each; SI units."""

_SEEDS_OF_ONE = 10_000_000_000
"""Distance between the noise seeds of two Monte Carlos."""
_SEEDS = 2**63 // _SEEDS_OF_ONE
"""Number of seeds that a Monte Carlo may have."""
_QUANTILES = (0.05, 0.5, 0.95, 0.999)
_WORST = 10


@dataclass(frozen=True)
class RandomRuns(ABC):
    """What to draw and to run.

    Attributes:
        plant: Preset or file of the nominal plant; the controller is designed on it.
        runs: Number of closed-loop runs.
        seed: Seed of everything.
        amplitude: Largest noise on each driven joint [N m or N]; None where the plant decides.
        hold_time: Time for which a noise sample is held [s].
        start: Largest distance of each joint's start from upright, uniform [rad or m].
        duration: Of each run [s].
        dt: Period of the loop [s].
        bound: Distance from upright that a run should not leave [rad or m].
        chunk: Runs in a chunk; part of the result's definition.
        device: Where the batches run, ``cpu`` or ``cuda``.
    """

    UNITS: ClassVar[tuple[str, str]] = ("rad or m", "N m or N")
    """Of distances and efforts."""

    plant: str
    runs: int = 100_000
    seed: int = 1
    amplitude: float | None = None
    hold_time: float = 0.01
    start: float = 0.0
    duration: float = 5.0
    dt: float = 0.002
    bound: float = 0.2
    chunk: int = 10_000
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        if self.runs < 1 or self.chunk < 1:
            raise ParameterError(f"runs is {self.runs} and chunk {self.chunk}; expected both >= 1")
        if not 0 <= self.seed < _SEEDS:
            raise ParameterError(f"seed is {self.seed}; expected 0 to {_SEEDS - 1}")
        distance, effort = self.UNITS
        for name, value, unit, least in (
            ("dt", self.dt, "s", 1e-9),
            ("bound", self.bound, distance, 1e-9),
            ("start", self.start, distance, 0.0),
            ("duration", self.duration, "s", self.dt),
            ("hold_time", self.hold_time, "s", self.dt),
            ("amplitude", self.amplitude or 0.0, effort, 0.0),
        ):
            if not (math.isfinite(value) and value >= least):
                raise ParameterError(f"{name} is {value} {unit}; expected a finite number >= {least:g}")

    @abstractmethod
    def load(self) -> Any:
        """Return the nominal plant."""

    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant, for a fingerprint."""
        plant = self.load()
        return {**plant.numbers, "drivetrain": None, "name": plant.name}

    @abstractmethod
    def draw(self, plant: Any, count: int, generator: np.random.Generator) -> Columns:
        """Return parameters and starts of a number of runs."""

    @abstractmethod
    def simulate(
        self, plant: Any, drawn: Columns, threads: int | None = None, *, record: bool = False
    ) -> tuple[Columns, Array | None]:
        """Run what was drawn; return all columns, and where it is to be recorded the motion, shape (steps, k, n)."""

    @abstractmethod
    def summarise(self, folder: Path) -> dict[str, Any]:
        """Return the figures of a folder's files, by :func:`figures_of_runs`."""

    @property
    def steps(self) -> int:
        """Steps of each run."""
        return round(self.duration / self.dt)

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.runs // self.chunk)

    def fingerprint(self) -> str:
        """Return a hash of all that a run depends on; how many runs there are is not among that."""
        settings = {name: value for name, value in on_device(self).items() if name != "runs"}
        content = json.dumps([settings, self.numbers_of_plant()], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def on_device(settings: Any) -> dict[str, Any]:
    """Return settings of a fingerprint: a GPU's results differ by rounding, and the processor needs no mention."""
    return {name: value for name, value in asdict(settings).items() if (name, value) != ("device", "cpu")}


def draw_chunk(settings: RandomRuns, index: int, plant: Any = None) -> Columns:
    """Return what is drawn for a chunk: plants, starts and noise seeds.

    A chunk is drawn whole and then cut, so that a run is the same however many follow it.

    Args:
        settings: Of the Monte Carlo.
        index: Of the chunk.
        plant: The nominal plant; by default the one that the settings name.
    """
    first = index * settings.chunk
    count = min(settings.chunk, settings.runs - first)
    generator = np.random.Generator(np.random.Philox(key=[settings.seed, index]))
    drawn = settings.draw(plant or settings.load(), settings.chunk, generator)
    seeds = settings.seed * _SEEDS_OF_ONE + first + np.arange(count, dtype=np.int64)
    return {**{name: values[:count] for name, values in drawn.items()}, "noise_seed": seeds}


def run_chunk(settings: RandomRuns, index: int, threads: int | None = None) -> Columns:
    """Run a chunk and return its columns; a pure function of settings and index."""
    return _run_chunk((settings, settings.load()), index, threads)


def _run_chunk(job: tuple[RandomRuns, Any], index: int, threads: int | None) -> Columns:
    # The plant travels with the job: its file need not be where a worker runs.
    settings, plant = job
    return settings.simulate(plant, draw_chunk(settings, index, plant), threads)[0]


def replay(settings: RandomRuns, number: int) -> tuple[dict[str, float], Array]:
    """Run one run again, alone, and return what was drawn for it and its motion.

    Args:
        settings: As of the Monte Carlo.
        number: Of the run, from 0.

    Returns:
        The row of the table, and positions, velocities and efforts of all n joints at each step, shape (steps, 3 n).
    """
    if not 0 <= number < settings.runs:
        raise ParameterError(f"run is {number}; expected 0 to {settings.runs - 1}")
    index, place = divmod(number, settings.chunk)
    plant = settings.load()
    drawn = {name: values[place : place + 1] for name, values in draw_chunk(settings, index, plant).items()}
    columns, motion = settings.simulate(plant, drawn, record=True)
    assert motion is not None
    return {name: float(values[0]) for name, values in columns.items()}, motion[:, :, 0]


def run_monte_carlo(
    folder: Path,
    settings: RandomRuns,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run all chunks that are not on disk yet, one Parquet file each, sum up and write that next to them.

    Args:
        folder: Where the files go; a folder of the same settings is continued, one of fewer runs is added to.
        settings: What to run.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else, or more runs.
        ParameterError: A drawn plant has no positive inertia.
    """
    fingerprint, content = settings.fingerprint(), asdict(settings)
    before = int(kept_settings(folder, fingerprint).get("runs", settings.runs))
    if before > settings.runs:
        raise BagError(
            f"folder {folder} holds a Monte Carlo of {before} runs; expected at most the {settings.runs} of this one"
        )
    if before < settings.runs:
        # Only a last chunk that was not full has to be carried out again.
        if before % settings.chunk:
            chunk_path(folder, before // settings.chunk).unlink(missing_ok=True)
        write_results_marker(folder, fingerprint, content)
    open_results(folder, "Monte Carlo", fingerprint, content)
    job = (settings, settings.load())
    run_chunks(folder, _run_chunk, job, settings.chunks, connect=connect, on_progress=on_progress)
    result = settings.summarise(folder)
    write_json(folder / "monte_carlo.json", result)
    return result


def figures_of_runs(
    folder: Path,
    settings: RandomRuns,
    columns: Iterable[str],
    farthest: Callable[[Mapping[str, Array]], Array],
    row: Callable[[int, float], Mapping[str, Any]],
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the probability of staying inside the bound, quantiles and the worst runs, and the columns read for it.

    Args:
        folder: Of the files.
        settings: Of the Monte Carlo.
        columns: To read; each has its quantiles.
        farthest: Returns each run's farthest distance from upright, of the columns.
        row: Returns the entry of one of the worst runs, by its number and its distance.
    """
    parts: dict[str, list[Array]] = {name: [] for name in columns}
    for index in range(settings.chunks):
        for name, column in read_columns(chunk_path(folder, index), parts).items():
            parts[name].append(column)
    values = {name: np.concatenate(pieces) for name, pieces in parts.items()}
    distance = farthest(values)
    # What is not a number is not inside, and worse than any number.
    inside = int((distance <= settings.bound).sum())
    worst = np.argsort(distance, kind="stable")[::-1][:_WORST]
    figures = {
        "settings": asdict(settings),
        "runs": settings.runs,
        "not_finite": int((~np.isfinite(distance)).sum()),
        "probability_inside": inside / settings.runs,
        "probability_interval": list(share_interval(inside, settings.runs)),
        "quantiles": {
            name: dict(zip(map(str, _QUANTILES), np.quantile(column, _QUANTILES).tolist(), strict=True))
            for name, column in values.items()
        },
        "worst": [{"run": int(run), **row(int(run), float(distance[run]))} for run in worst],
    }
    return figures, values
