"""From which starts is upright reached under the torque limit, over the plant's uncertainty?

A grid of starts (theta, theta'), run for many plants through the batch engine; chunk by chunk as the Monte Carlo is,
so that neither the number of workers nor an interruption changes a bit. Plant 0 is the nominal one. The
ellipse of the linear analysis, proven for that plant, belongs inside.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.studies.chunks import chunk_path, read_columns
from pendulum_bags.studies.random_runs import Columns
from pendulum_bags.studies.start_grid import StartGrid, inside_ellipse, share_inside
from pendulum_bags.studies.uncertain import THESIS_UNCERTAINTY, VARIED, Uncertainty, batch_variations
from pendulum_lqr.controller_interface.loop_check import settling_lqr
from pendulum_lqr.linear.design import Gain
from pendulum_lqr.linear.roa import proven_level, sublevel_ellipse
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["COLUMNS", "RegionMap", "RegionResult"]

COLUMNS = ("plant", *VARIED, "theta_0", "theta_dot_0", "theta_end", "theta_dot_end", "attracted")
"""Columns of the Parquet files of the runs; SI units, ``plant`` counts the plants from 0."""
MAP_COLUMNS = ("theta_0", "theta_dot_0", "plants", "attracted", "share", "attracted_believed", "turned")

_TWO_PI = 2.0 * math.pi


@dataclass(frozen=True)
class RegionMap(StartGrid):
    """What to map of a plant of one joint.

    Attributes:
        uncertainty: Of its parameters.
        q: Diagonal of Q.
        r: R.
        effort_limit: Torque limit [N m]; 0 for the plant's own.
        angle_span: Half width of the grid about upright [rad].
        velocity_span: Its half width in velocity [rad/s].
        method: Integrator.
    """

    RUNS_OF_CHUNK: ClassVar[int] = 50_000

    plant: str = "thesis"
    uncertainty: Uncertainty = THESIS_UNCERTAINTY
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    effort_limit: float = 0.0
    angle_span: float = math.pi
    velocity_span: float = 10.0
    method: str = "etd2"

    @property
    def ranges(self) -> tuple[tuple[str, float, str, float, float], ...]:
        """What else has a range."""
        return (
            ("angle_span", self.angle_span, " rad", 1e-6, math.pi),
            ("velocity_span", self.velocity_span, " rad/s", 1e-6, 1e4),
            ("effort_limit", self.effort_limit, " N m", 0.0, 1e9),
        )

    def grid(self) -> tuple[Array, Array]:
        """Return start angles [rad] and velocities [rad/s], shape (points,) each."""
        return (
            UPRIGHT + np.linspace(-self.angle_span, self.angle_span, self.points),
            np.linspace(-self.velocity_span, self.velocity_span, self.points),
        )

    def believed(self) -> PlantParameters:
        """Return the plant with the torque limit of the loop.

        Raises:
            ParameterError: The plant is no rigid one.
        """
        plant = load_plant(self.plant)
        if plant.drivetrain is not None:
            raise ParameterError(f"plant {self.plant!r} is series elastic; expected a rigid one")
        return plant.with_values(effort_limit=self.effort_limit or plant.effort_limit)

    def gain(self) -> Gain:
        """Return the LQR gain."""
        return settling_lqr(self.believed(), self.q, self.r, self.dt)

    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant, for a fingerprint."""
        plant = self.believed()
        return {**plant.numbers, "drivetrain": None, "name": plant.name}

    def job(self) -> tuple[PlantParameters, tuple[float, ...]]:
        """Return the nominal plant, and the gain."""
        return self.believed(), tuple(float(value) for value in self.gain().K)

    def run_chunk(self, job: tuple[PlantParameters, tuple[float, ...]], index: int, threads: int | None) -> Columns:
        """Run a chunk and return its columns."""
        plant, gain = job
        numbers, generator = self.chunk(index)
        count = len(numbers)
        drawn = self.uncertainty.draw(plant, count, generator)
        if index == 0:
            for name in VARIED:
                drawn[name][0] = getattr(plant, name)
        angles, velocities = self.grid()
        theta_dot, theta = (axis.ravel() for axis in np.meshgrid(velocities, angles, indexing="ij"))
        every = {name: np.repeat(values, theta.size) for name, values in drawn.items()}
        starts, speeds = np.tile(theta, count), np.tile(theta_dot, count)
        result = simulate_batch(
            plant,
            variations=batch_variations(plant, every),
            steps=self.steps,
            dt=self.dt,
            method=self.method,
            position=starts,
            velocity=speeds,
            gain=gain,
            threads=threads,
            device=self.device,
        )
        theta_end, theta_dot_end = result.position[:, 0], result.velocity[:, 0]
        near = (np.abs(wrap(theta_end - UPRIGHT)) < self.tolerance[0]) & (np.abs(theta_dot_end) < self.tolerance[1])
        columns: Columns = {
            "plant": np.repeat(numbers, theta.size),
            **every,
            "theta_0": starts,
            "theta_dot_0": speeds,
            "theta_end": theta_end,
            "theta_dot_end": theta_dot_end,
            "attracted": near,
        }
        return {name: columns[name] for name in COLUMNS}

    def summarise(self, folder: Path) -> RegionResult:
        """Return the map, from the Parquet files."""
        shape = (self.points, self.points)
        hits, rounds = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
        believed = np.zeros(shape, dtype=np.bool_)
        moving = 0
        for index in range(self.chunks):
            columns = read_columns(chunk_path(folder, index), ("attracted", "theta_end", "theta_dot_end"))
            attracted = columns["attracted"].reshape(-1, *shape)
            turns = np.round((columns["theta_end"].reshape(-1, *shape) - UPRIGHT) / _TWO_PI)
            hits += attracted.sum(axis=0)
            rounds += (attracted & (turns != 0.0)).sum(axis=0)
            velocity = np.abs(columns["theta_dot_end"].reshape(-1, *shape))
            # Written so that a run which is not a number any more counts as moving.
            moving += int((~attracted & ~(velocity < self.tolerance[1])).sum())
            if index == 0:
                believed = attracted[0]
        plant, gain = self.believed(), self.gain()
        level = proven_level(plant, gain, plant.effort_limit)
        theta, theta_dot = self.grid()
        x, v = np.meshgrid(theta - UPRIGHT, theta_dot)
        inside = inside_ellipse(gain.S, level, x, v)
        return RegionResult(
            settings=self,
            limit=plant.effort_limit,
            theta=theta,
            theta_dot=theta_dot,
            share=hits / self.plants,
            believed=believed,
            turned=rounds / self.plants,
            moving=moving / (self.plants * self.points**2),
            level=level,
            ellipse=sublevel_ellipse(gain.S, level),
            counterexamples=int(np.count_nonzero(inside & ~believed)),
            share_in_ellipse=share_inside(hits, inside, self.plants),
        )


