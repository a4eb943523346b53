"""A million closed-loop runs over uncertain parameters, noise and starts; chunked, restartable, distributed.

The noise of each run has its own seed. Chunks are drawn whole, so runs can be added.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import share_interval
from pendulum_bags.experiments.joint_run import LIMIT_PER_NOISE
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.chunks import (
    Connect,
    chunk_path,
    open_results,
    read_columns,
    run_chunks,
    stored_settings,
    write_results_marker,
)
from pendulum_bags.studies.closed_loops import ClosedLoops, Columns
from pendulum_bags.studies.uncertain import VARIED
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["COLUMNS", "MonteCarlo", "draw_chunk", "replay", "run_chunk", "run_monte_carlo", "sobol"]

COLUMNS = (*VARIED, "noise_seed", "theta_0", "max_theta", "max_effort", "std_theta", "theta_end", "theta_dot_end")
"""Columns of the Parquet files of one joint; SI units."""

_SEEDS_OF_ONE = 10_000_000_000
"""Distance between the noise seeds of two Monte Carlos."""
_SEEDS = 2**63 // _SEEDS_OF_ONE
"""Number of seeds that a Monte Carlo may have."""
_QUANTILES = (0.05, 0.5, 0.95, 0.999)
_WORST = 10
_UPRIGHT = 0.1
"""Largest deviation of a joint at the end of a run that has converged [rad or m]."""


@dataclass(frozen=True)
class MonteCarlo(ClosedLoops):
    """What to draw and to run.

    Attributes:
        amplitude: Largest noise on each driven joint; None for a tenth of its limit [N m or N, or V].
        hold_time: Time for which a noise sample is held [s].
        start: Largest distance of each joint's start from upright, uniform [rad or m].
        bound: Distance from upright that a run should not leave [rad or m].
        chunk: Runs in a chunk; part of the result's definition.
    """

    OF_SEVERAL: ClassVar[Mapping[str, Any]] = {"runs": 100_000, "amplitude": None, "bound": 0.2, "chunk": 10_000}
    NO_RESULT: ClassVar[frozenset[str]] = frozenset({"runs"})

    runs: int = 1_000_000
    amplitude: float | None = 2.5
    hold_time: float = 0.01
    start: float = 0.0
    bound: float = 0.02
    chunk: int = 50_000

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        if self.runs < 1 or self.chunk < 1:
            raise ParameterError(f"runs is {self.runs} and chunk {self.chunk}; expected both >= 1")
        if not 0 <= self.seed < _SEEDS:
            raise ParameterError(f"seed is {self.seed}; expected 0 to {_SEEDS - 1}")
        one = self.nominal.is_pendulum
        coordinates = self.nominal.coordinates
        distance, effort = coordinates.units[0], coordinates.drive_unit
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
        if one and self.start > math.pi:
            raise ParameterError(f"start is {self.start} rad; expected 0 to pi")

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.runs // self.chunk)


class _Names(NamedTuple):
    start: tuple[str, ...]
    farthest: tuple[str, ...]
    spread: tuple[str, ...]
    end: tuple[str, ...]
    end_velocity: tuple[str, ...]
    effort: tuple[str, ...]


def _names(plant: PlantParameters) -> _Names:
    if plant.is_pendulum:
        return _Names(("theta_0",), ("max_theta",), ("std_theta",), ("theta_end",), ("theta_dot_end",), ("max_effort",))
    joints, driven = plant.coordinates.names, plant.coordinates.driven_names
    of_joints = [[f"{what}_{name}" for name in joints] for what in ("start", "max", "std", "end", "end_velocity")]
    return _Names._make(map(tuple, [*of_joints, [f"max_effort_{name}" for name in driven]]))


def draw_chunk(settings: MonteCarlo, index: int) -> Columns:
    """Return plants, starts and noise seeds of a chunk, which is drawn whole and then cut."""
    plant, generator = settings.nominal, settings.generator(index)
    first = index * settings.chunk
    count = min(settings.chunk, settings.runs - first)
    drawn: Columns = {**settings.uncertainty.draw(plant, settings.chunk, generator)}
    for name, goal in zip(_names(plant).start, plant.coordinates.goal, strict=True):
        drawn[name] = goal + settings.start * generator.uniform(-1.0, 1.0, settings.chunk)
    seeds = settings.seed * _SEEDS_OF_ONE + first + np.arange(count, dtype=np.int64)
    return {**{name: values[:count] for name, values in drawn.items()}, "noise_seed": seeds}


def run_chunk(settings: MonteCarlo, index: int, threads: int | None = None) -> Columns:
    """Run a chunk and return its columns; a pure function of settings and index."""
    return _simulate(settings, draw_chunk(settings, index), threads)[0]


def _simulate(
    settings: MonteCarlo, drawn: Columns, threads: int | None = None, *, record: bool = False
) -> tuple[Columns, Array | None]:
    """Run the drawn loops; return all columns, and the motion of one to record, shape (steps, k, n)."""
    plant, names = settings.nominal, _names(settings.nominal)
    result = simulate_batch(
        plant,
        variations=settings.uncertainty.variations(plant, drawn),
        steps=settings.steps,
        dt=settings.dt,
        method=settings.method,
        position=np.stack([drawn[name] for name in names.start], axis=1),
        gain=settings.gain.rows,
        seeds=drawn["noise_seed"],
        amplitude=np.array(plant.command_limits) / LIMIT_PER_NOISE
        if settings.amplitude is None
        else settings.amplitude,
        hold=max(1, round(settings.hold_time / settings.dt)),
        record=record,
        threads=threads,
        device=settings.device,
    )
    columns = dict(drawn)
    ends = (result.max_deviation, result.std_deviation, result.position, result.velocity)
    for i, own in enumerate(zip(*names[1:5], strict=True)):
        columns |= {name: values[:, i] for name, values in zip(own, ends, strict=True)}
    columns |= {name: result.max_effort[:, i] for i, name in enumerate(names.effort)}
    return {name: columns[name] for name in (COLUMNS if plant.is_pendulum else columns)}, result.trajectories


def replay(settings: MonteCarlo, number: int) -> tuple[dict[str, float], Array]:
    """Repeat run ``number``, from 0; return its row and the motion of all joints (q, v, u), shape (steps, 3 n)."""
    if not 0 <= number < settings.runs:
        raise ParameterError(f"run is {number}; expected 0 to {settings.runs - 1}")
    index, place = divmod(number, settings.chunk)
    drawn = {name: values[place : place + 1] for name, values in draw_chunk(settings, index).items()}
    columns, motion = _simulate(settings, drawn, record=True)
    assert motion is not None
    return {name: float(values[0]) for name, values in columns.items()}, motion[:, :, 0]


def run_monte_carlo(
    folder: Path,
    settings: MonteCarlo,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run all chunks that are not on disk, one Parquet file each, and write the summary next to them.

    Args:
        folder: For the files; one of the same settings is continued, one of fewer runs extended.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.

    Raises:
        BagError: The folder holds something else, or more runs.
        ParameterError: A drawn plant has no positive inertia.
    """
    fingerprint, content = settings.fingerprint(), settings.content()
    before = int(stored_settings(folder, fingerprint).get("runs", settings.runs))
    if before > settings.runs:
        raise BagError(
            f"folder {folder} holds a Monte Carlo of {before} runs; expected at most the {settings.runs} of this one"
        )
    if before < settings.runs:
        if before % settings.chunk:
            chunk_path(folder, before // settings.chunk).unlink(missing_ok=True)
        write_results_marker(folder, fingerprint, content)
    open_results(folder, "Monte Carlo", fingerprint, content)
    run_chunks(folder, run_chunk, settings, settings.chunks, connect=connect, on_progress=on_progress)
    result = _figures(folder, settings)
    write_json(folder / "monte_carlo.json", result)
    return result


def _figures(folder: Path, settings: MonteCarlo) -> dict[str, Any]:
    """Return probability, quantiles and worst runs from the Parquet files."""
    coordinates, names = settings.nominal.coordinates, _names(settings.nominal)
    joints = [joint.unit for joint in coordinates.joints]
    units = dict(zip((*names.farthest, *names.spread), 2 * joints, strict=True))
    units |= {name: coordinates.joints[i].effort_unit for name, i in zip(names.effort, coordinates.driven, strict=True)}
    parts: dict[str, list[Array]] = {name: [] for name in (*units, *names.end)}
    for index in range(settings.chunks):
        for name, column in read_columns(chunk_path(folder, index), parts).items():
            parts[name].append(column)
    values = {name: np.concatenate(pieces) for name, pieces in parts.items()}
    farthest = np.max([values[name] for name in names.farthest], axis=0)
    # NaN counts as outside, and as the worst.
    inside = int((farthest <= settings.bound).sum())
    worst = np.argsort(farthest, kind="stable")[::-1][:_WORST]
    ends: Any = [values[name] for name in names.end]
    off = np.abs(coordinates.deviation(ends))
    return {
        "settings": settings.content(),
        "runs": settings.runs,
        "not_finite": int((~np.isfinite(farthest)).sum()),
        "probability_inside": inside / settings.runs,
        "probability_interval": list(share_interval(inside, settings.runs)),
        "quantiles": {
            name: dict(zip(map(str, _QUANTILES), np.quantile(values[name], _QUANTILES).tolist(), strict=True))
            for name in units
        },
        "worst": [
            {"run": int(run), "max_deviation": float(farthest[run]), **replay(settings, int(run))[0]} for run in worst
        ],
        "converged": float(np.mean((off < _UPRIGHT).all(axis=0))),
        "joints": ["theta"] if settings.nominal.is_pendulum else list(coordinates.names),
        "units": units,
    }


def sobol(settings: MonteCarlo, *, base: int = 4096) -> list[dict[str, Any]]:
    """Return first-order and total Sobol indices of each joint's spread over independent parameters, noise and start.

    Args:
        settings: Distributions and loop; ``runs`` is not used.
        base: Base sample of Saltelli's scheme, a power of two; it takes base (D + 2) runs for D factors.

    Source:
        Saltelli et al., Computer Physics Communications 181 (2010), as in SALib.
    """
    from SALib.analyze import sobol as analysis
    from scipy.special import ndtri

    plant, uncertainty, names = settings.nominal, settings.uncertainty, _names(settings.nominal)
    varied = VARIED if plant.is_pendulum else tuple(uncertainty.shares)
    factors = [name for name in varied if uncertainty.shares.get(name, 0.0) > 0.0]
    starts = ["start"] if plant.is_pendulum else list(names.start)
    factors += ["noise"] + (starts if settings.start > 0.0 else [])
    problem = {"num_vars": len(factors), "names": factors, "bounds": [[0.0, 1.0]] * len(factors)}
    unit = np.clip(_sample(problem, base, settings.seed), 1e-9, 1.0 - 1e-9)
    count = len(unit)
    normals = np.zeros((len(varied), count))
    for row, name in enumerate(varied):
        if name in factors:
            normals[row] = ndtri(unit[:, factors.index(name)])
    drawn: Columns = {**uncertainty.scatter(plant, normals, correlated=False)}
    for name, factor, goal in zip(names.start, starts, plant.coordinates.goal, strict=True):
        off = 2.0 * unit[:, factors.index(factor)] - 1.0 if factor in factors else np.zeros(count)
        drawn[name] = goal + settings.start * off
    # The noise seed as one factor.
    drawn["noise_seed"] = (unit[:, factors.index("noise")] * 1e9).astype(np.int64)
    columns, _ = _simulate(settings, drawn)
    results = []
    for output in names.spread:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # SALib's own use of pandas
            warnings.simplefilter("ignore", RuntimeWarning)  # what does not vary has no shares: they are NaN
            found = analysis.analyze(problem, columns[output], calc_second_order=False, seed=settings.seed)
        results.append(
            {
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
        )
    return results


def _sample(problem: dict[str, Any], base: int, seed: int) -> Array:
    from SALib.sample import sobol as sampling

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        return np.asarray(sampling.sample(problem, base, calc_second_order=False, seed=seed))
