"""A million closed-loop runs over what is not known: parameters, noise and start; chunked, restartable, distributed.

Chunk c draws its plants from the stream (seed, c) and its noise from seeds of its own, so a result depends neither on
the number of workers nor on the order in which they finish, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

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
from pendulum_bags.studies.uncertain import VARIED, Uncertainty, batch_variations
from pendulum_lqr.design import output_lqr
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.batch import BatchResult, simulate_batch

__all__ = [
    "COLUMNS",
    "SEEDS",
    "SEEDS_OF_ONE",
    "MonteCarlo",
    "add_runs",
    "draw_chunk",
    "replay",
    "run_chunk",
    "run_monte_carlo",
    "sobol",
    "summarise",
]

COLUMNS = (*VARIED, "noise_seed", "theta_0", "max_theta", "max_effort", "std_theta", "theta_end", "theta_dot_end")
"""Columns of the Parquet files; SI units."""

SEEDS_OF_ONE = 10_000_000_000
"""Distance between the noise seeds of two Monte Carlos."""
SEEDS = 2**63 // SEEDS_OF_ONE
"""Number of seeds that a Monte Carlo may have."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MonteCarlo:
    """What to draw and to run.

    Attributes:
        plant: Preset or file of the plant that is believed in; the controller is designed on it.
        runs: Number of closed-loop runs.
        seed: Seed of everything.
        uncertainty: How far its parameters are known.
        q: Diagonal of Q.
        r: R.
        amplitude: Largest noise torque [N m].
        hold_time: Time for which a noise sample is held [s].
        start: Largest distance of the start from upright, uniform [rad].
        duration: Of each run [s].
        dt: Period of the loop [s].
        method: Integrator.
        bound: Distance from upright that a run should not leave [rad].
        chunk: Runs in a chunk; part of the result's definition.
    """

    plant: str = "thesis"
    runs: int = 1_000_000
    seed: int = 1
    uncertainty: Uncertainty = field(
        default_factory=lambda: Uncertainty({"inertia": 0.3, "damping": 0.05, "gravity": 0.05})
    )
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    amplitude: float = 2.5
    hold_time: float = 0.01
    start: float = 0.0
    duration: float = 5.0
    dt: float = 0.002
    method: str = "etd2"
    bound: float = 0.02
    chunk: int = 50_000

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        if self.runs < 1 or self.chunk < 1:
            raise ParameterError(f"runs is {self.runs} and chunk {self.chunk}; expected both >= 1")
        if not 0 <= self.seed < SEEDS:
            raise ParameterError(f"seed is {self.seed}; expected 0 to {SEEDS - 1}")
        if not (math.isfinite(self.bound) and self.bound > 0.0):
            raise ParameterError(f"bound is {self.bound} rad; expected > 0")
        if not (math.isfinite(self.amplitude) and self.amplitude >= 0.0):
            raise ParameterError(f"amplitude is {self.amplitude} N m; expected >= 0")
        if not (math.isfinite(self.duration) and self.dt > 0.0 and self.hold_time > 0.0):
            raise ParameterError(f"duration is {self.duration} s and hold_time {self.hold_time} s; expected both > 0")
        if not 0.0 <= self.start <= math.pi:
            raise ParameterError(f"start is {self.start} rad; expected 0 to pi")
        if self.steps < 1:
            raise ParameterError(f"duration is {self.duration} s; expected at least one step of {self.dt} s")

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
        content = json.dumps([settings, load_plant(self.plant)], sort_keys=True, default=asdict)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def draw_chunk(settings: MonteCarlo, index: int, plant: PlantParameters | None = None) -> dict[str, NDArray[Any]]:
    """Return the plants, starts and noise seeds of a chunk, shape (n,) each.

    A chunk is drawn whole and then cut, so that a run is the same however many follow it.

    Args:
        settings: Of the Monte Carlo.
        index: Of the chunk.
        plant: The plant that is believed in; by default the one that the settings name.
    """
    first = index * settings.chunk
    count = min(settings.chunk, settings.runs - first)
    generator = np.random.Generator(np.random.Philox(key=[settings.seed, index]))
    drawn: dict[str, NDArray[Any]] = {}
    drawn.update(settings.uncertainty.draw(plant or load_plant(settings.plant), settings.chunk, generator))
    drawn["theta_0"] = UPRIGHT + settings.start * generator.uniform(-1.0, 1.0, settings.chunk)
    drawn = {name: values[:count] for name, values in drawn.items()}
    drawn["noise_seed"] = settings.seed * SEEDS_OF_ONE + first + np.arange(count, dtype=np.int64)
    return drawn


