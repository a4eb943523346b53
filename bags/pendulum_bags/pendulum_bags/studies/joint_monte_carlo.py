"""Closed-loop runs of a plant of several joints over its uncertainty: parameters, noise and start.

The plant is held upright by its own LQR, as in ``experiment joints``. Chunks, seeds and files are those of
:mod:`pendulum_bags.studies.random_runs`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.joint_run import LIMIT_PER_NOISE, design_for, identified_names
from pendulum_bags.studies.random_runs import Columns, RandomRuns, figures_of_runs, replay
from pendulum_bags.studies.uncertain import share_of_interval
from pendulum_lqr.controller_interface.loop_check import settling_lqr
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, load_plant_file
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["JointMonteCarlo", "joint_shares", "scatter"]


@dataclass(frozen=True)
class JointMonteCarlo(RandomRuns):
    """What to draw and to run, of a plant of several joints; see :class:`RandomRuns`.

    Attributes:
        shares: Standard deviation of parameters as a share of their value, by name; others are known.
        amplitude: None for a tenth of each driven joint's effort limit.
    """

    shares: Mapping[str, float] = field(default_factory=dict)

    def load(self) -> PlantParameters:
        """Return the nominal plant."""
        return load_mechanism(self.plant)

    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant."""
        return self.load().numbers

    def draw(self, plant: PlantParameters, count: int, generator: np.random.Generator) -> Columns:
        """Return parameters and starts of a number of runs."""
        drawn: Columns = {**scatter(plant, self.shares, count, generator)}
        for name, goal in zip(plant.coordinates.names, plant.coordinates.goal, strict=True):
            drawn[f"start_{name}"] = goal + self.start * generator.uniform(-1.0, 1.0, count)
        return drawn

    def simulate(
        self, plant: PlantParameters, drawn: Columns, threads: int | None = None, *, record: bool = False
    ) -> tuple[Columns, Array | None]:
        """Run what was drawn; see :class:`RandomRuns`."""
        limits = np.array(plant.effort_limits)
        result = simulate_batch(
            plant,
            variations={name: drawn[name] for name in self.shares},
            steps=self.steps,
            dt=self.dt,
            position=np.stack([drawn[f"start_{name}"] for name in plant.coordinates.names], axis=1),
            gain=settling_lqr(design_for(plant), *plant.mechanism.weights, self.dt).rows,
            seeds=drawn["noise_seed"],
            amplitude=limits / LIMIT_PER_NOISE if self.amplitude is None else self.amplitude,
            hold=max(1, round(self.hold_time / self.dt)),
            record=record,
            threads=threads,
            device=self.device,
        )
        columns = dict(drawn)
        for i, name in enumerate(plant.coordinates.names):
            columns[f"max_{name}"] = result.max_deviation[:, i]
            columns[f"std_{name}"] = result.std_deviation[:, i]
            columns[f"end_{name}"] = result.position[:, i]
            columns[f"end_velocity_{name}"] = result.velocity[:, i]
        for i, name in enumerate(plant.coordinates.driven_names):
            columns[f"max_effort_{name}"] = result.max_effort[:, i]
        return columns, result.trajectories

    def summarise(self, folder: Path) -> dict[str, Any]:
        """Return the probability that all joints stay within the bound, quantiles and the worst runs."""
        coordinates = self.load().coordinates
        units = {f"{what}_{joint.name}": joint.unit for what in ("max", "std") for joint in coordinates.joints}
        for joint in (coordinates.joints[i] for i in coordinates.driven):
            units[f"max_effort_{joint.name}"] = joint.effort_unit
        figures, _ = figures_of_runs(
            folder,
            self,
            units,
            lambda columns: np.max([columns[f"max_{name}"] for name in coordinates.names], axis=0),
            lambda run, farthest: {"max_deviation": farthest, **replay(self, run)[0]},
        )
        return {**figures, "joints": list(coordinates.names), "units": units}


def joint_shares(text: str, plant: str) -> dict[str, float]:
    """Return the uncertainty of the parameters of a plant of several joints, by name.

    Args:
        text: ``identified`` for the intervals of the plant file, one share for all that an identification finds, such
            as ``0.05``, or ``NAME=SHARE,...``, such as ``cart_mass=0.1,pole.damping=0.5``.
        plant: Preset or plant file.

    Raises:
        ParameterError: A name is none of the plant, a share is none, or the file has no intervals.
    """
    parameters = load_mechanism(plant)
    names = identified_names(parameters)
    if text.strip() == "identified":
        intervals = load_plant_file(plant)[1].get("intervals", {}) if Path(plant).suffix else {}
        found = {name: share_of_interval(interval, parameters.value(name)) for name, interval in intervals.items()}
        found = {name: share for name, share in found.items() if share > 0.0}
        if not found:
            raise ParameterError(f"plant {plant} has no intervals; expected the file of an identification")
        return found
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if len(parts) == 1 and "=" not in parts[0]:
        parts = [f"{name}={parts[0]}" for name in names if parameters.value(name) != 0.0]
    shares: dict[str, float] = {}
    for part in parts:
        name, _, value = (piece.strip() for piece in part.partition("="))
        try:
            share = float(value)
        except ValueError:
            raise ParameterError(
                f"uncertainty has {part!r}; expected identified, one share, or NAME=SHARE, such as {names[0]}=0.05"
            ) from None
        if name not in names:
            raise ParameterError(f"uncertainty of {name!r} is unknown; expected one of {', '.join(names)}")
        if not (math.isfinite(share) and 0.0 <= share <= 1.0):
            raise ParameterError(f"uncertainty of {name} is {share}; expected a share from 0 to 1")
        shares[name] = share
    return shares


def scatter(
    plant: PlantParameters, shares: Mapping[str, float], count: int, generator: np.random.Generator
) -> dict[str, Array]:
    """Return values of uncertain parameters, shape (count,) each: log-normal and independent, for no mass is negative.

    Args:
        plant: The nominal plant.
        shares: Standard deviation of each value, as a share of it.
        count: How many plants.
        generator: Of the draw.
    """
    drawn = {}
    for name, share in shares.items():
        # Mean and deviation are those of the value, not of its logarithm.
        spread = math.sqrt(math.log1p(share**2))
        drawn[name] = plant.value(name) * np.exp(spread * generator.standard_normal(count) - 0.5 * spread**2)
    return drawn
