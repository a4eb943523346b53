"""From which starts is a plant of several joints brought to rest upright, over its uncertainty?

A grid over two of its positions or velocities, the others as upright at rest, run for many plants through the batch
engine; chunks and files are those of :mod:`pendulum_bags.studies.start_grid`. Plant 0 is the nominal one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.joint_run import design_for
from pendulum_bags.studies.chunks import chunk_path, read_columns
from pendulum_bags.studies.joint_monte_carlo import scatter
from pendulum_bags.studies.random_runs import Columns
from pendulum_bags.studies.start_grid import StartGrid, inside_ellipse, share_inside
from pendulum_lqr.controller_interface.loop_check import settling_lqr
from pendulum_lqr.linear.design import DesignError, Gain
from pendulum_lqr.linear.roa import sublevel_ellipse
from pendulum_lqr.swing_up.mechanism_catch import CaughtRegion, sample_caught_region
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["Axis", "JointRegion", "JointRegionResult"]

VELOCITY = "_dot"
"""Ending of the names of velocities, as the linear model's states have it."""


@dataclass(frozen=True)
class Axis:
    """One axis of the grid.

    Attributes:
        name: A joint, or a joint and ``_dot`` for its velocity.
        span: Half width of the grid about upright at rest.
        unit: Unit of both.
        index: Which of the states [positions, velocities] it is.
    """

    name: str
    span: float
    unit: str
    index: int


@dataclass(frozen=True)
class JointRegion(StartGrid):
    """What to map of a plant of several joints; its own LQR is designed on the nominal plant.

    Attributes:
        axes: Names of the two axes, joints or ``JOINT_dot``; empty for the positions of the first two joints.
        spans: Half widths of the grid along them [rad, m, rad/s or m/s].
        shares: Standard deviation of parameters as a share of their value, by name; others are known.
    """

    RUNS_OF_CHUNK: ClassVar[int] = 10_000

    plants: int = 10
    points: int = 41
    axes: tuple[str, ...] = ()
    spans: tuple[float, float] = (1.0, 1.0)
    shares: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        super().__post_init__()
        _ = self.both

    @property
    def ranges(self) -> tuple[tuple[str, float, str, float, float], ...]:
        """What else has a range."""
        return (("first span", self.spans[0], "", 1e-6, 1e4), ("second span", self.spans[1], "", 1e-6, 1e4))

    @property
    def both(self) -> tuple[Axis, Axis]:
        """The two axes.

        Raises:
            ParameterError: There are not two, or one is no position or velocity of the plant.
        """
        joints = load_mechanism(self.plant).coordinates.joints
        names = [joint.name for joint in joints] + [joint.name + VELOCITY for joint in joints]
        units = [joint.unit for joint in joints] + [joint.velocity_unit for joint in joints]
        chosen = self.axes or tuple(names[:2])
        for name in chosen:
            if name not in names:
                raise ParameterError(f"axis is {name!r}; expected two of {', '.join(names)}")
        if len(chosen) != 2 or chosen[0] == chosen[1]:
            raise ParameterError(f"axes are {', '.join(chosen)}; expected two different ones of {', '.join(names)}")
        first, second = (
            Axis(name, span, units[names.index(name)], names.index(name))
            for name, span in zip(chosen, self.spans, strict=True)
        )
        return first, second

    def starts(self) -> tuple[Array, Array]:
        """Return deviations from upright at rest along both axes, shape (points,) each."""
        first, second = (np.linspace(-axis.span, axis.span, self.points) for axis in self.both)
        return first, second

    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant, for a fingerprint."""
        return load_mechanism(self.plant).numbers

    def job(self) -> PlantParameters:
        """Return the nominal plant."""
        return load_mechanism(self.plant)

    def gain(self, plant: PlantParameters) -> Gain:
        """Return the plant's own LQR."""
        return settling_lqr(design_for(plant), *plant.mechanism.weights, self.dt)

    def run_chunk(self, plant: PlantParameters, index: int, threads: int | None) -> Columns:
        """Run a chunk and return its columns."""
        numbers, generator = self.chunk(index)
        count = len(numbers)
        drawn = scatter(plant, self.shares, self.plants_of_chunk, generator)
        if index == 0:
            for name, values in drawn.items():
                values[0] = plant.value(name)
        x, y = np.meshgrid(*self.starts())
        size, n = x.size, len(plant.joints)
        states = np.tile(np.array([*plant.coordinates.goal, *(0.0,) * n]), (size, 1))
        for axis, deviation in zip(self.both, (x, y), strict=True):
            states[:, axis.index] += deviation.ravel()
        result = simulate_batch(
            plant,
            variations={name: np.repeat(values[:count], size) for name, values in drawn.items()},
            steps=self.steps,
            dt=self.dt,
            position=np.tile(states[:, :n], (count, 1)),
            velocity=np.tile(states[:, n:], (count, 1)),
            gain=self.gain(plant).rows,
            threads=threads,
            device=self.device,
        )
        off = np.array([plant.coordinates.deviation(tuple(position)) for position in result.position])
        near = (np.abs(off) < self.tolerance[0]).all(axis=1)
        near &= (np.abs(result.velocity) < self.tolerance[1]).all(axis=1)
        plants = np.repeat(numbers, size)
        every = {name: np.repeat(values[:count], size) for name, values in drawn.items()}
        ends = {f"end_{name}": off[:, i] for i, name in enumerate(plant.coordinates.names)}
        return {"plant": plants, **every, **ends, "attracted": near}

    def summarise(self, folder: Path) -> JointRegionResult:
        """Return the map, from the Parquet files."""
        plant = load_mechanism(self.plant)
        shape = (self.points, self.points)
        hits, believed = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.bool_)
        for index in range(self.chunks):
            attracted = read_columns(chunk_path(folder, index), ("attracted",))["attracted"].reshape(-1, *shape)
            hits += attracted.sum(axis=0)
            if index == 0:
                believed = attracted[0]
        gain = self.gain(plant)
        try:
            caught: CaughtRegion | None = sample_caught_region(plant, gain)
        except DesignError:
            caught = None
        if caught is None:
            return JointRegionResult(self, hits / self.plants, believed, None, np.empty((0, 2)), math.nan)
        at = [axis.index for axis in self.both]
        S = np.asarray(gain.S)[np.ix_(at, at)]
        inside = inside_ellipse(S, caught.level, *np.meshgrid(*self.starts()))
        share = share_inside(hits, inside, self.plants)
        section = sublevel_ellipse(S, caught.level)
        return JointRegionResult(self, hits / self.plants, believed, caught, section, share)


