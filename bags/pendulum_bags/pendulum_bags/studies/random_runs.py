"""What a Monte Carlo is, whatever the plant: chunks with streams of their own, runs that can be added, its figures."""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

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
from pendulum_bags.studies.shares import share_interval
from pendulum_msgs_py.errors import BagError, ParameterError

__all__ = ["RandomRuns", "carry_out_runs", "figures_of_runs"]

Array = NDArray[np.float64]

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
        plant: Preset or file of the plant that is believed in; the controller is designed on it.
        runs: Number of closed-loop runs.
        seed: Seed of everything.
        amplitude: Largest noise on each driven joint [N m or N]; None where the plant decides.
        hold_time: Time for which a noise sample is held [s].
        start: Largest distance of each joint's start from upright, uniform [rad or m].
        duration: Of each run [s].
        dt: Period of the loop [s].
        bound: Distance from upright that a run should not leave [rad or m].
        chunk: Runs in a chunk; part of the result's definition.
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
    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant, for a fingerprint."""

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
        settings = {name: value for name, value in asdict(self).items() if name != "runs"}
        content = json.dumps([settings, self.numbers_of_plant()], sort_keys=True, default=asdict)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def draw(
        self, index: int, draw: Callable[[np.random.Generator, int], Mapping[str, NDArray[Any]]]
    ) -> dict[str, NDArray[Any]]:
        """Return what is drawn for a chunk, and its noise seeds, shape (n,) each.

        A chunk is drawn whole and then cut, so that a run is the same however many follow it.

        Args:
            index: Of the chunk.
            draw: Draws so many from a generator.
        """
        first = index * self.chunk
        count = min(self.chunk, self.runs - first)
        drawn = draw(np.random.Generator(np.random.Philox(key=[self.seed, index])), self.chunk)
        seeds = self.seed * _SEEDS_OF_ONE + first + np.arange(count, dtype=np.int64)
        return {**{name: values[:count] for name, values in drawn.items()}, "noise_seed": seeds}

    def place(self, number: int) -> tuple[int, slice]:
        """Return the chunk of a run, numbered from 0, and where in it the run is."""
        if not 0 <= number < self.runs:
            raise ParameterError(f"run is {number}; expected 0 to {self.runs - 1}")
        index, offset = divmod(number, self.chunk)
        return index, slice(offset, offset + 1)


def carry_out_runs(
    folder: Path,
    settings: RandomRuns,
    run_chunk: Callable[[Any, int, int | None], Mapping[str, NDArray[Any]]],
    job: Any,
    summarise: Callable[[Path, Any], dict[str, Any]],
    *,
    connect: Connect,
    on_progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Run all chunks that are not on disk yet, one Parquet file each, sum up and write that beside them.

    Args:
        folder: Where the files go; a folder of the same settings is gone on with, one of fewer runs is added to.
        settings: What to run.
        run_chunk: Runs a chunk of a job.
        job: What it needs besides the number of the chunk.
        summarise: Returns the result, of the folder and the settings.
        connect: To a Dask cluster.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else, or more runs.
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
    run_chunks(folder, run_chunk, job, settings.chunks, connect=connect, on_progress=on_progress)
    result = summarise(folder, settings)
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
        row: Returns what is told of one of the worst runs, by its number and its distance.
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