def run_chunk(settings: MonteCarlo, index: int, threads: int | None = None) -> dict[str, NDArray[Any]]:
    """Run a chunk and return its columns; a pure function of settings and index."""
    return _run_chunk((settings, load_plant(settings.plant)), index, threads)


def _run_chunk(job: tuple[MonteCarlo, PlantParameters], index: int, threads: int | None) -> dict[str, NDArray[Any]]:
    # The plant travels with the job: its file need not be where a worker runs.
    settings, plant = job
    return _simulate(settings, plant, draw_chunk(settings, index, plant), threads)


def replay(settings: MonteCarlo, number: int) -> tuple[dict[str, float], Array]:
    """Run one run again, alone, and return what was drawn for it and its motion.

    Args:
        settings: As of the Monte Carlo.
        number: Of the run, from 0.

    Returns:
        The row of the table, and theta [rad], theta_dot [rad/s], effort [N m] at each step, shape (steps, 3).
    """
    if not 0 <= number < settings.runs:
        raise ParameterError(f"run is {number}; expected 0 to {settings.runs - 1}")
    index, offset = divmod(number, settings.chunk)
    plant = load_plant(settings.plant)
    drawn = {name: values[offset : offset + 1] for name, values in draw_chunk(settings, index, plant).items()}
    result = _batch(settings, plant, drawn, None, record=True)
    assert result.trajectories is not None
    row = {name: float(values[0]) for name, values in _columns(drawn, result).items()}
    return row, result.trajectories[:, :, 0]