@dataclass(frozen=True)
class JointRegionResult:
    """The map.

    Attributes:
        settings: What was mapped.
        share: Share of the plants that come to rest upright, shape (second axis, first axis).
        believed: Whether the nominal plant does, same shape.
        caught: States that the LQR catches, by sampling the model without dry friction; None where none were found.
        section: Edge of these states in the plane of the map, shape (k, 2); empty without them.
        share_in_section: Share of all runs from inside that come to rest upright; NaN without such a start.
    """

    settings: JointRegion
    share: Array
    believed: NDArray[np.bool_]
    caught: CaughtRegion | None
    section: Array
    share_in_section: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON values; the map itself is in the Parquet file."""
        return {
            "settings": asdict(self.settings),
            "axes": [asdict(axis) for axis in self.settings.both],
            "runs": self.settings.plants * self.share.size,
            "share": float(self.share.mean()),
            "share_believed": float(self.believed.mean()),
            "caught_level": None if self.caught is None else self.caught.level,
            "share_in_section": self.share_in_section if math.isfinite(self.share_in_section) else None,
        }

    def columns(self) -> Columns:
        """Return the map, a row for each start."""
        first, second = np.meshgrid(*self.settings.starts())
        names = [axis.name for axis in self.settings.both]
        columns = {names[0]: first.ravel(), names[1]: second.ravel(), "share": self.share.ravel()}
        return {**columns, "attracted_believed": self.believed.ravel()}
