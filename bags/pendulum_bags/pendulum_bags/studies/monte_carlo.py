"""A million closed-loop runs over what is not known: parameters, noise and start; chunked, restartable, distributed.

Chunk c draws its plants from the stream (seed, c) and its noise from seeds of its own, so a result depends neither on
the number of workers nor on the order in which they finish, bit for bit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.studies.chunks import Connect
from pendulum_bags.studies.random_runs import RandomRuns, carry_out_runs, figures_of_runs
from pendulum_bags.studies.uncertain import VARIED, Uncertainty, batch_variations
from pendulum_lqr.design import output_lqr
from pendulum_lqr.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.batch import BatchResult, simulate_batch

__all__ = [
    "COLUMNS",
    "MonteCarlo",
    "draw_chunk",
    "replay",
    "run_chunk",
    "run_monte_carlo",
    "sobol",
    "summarise",
]

COLUMNS = (*VARIED, "noise_seed", "theta_0", "max_theta", "max_effort", "std_theta", "theta_end", "theta_dot_end")
"""Columns of the Parquet files; SI units."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MonteCarlo(RandomRuns):
    """What to draw and to run, of a pendulum; see :class:`RandomRuns`.

    Attributes:
        uncertainty: How far its parameters are known.
        q: Diagonal of Q.
        r: R.
        amplitude: Largest noise torque [N m].
        method: Integrator.
    """

    UNITS: ClassVar[tuple[str, str]] = ("rad", "N m")

    plant: str = "thesis"
    runs: int = 1_000_000
    uncertainty: Uncertainty = field(
        default_factory=lambda: Uncertainty({"inertia": 0.3, "damping": 0.05, "gravity": 0.05})
    )
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    amplitude: float = 2.5
    method: str = "etd2"
    bound: float = 0.02
    chunk: int = 50_000

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        super().__post_init__()
        if self.start > math.pi:
            raise ParameterError(f"start is {self.start} rad; expected 0 to pi")

    def numbers_of_plant(self) -> PlantParameters:
        """Return the plant."""
        return load_plant(self.plant)


def draw_chunk(settings: MonteCarlo, index: int, plant: PlantParameters | None = None) -> dict[str, NDArray[Any]]:
    """Return the plants, starts and noise seeds of a chunk, shape (n,) each.

    Args:
        settings: Of the Monte Carlo.
        index: Of the chunk.
        plant: The plant that is believed in; by default the one that the settings name.
    """
    believed = plant or load_plant(settings.plant)

    def draw(generator: np.random.Generator, count: int) -> dict[str, NDArray[Any]]:
        values = settings.uncertainty.draw(believed, count, generator)
        return {**values, "theta_0": UPRIGHT + settings.start * generator.uniform(-1.0, 1.0, count)}

    return settings.draw(index, draw)


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
    index, place = settings.place(number)
    plant = load_plant(settings.plant)
    drawn = {name: values[place] for name, values in draw_chunk(settings, index, plant).items()}
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
    """Run all chunks that are not on disk yet and sum up, as :func:`carry_out_runs` says.

    Args:
        folder: Where the files go.
        settings: What to run.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else, or more runs.
    """
    return carry_out_runs(
        folder,
        settings,
        _run_chunk,
        (settings, load_plant(settings.plant)),
        summarise,
        connect=connect,
        on_progress=on_progress,
    )


def summarise(folder: Path, settings: MonteCarlo) -> dict[str, Any]:
    """Return the probability of staying inside the bound, quantiles and the worst runs, from the Parquet files."""
    figures, values = figures_of_runs(
        folder,
        settings,
        ("max_theta", "max_effort", "std_theta", "theta_end"),
        lambda columns: columns["max_theta"],
        lambda run, _: replay(settings, run)[0],
    )
    del figures["quantiles"]["theta_end"]
    return {**figures, "converged": float(np.mean(np.abs(wrap(values["theta_end"] - UPRIGHT)) < 0.1))}


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
