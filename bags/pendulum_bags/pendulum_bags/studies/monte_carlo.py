"""A million closed-loop runs over uncertain parameters, noise and starts; chunked, restartable, distributed.

Chunk c draws its plants from the stream (seed, c) and its noise from seeds of its own, so a result depends neither on
the number of workers nor on the order in which they finish, bit for bit.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.studies.random_runs import Columns, RandomRuns, figures_of_runs, replay
from pendulum_bags.studies.uncertain import THESIS_UNCERTAINTY, VARIED, Uncertainty, batch_variations
from pendulum_lqr.controller_interface.loop_check import settling_lqr
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["COLUMNS", "MonteCarlo", "sobol"]

COLUMNS = (*VARIED, "noise_seed", "theta_0", "max_theta", "max_effort", "std_theta", "theta_end", "theta_dot_end")
"""Columns of the Parquet files; SI units."""


@dataclass(frozen=True)
class MonteCarlo(RandomRuns):
    """What to draw and to run, of a pendulum; see :class:`RandomRuns`.

    Attributes:
        uncertainty: Of its parameters.
        q: Diagonal of Q.
        r: R.
        amplitude: Largest noise torque [N m].
        method: Integrator.
    """

    UNITS: ClassVar[tuple[str, str]] = ("rad", "N m")

    plant: str = "thesis"
    runs: int = 1_000_000
    uncertainty: Uncertainty = THESIS_UNCERTAINTY
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

    def load(self) -> PlantParameters:
        """Return the nominal plant."""
        return load_plant(self.plant)

    def draw(self, plant: PlantParameters, count: int, generator: np.random.Generator) -> Columns:
        """Return parameters and starts of a number of runs."""
        values = self.uncertainty.draw(plant, count, generator)
        return {**values, "theta_0": UPRIGHT + self.start * generator.uniform(-1.0, 1.0, count)}

    def simulate(
        self, plant: PlantParameters, drawn: Columns, threads: int | None = None, *, record: bool = False
    ) -> tuple[Columns, Array | None]:
        """Run what was drawn; see :class:`RandomRuns`."""
        if plant.drivetrain is not None:
            raise ParameterError(
                f"plant {plant.name!r} is series elastic; expected a rigid one: the batch has no motor"
            )
        result = simulate_batch(
            plant,
            variations=batch_variations(plant, drawn),
            steps=self.steps,
            dt=self.dt,
            method=self.method,
            position=drawn["theta_0"],
            gain=settling_lqr(plant, self.q, self.r, self.dt).K,
            seeds=drawn["noise_seed"],
            amplitude=self.amplitude,
            hold=max(1, round(self.hold_time / self.dt)),
            record=record,
            threads=threads,
            device=self.device,
        )
        columns = {
            **drawn,
            "max_theta": result.max_deviation[:, 0],
            "max_effort": result.max_effort[:, 0],
            "std_theta": result.std_deviation[:, 0],
            "theta_end": result.position[:, 0],
            "theta_dot_end": result.velocity[:, 0],
        }
        return {name: columns[name] for name in COLUMNS}, result.trajectories

    def summarise(self, folder: Path) -> dict[str, Any]:
        """Return the probability of staying inside the bound, quantiles and the worst runs, from the Parquet files."""
        figures, values = figures_of_runs(
            folder,
            self,
            ("max_theta", "max_effort", "std_theta", "theta_end"),
            lambda columns: columns["max_theta"],
            lambda run, _: replay(self, run)[0],
        )
        del figures["quantiles"]["theta_end"]
        return {**figures, "converged": float(np.mean(np.abs(wrap(values["theta_end"] - UPRIGHT)) < 0.1))}


def sobol(settings: MonteCarlo, *, base: int = 4096) -> dict[str, Any]:
    """Return first-order and total Sobol indices of the spread of theta over parameters, noise and start.

    The indices are those of independent factors: a correlation of the parameters is left out here.

    Args:
        settings: Distributions and loop; ``runs`` is not used.
        base: Base sample of Saltelli's scheme, a power of two; it takes base (D + 2) runs for D factors.

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
    drawn: Columns = {**settings.uncertainty.scatter(plant, normals, correlated=False)}
    start = 2.0 * unit[:, factors.index("start")] - 1.0 if "start" in factors else np.zeros(count)
    drawn["theta_0"] = UPRIGHT + settings.start * start
    # The noise as one factor: which of a thousand million signals.
    drawn["noise_seed"] = (unit[:, factors.index("noise")] * 1e9).astype(np.int64)
    columns, _ = settings.simulate(plant, drawn)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # SALib's own use of pandas
        warnings.simplefilter("ignore", RuntimeWarning)  # what does not vary has no shares: they are NaN
        found = analysis.analyze(problem, columns["std_theta"], calc_second_order=False, seed=settings.seed)
    return {
        "output": "std_theta",
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
