"""A million closed-loop runs over what is not known: parameters, noise and start; chunked, restartable, distributed.

Chunk c draws its plants from the stream (seed, c) and its noise from seeds of its own, so a result depends neither on
the number of workers nor on the order in which they finish, bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiment.run_folder import write_json
from pendulum_lqr.design import continuous_lqr
from pendulum_lqr.model import linearise
from pendulum_msgs_py.angles import UPRIGHT, wrap
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.parameters import load_yaml
from pendulum_msgs_py.plant_parameters import PRESETS, load_plant
from pendulum_sim.batch import simulate_batch

__all__ = ["COLUMNS", "MonteCarlo", "replay", "run_chunk", "run_monte_carlo", "sobol", "summarise", "uncertainty_of"]

VARIED = ("inertia", "damping", "gravity")
COLUMNS = (*VARIED, "noise_seed", "theta_0", "max_theta", "max_effort", "std_theta", "theta_end", "theta_dot_end")
"""Columns of the Parquet files; SI units."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MonteCarlo:
    """What to draw and to run.

    Attributes:
        plant: Preset or file of the plant that is believed in; the controller is designed on it.
        runs: Number of closed-loop runs.
        seed: Seed of everything.
        uncertainty: Standard deviation of each parameter as a share of its value.
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
    uncertainty: Mapping[str, float] = field(default_factory=lambda: {"inertia": 0.3, "damping": 0.05, "gravity": 0.05})
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
        """Refuse what makes no distribution."""
        for name, value in self.uncertainty.items():
            if name not in VARIED:
                raise ParameterError(f"uncertainty of {name!r} is unknown; expected one of {', '.join(VARIED)}")
            if not (math.isfinite(value) and 0.0 <= value <= 1.0):
                raise ParameterError(f"uncertainty of {name} is {value}; expected a share from 0 to 1")
        if self.runs < 1 or self.chunk < 1:
            raise ParameterError(f"runs is {self.runs} and chunk {self.chunk}; expected both >= 1")
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
        """Return a hash of all that the result depends on."""
        content = json.dumps([asdict(self), load_plant(self.plant)], sort_keys=True, default=asdict)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


def uncertainty_of(plant_file: str) -> dict[str, float]:
    """Return the uncertainty that an identification found: half of each 95 % interval by 1.96, as a share.

    Raises:
        ParameterError: The file has no intervals.
    """
    if plant_file in PRESETS:
        raise ParameterError(f"plant {plant_file!r} is a preset; expected the file of an identification")
    entries = load_yaml(plant_file, "plant file").get("parameters", {})
    found = {}
    for name in VARIED:
        entry = entries.get(name)
        if isinstance(entry, dict) and "interval" in entry and entry.get("value"):
            low, high = entry["interval"]
            found[name] = min(1.0, abs((high - low) / (2.0 * 1.96 * entry["value"])))
    if not found:
        raise ParameterError(f"plant file {plant_file} has no intervals; expected those of an identification")
    return found


def draw_chunk(settings: MonteCarlo, index: int) -> dict[str, NDArray[Any]]:
    """Return the plants, starts and noise seeds of a chunk, shape (n,) each.

    Parameters are log-normal about their values: a plant of negative inertia is no plant.
    """
    first = index * settings.chunk
    count = min(settings.chunk, settings.runs - first)
    generator = np.random.Generator(np.random.Philox(key=[settings.seed, index]))
    plant = load_plant(settings.plant)
    drawn: dict[str, NDArray[Any]] = {}
    for name in VARIED:
        sigma = math.sqrt(math.log1p(settings.uncertainty.get(name, 0.0) ** 2))
        drawn[name] = getattr(plant, name) * np.exp(sigma * generator.standard_normal(count) - 0.5 * sigma * sigma)
    drawn["theta_0"] = UPRIGHT + settings.start * generator.uniform(-1.0, 1.0, count)
    drawn["noise_seed"] = settings.seed * 10_000_000_000 + first + np.arange(count, dtype=np.int64)
    return drawn


def run_chunk(settings: MonteCarlo, index: int, threads: int | None = None) -> dict[str, NDArray[Any]]:
    """Run a chunk and return its columns; a pure function of settings and index."""
    return _simulate(settings, draw_chunk(settings, index), threads)


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
    drawn = {name: values[offset : offset + 1] for name, values in draw_chunk(settings, index).items()}
    result = _batch(settings, drawn, None, record=True)
    assert result.trajectories is not None
    row = {name: float(values[0]) for name, values in _columns(drawn, result).items()}
    return row, result.trajectories[:, :, 0]


def run_monte_carlo(
    folder: Path,
    settings: MonteCarlo,
    *,
    scheduler: str = "",
    workers: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run all chunks that are not on disk yet, one Parquet file each, and sum up.

    Args:
        folder: Where the files go; a folder of the same settings is gone on with.
        settings: What to run.
        scheduler: Address of a Dask scheduler, ``tcp://...``; empty for none.
        workers: Processes of a local Dask cluster; 0 runs in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else.
    """
    _open(folder, settings)
    missing = [index for index in range(settings.chunks) if not _path(folder, index).is_file()]
    done = settings.chunks - len(missing)
    on_progress(done, settings.chunks)
    for index, columns in _carry_out(settings, missing, scheduler, workers):
        _write(_path(folder, index), columns)
        done += 1
        on_progress(done, settings.chunks)
    result = summarise(folder, settings)
    write_json(folder / "monte_carlo.json", result)
    return result