def run_monte_carlo(
    folder: Path,
    settings: MonteCarlo,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run all chunks that are not on disk yet, one Parquet file each, and sum up.

    Args:
        folder: Where the files go; a folder of the same settings is gone on with, one of fewer runs is added to.
        settings: What to run.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else, or more runs.
    """
    add_runs(folder, settings.runs, settings.chunk, settings.fingerprint(), asdict(settings))
    open_results(folder, "Monte Carlo", settings.fingerprint(), asdict(settings))
    job = (settings, load_plant(settings.plant))
    run_chunks(folder, _run_chunk, job, settings.chunks, connect=connect, on_progress=on_progress)
    result = summarise(folder, settings)
    write_json(folder / "monte_carlo.json", result)
    return result


def add_runs(folder: Path, runs: int, chunk: int, fingerprint: str, settings: Mapping[str, Any]) -> None:
    """Let a folder of fewer runs hold more: only a last chunk that was not full has to be carried out again.

    Args:
        folder: Of a Monte Carlo, or a new one.
        runs: How many it shall hold.
        chunk: Runs in a chunk.
        fingerprint: Of all else that a run depends on.
        settings: To keep beside the results.

    Raises:
        BagError: It holds more.
    """
    before = int(kept_settings(folder, fingerprint).get("runs", runs))
    if before > runs:
        raise BagError(f"folder {folder} holds a Monte Carlo of {before} runs; expected at most the {runs} of this one")
    if before < runs:
        if before % chunk:
            chunk_path(folder, before // chunk).unlink(missing_ok=True)
        write_results_marker(folder, fingerprint, settings)


def summarise(folder: Path, settings: MonteCarlo) -> dict[str, Any]:
    """Return the probability of staying inside the bound, quantiles and the worst runs, from the Parquet files."""
    columns: dict[str, list[Array]] = {name: [] for name in ("max_theta", "max_effort", "std_theta", "theta_end")}
    for index in range(settings.chunks):
        table = read_columns(chunk_path(folder, index), columns)
        for name, parts in columns.items():
            parts.append(table[name])
    values = {name: np.concatenate(parts) for name, parts in columns.items()}
    inside = int((values["max_theta"] <= settings.bound).sum())
    worst = np.argsort(values["max_theta"], kind="stable")[::-1][:10]
    # Not a number is worse than any number.
    lost = int((~np.isfinite(values["max_theta"])).sum())
    low, high = share_interval(inside, settings.runs)
    shares = (0.05, 0.5, 0.95, 0.999)
    return {
        "settings": asdict(settings),
        "runs": settings.runs,
        "not_finite": lost,
        "probability_inside": inside / settings.runs,
        "probability_interval": [low, high],
        "quantiles": {
            name: dict(zip(map(str, shares), np.quantile(column, shares).tolist(), strict=True))
            for name, column in values.items()
            if name != "theta_end"
        },
        "converged": float(np.mean(np.abs(wrap(values["theta_end"] - UPRIGHT)) < 0.1)),
        "worst": [{"run": int(run), **replay(settings, int(run))[0]} for run in worst],
    }


def sobol(settings: MonteCarlo, *, base: int = 4096, output: str = "std_theta") -> dict[str, Any]:
    """Return first-order and total Sobol indices of an outcome over parameters, noise and start.

    The indices are those of independent factors: a correlation of the parameters is left out here.

    Args:
        settings: Distributions and loop; ``runs`` is not used.
        base: Base sample of Saltelli's scheme, a power of two; it takes base (D + 2) runs for D factors.
        output: Column of the outcome.

    Source:
        Saltelli et al., Computer Physics Communications 181 (2010), as in SALib.
    """
    from SALib.analyze import sobol as analysis
    from scipy.special import ndtri

    factors = [name for name in VARIED if settings.uncertainty.shares.get(name, 0.0) > 0.0]
    factors += ["noise"] + (["start"] if settings.start > 0.0 else [])
    problem = {"num_vars": len(factors), "names": factors, "bounds": [[0.0, 1.0]] * len(factors)}
    unit = np.clip(_sample(problem, base, settings.seed), 1e-9, 1.0 - 1e-9)
    count = len(unit)
    plant = load_plant(settings.plant)
    normals = np.zeros((len(VARIED), count))
    for row, name in enumerate(VARIED):
        if name in factors:
            normals[row] = ndtri(unit[:, factors.index(name)])
    drawn: dict[str, NDArray[Any]] = {}
    drawn.update(settings.uncertainty.scatter(plant, normals, correlated=False))
    start = 2.0 * unit[:, factors.index("start")] - 1.0 if "start" in factors else np.zeros(count)
    drawn["theta_0"] = UPRIGHT + settings.start * start
    # The noise as one factor: which of a thousand million signals.
    drawn["noise_seed"] = (unit[:, factors.index("noise")] * 1e9).astype(np.int64)
    columns = _simulate(settings, plant, drawn, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # SALib's own use of pandas
        found = analysis.analyze(problem, columns[output], calc_second_order=False, seed=settings.seed)
    return {
        "output": output,
        "runs": count,
        "indices": [
            {
                "factor": name,
                "first": float(found["S1"][i]),
                "first_confidence": float(found["S1_conf"][i]),
                "total": float(found["ST"][i]),
                "total_confidence": float(found["ST_conf"][i]),
            }
            for i, name in enumerate(factors)
        ],
    }


def _sample(problem: dict[str, Any], base: int, seed: int) -> Array:
    from SALib.sample import sobol as sampling

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        return np.asarray(sampling.sample(problem, base, calc_second_order=False, seed=seed))


def _simulate(
    settings: MonteCarlo, plant: PlantParameters, drawn: Mapping[str, NDArray[Any]], threads: int | None
) -> dict[str, NDArray[Any]]:
    return _columns(drawn, _batch(settings, plant, drawn, threads))


def _batch(
    settings: MonteCarlo,
    plant: PlantParameters,
    drawn: Mapping[str, NDArray[Any]],
    threads: int | None,
    record: bool = False,
) -> BatchResult:
    if plant.drivetrain is not None:
        raise ParameterError(f"plant {plant.name!r} is series elastic; expected a rigid one: the batch has no motor")
    design = output_lqr(linearise(plant, UPRIGHT), settings.q, settings.r)
    return simulate_batch(
        plant,
        variations=batch_variations(plant, drawn),
        steps=settings.steps,
        dt=settings.dt,
        method=settings.method,
        theta=drawn["theta_0"],
        gain=design.K,
        seeds=drawn["noise_seed"],
        amplitude=settings.amplitude,
        hold=max(1, round(settings.hold_time / settings.dt)),
        record=record,
        threads=threads,
    )


def _columns(drawn: Mapping[str, NDArray[Any]], result: BatchResult) -> dict[str, NDArray[Any]]:
    computed = {
        "max_theta": result.max_theta,
        "max_effort": result.max_effort,
        "std_theta": result.std_theta,
        "theta_end": result.theta,
        "theta_dot_end": result.theta_dot,
    }
    return {name: computed[name] if name in computed else drawn[name] for name in COLUMNS}