@dataclass(frozen=True)
class RegionResult:
    """The map.

    Attributes:
        settings: What was mapped.
        limit: Torque limit [N m].
        theta: Start angles, shape (n,) [rad].
        theta_dot: Start velocities, shape (n,) [rad/s].
        share: Share of the plants that reach upright, shape (n velocities, n angles).
        believed: Whether the nominal plant does, same shape.
        turned: Share of the plants that reach it after going round, same shape.
        moving: Share of all runs that neither reached upright nor rest: a longer duration may decide them.
        level: c of the ellipse x' S x <= c, proven for the nominal plant without dry friction.
        ellipse: Its boundary: angle from upright [rad], velocity [rad/s], shape (k, 2).
        counterexamples: Starts inside the ellipse from which the nominal plant does not reach upright; 0 is right.
        share_in_ellipse: Share of all runs from inside the ellipse that reach upright; NaN without such a start.
    """

    settings: RegionMap
    limit: float
    theta: Array
    theta_dot: Array
    share: Array
    believed: NDArray[np.bool_]
    turned: Array
    moving: float
    level: float
    ellipse: Array
    counterexamples: int
    share_in_ellipse: float

    @property
    def area(self) -> float:
        """Area of the starts from which at least half of the plants reach upright, within the grid [rad^2/s]."""
        return float(np.count_nonzero(self.share >= 0.5)) * self._cell

    @property
    def certain_area(self) -> float:
        """Area of the starts from which every plant reaches upright, within the grid [rad^2/s]."""
        return float(np.count_nonzero(self.share == 1.0)) * self._cell

    @property
    def _cell(self) -> float:
        return float((self.theta[1] - self.theta[0]) * (self.theta_dot[1] - self.theta_dot[0]))

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON values; the map itself is in the Parquet file."""
        return {
            "settings": asdict(self.settings),
            "runs": self.settings.plants * self.share.size,
            "effort_limit": self.limit,
            "area": self.area,
            "certain_area": self.certain_area,
            "believed_area": float(np.count_nonzero(self.believed)) * self._cell,
            "proven_level": self.level,
            "counterexamples": self.counterexamples,
            "share_in_ellipse": self.share_in_ellipse if math.isfinite(self.share_in_ellipse) else None,
            "still_moving": self.moving,
        }

    def columns(self) -> Columns:
        """Return the map, a row for each start."""
        theta, theta_dot = np.meshgrid(self.theta, self.theta_dot)
        plants = self.settings.plants
        columns: Columns = {
            "theta_0": theta.ravel(),
            "theta_dot_0": theta_dot.ravel(),
            "plants": np.full(theta.size, plants, dtype=np.int64),
            "attracted": np.rint(self.share * plants).astype(np.int64).ravel(),
            "share": self.share.ravel(),
            "attracted_believed": self.believed.ravel(),
            "turned": self.turned.ravel(),
        }
        return {name: columns[name] for name in MAP_COLUMNS}