def summarise(folder: Path, settings: MonteCarlo) -> dict[str, Any]:
    """Return the probability of staying inside the bound, quantiles and the worst runs, from the Parquet files."""
    _, parquet = _arrow()
    columns: dict[str, list[Array]] = {name: [] for name in ("max_theta", "max_effort", "std_theta", "theta_end")}
    for index in range(settings.chunks):
        table = parquet.read_table(_path(folder, index), columns=list(columns))
        for name, parts in columns.items():
            parts.append(table[name].to_numpy())
    values = {name: np.concatenate(parts) for name, parts in columns.items()}
    inside = int((values["max_theta"] <= settings.bound).sum())
    worst = np.argsort(values["max_theta"], kind="stable")[::-1][:10]
    # Not a number is worse than any number.
    lost = int((~np.isfinite(values["max_theta"])).sum())
    low, high = _wilson(inside, settings.runs)
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

    Args:
        settings: Distributions and loop; ``runs`` is not used.
        base: Base sample of Saltelli's scheme, a power of two; it takes base (D + 2) runs for D factors.
        output: Column of the outcome.

    Source:
        Saltelli et al., Computer Physics Communications 181 (2010), as in SALib.
    """
    from SALib.analyze import sobol as analysis
    from scipy.special import ndtri

    factors = [name for name in VARIED if settings.uncertainty.get(name, 0.0) > 0.0]
    factors += ["noise"] + (["start"] if settings.start > 0.0 else [])
    problem = {"num_vars": len(factors), "names": factors, "bounds": [[0.0, 1.0]] * len(factors)}
    unit = np.clip(_sample(problem, base, settings.seed), 1e-9, 1.0 - 1e-9)
    count = len(unit)
    plant = load_plant(settings.plant)
    drawn: dict[str, NDArray[Any]] = {}
    for name in VARIED:
        sigma = math.sqrt(math.log1p(settings.uncertainty.get(name, 0.0) ** 2))
        normal = ndtri(unit[:, factors.index(name)]) if name in factors else np.zeros(count)
        drawn[name] = getattr(plant, name) * np.exp(sigma * normal - 0.5 * sigma * sigma)
    start = 2.0 * unit[:, factors.index("start")] - 1.0 if "start" in factors else np.zeros(count)
    drawn["theta_0"] = UPRIGHT + settings.start * start
    # The noise as one factor: which of a thousand million signals.
    drawn["noise_seed"] = (unit[:, factors.index("noise")] * 1e9).astype(np.int64)
    columns = _simulate(settings, drawn, None)
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


def _simulate(settings: MonteCarlo, drawn: Mapping[str, NDArray[Any]], threads: int | None) -> dict[str, NDArray[Any]]:
    return _columns(drawn, _batch(settings, drawn, threads))


def _batch(
    settings: MonteCarlo, drawn: Mapping[str, NDArray[Any]], threads: int | None, record: bool = False
) -> Any:
    plant = load_plant(settings.plant)
    design = continuous_lqr(linearise(plant, UPRIGHT), settings.q, settings.r)
    return simulate_batch(
        replace(plant, drivetrain=None),
        variations={name: drawn[name] for name in VARIED},
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


def _columns(drawn: Mapping[str, NDArray[Any]], result: Any) -> dict[str, NDArray[Any]]:
    computed = {
        "max_theta": result.max_theta,
        "max_effort": result.max_effort,
        "std_theta": result.std_theta,
        "theta_end": result.theta,
        "theta_dot_end": result.theta_dot,
    }
    return {name: computed[name] if name in computed else drawn[name] for name in COLUMNS}


def _carry_out(
    settings: MonteCarlo, missing: list[int], scheduler: str, workers: int
) -> Iterable[tuple[int, dict[str, NDArray[Any]]]]:
    if not missing:
        return
    if not scheduler and not workers:
        for index in missing:
            yield index, run_chunk(settings, index)
        return
    from dask.distributed import Client, LocalCluster, as_completed

    if scheduler:
        client = Client(scheduler)
        cluster = None
    else:
        cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
        client = Client(cluster)
    try:
        # Retried elsewhere when a worker dies: a chunk is a pure function.
        jobs = {client.submit(run_chunk, settings, index, 1, pure=True, retries=3): index for index in missing}
        for job, columns in as_completed(jobs, with_results=True):
            yield jobs[job], columns
            job.release()
    finally:
        client.close()
        if cluster is not None:
            cluster.close()


def _open(folder: Path, settings: MonteCarlo) -> None:
    marker = folder / "settings.json"
    if marker.is_file():
        if json.loads(marker.read_text(encoding="utf-8"))["fingerprint"] != settings.fingerprint():
            raise BagError(f"folder {folder} holds a Monte Carlo of other settings; expected a new folder")
        return
    if folder.exists() and any(folder.iterdir()):
        raise BagError(f"folder {folder} is not empty and holds no Monte Carlo; expected a new one")
    folder.mkdir(parents=True, exist_ok=True)
    write_json(marker, {"fingerprint": settings.fingerprint(), "settings": asdict(settings)})


def _path(folder: Path, index: int) -> Path:
    return folder / f"runs_{index:05}.parquet"


def _write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    arrow, parquet = _arrow()
    partial = path.with_suffix(".part")
    parquet.write_table(arrow.table(dict(columns)), partial, compression="zstd")
    partial.replace(path)


def _arrow() -> tuple[Any, Any]:
    """Return pyarrow and its Parquet module.

    Raises:
        ParameterError: It cannot be imported.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        reason = str(error).splitlines()[0]
        raise ParameterError(f"Parquet needs pyarrow, which cannot be imported: {reason}") from error
    return pyarrow, pyarrow.parquet


def _wilson(hits: int, runs: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability (Wilson, 1927), good at 0 and 1 too."""
    z = 1.959963984540054
    share = hits / runs
    centre = (share + z * z / (2.0 * runs)) / (1.0 + z * z / runs)
    half = z * math.sqrt(share * (1.0 - share) / runs + z * z / (4.0 * runs * runs)) / (1.0 + z * z / runs)
    return max(0.0, centre - half), min(1.0, centre + half)
