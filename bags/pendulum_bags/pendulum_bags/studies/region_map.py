"""Starts from which upright is reached under the torque limit, over the plant's uncertainty.

A grid of starts over two positions or velocities, the others as upright at rest, run for many plants in the batch
engine; plant 0 is nominal. The region that the LQR's model attracts belongs inside: the proven ellipse of the linear
analysis for one joint, a sampled section for several.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.chunks import Connect, chunk_path, open_results, read_columns, run_chunks, write_columns
from pendulum_bags.studies.closed_loops import ClosedLoops, Columns
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.roa import proven_level, sublevel_ellipse
from pendulum_lqr.swing_up.catch import sample_caught_region
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.batches.batch import simulate_batch

__all__ = ["Axis", "RegionMap", "RegionResult", "run_map"]

_VELOCITY = "_dot"
"""Ending of the names of velocities, as the linear model's states have it."""
_TWO_PI = 2.0 * math.pi


@dataclass(frozen=True)
class Axis:
    """One axis of the grid: a joint, or a joint and ``_dot``; ``index`` into [positions, velocities]."""

    name: str
    span: float
    unit: str
    index: int


@dataclass(frozen=True)
class RegionMap(ClosedLoops):
    """What to map.

    Attributes:
        plants: Plants at each start, the nominal one first; 1 leaves the uncertainty out.
        points: Points along each axis of the grid; an odd number has upright at rest among them.
        tolerance: Largest final distance from upright [rad or m] and from rest [rad/s or m/s] that counts as upright.
        effort_limit: Torque limit of one joint [N m]; 0 for the plant's own.
        angle_span: Half width of the grid of one joint about upright [rad].
        velocity_span: Its half width in velocity [rad/s].
        axes: The two axes of several joints, joints or ``JOINT_dot``; empty for the positions of the first two.
        spans: Half widths of the grid along them [rad, m, rad/s or m/s].
    """

    OF_SEVERAL: ClassVar[Mapping[str, Any]] = {"plants": 10, "points": 41}
    ONE_ONLY: ClassVar[frozenset[str]] = ClosedLoops.ONE_ONLY | {"effort_limit", "angle_span", "velocity_span"}
    SEVERAL_ONLY: ClassVar[frozenset[str]] = frozenset({"axes", "spans"})
    RUNS_OF_CHUNK: ClassVar[tuple[int, int]] = (50_000, 10_000)
    """Runs of a chunk, about, of one joint and of several."""

    duration: float = 8.0
    plants: int = 100
    points: int = 61
    tolerance: tuple[float, float] = (0.1, 0.2)
    effort_limit: float = 0.0
    angle_span: float = math.pi
    velocity_span: float = 10.0
    axes: tuple[str, ...] = ()
    spans: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        one = (
            ("angle_span", self.angle_span, " rad", 1e-6, math.pi),
            ("velocity_span", self.velocity_span, " rad/s", 1e-6, 1e4),
            ("effort_limit", self.effort_limit, " N m", 0.0, 1e9),
        )
        several = (("first span", self.spans[0], "", 1e-6, 1e4), ("second span", self.spans[1], "", 1e-6, 1e4))
        for name, value, unit, low, high in (
            ("plants", self.plants, "", 1, 1_000_000),
            ("points", self.points, "", 3, 2001),
            ("seed", self.seed, "", 0, 2**63 - 1),
            ("duration", self.duration, " s", self.dt, 1e4),
            *(one if self.is_of_one else several),
        ):
            if not low <= value <= high:
                raise ParameterError(f"{name} is {value}{unit}; expected {low:g} to {high:g}{unit}")
        _ = self.both

    @property
    def is_of_one(self) -> bool:
        """Whether the plant has one joint, whose region is proven."""
        return self.nominal.is_pendulum

    @cached_property
    def nominal(self) -> PlantParameters:
        """The nominal plant, with the torque limit of the loop."""
        plant = super().nominal
        return plant.with_values(effort_limit=self.effort_limit) if self.effort_limit > 0.0 else plant

    @cached_property
    def both(self) -> tuple[Axis, Axis]:
        """The two axes; a ParameterError unless there are two, each a position or velocity of the plant."""
        if self.is_of_one:
            return Axis("theta", self.angle_span, "rad", 0), Axis("theta_dot", self.velocity_span, "rad/s", 1)
        joints = self.nominal.coordinates.joints
        names = [joint.name for joint in joints] + [joint.name + _VELOCITY for joint in joints]
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

    @property
    def plants_of_chunk(self) -> int:
        """Plants in a chunk; part of the result's definition."""
        return max(1, self.RUNS_OF_CHUNK[not self.is_of_one] // self.points**2)

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.plants // self.plants_of_chunk)


def _run_chunk(settings: RegionMap, index: int, threads: int | None) -> Columns:
    plant, first = settings.nominal, index * settings.plants_of_chunk
    numbers = np.arange(first, min(first + settings.plants_of_chunk, settings.plants), dtype=np.int32)
    count = len(numbers)
    # Of several joints a chunk is drawn whole, of one the plants that it has: both are part of the results' definition.
    size = count if settings.is_of_one else settings.plants_of_chunk
    drawn = settings.uncertainty.draw(plant, size, settings.generator(index))
    if index == 0:
        for name, values in drawn.items():
            values[0] = plant.value(name)
    x, y = np.meshgrid(*settings.starts())
    n = len(plant.joints)
    states = np.tile(np.array([*plant.coordinates.goal, *(0.0,) * n]), (x.size, 1))
    for axis, deviation in zip(settings.both, (x, y), strict=True):
        states[:, axis.index] += deviation.ravel()
    states = np.tile(states, (count, 1))
    every = {name: np.repeat(values[:count], x.size) for name, values in drawn.items()}
    result = simulate_batch(
        plant,
        variations=settings.uncertainty.variations(plant, every),
        steps=settings.steps,
        dt=settings.dt,
        method=settings.method,
        position=states[:, :n],
        velocity=states[:, n:],
        gain=settings.gain.rows,
        threads=threads,
        device=settings.device,
    )
    positions: Any = result.position.T
    off = np.array(plant.coordinates.deviation(positions))
    near: Any = (np.abs(off) < settings.tolerance[0]).all(axis=0)
    near &= (np.abs(result.velocity) < settings.tolerance[1]).all(axis=1)
    columns: Columns = {"plant": np.repeat(numbers, x.size), **every}
    if settings.is_of_one:
        columns |= {"theta_0": states[:, 0], "theta_dot_0": states[:, 1]}
        columns |= {"theta_end": result.position[:, 0], "theta_dot_end": result.velocity[:, 0]}
    else:
        columns |= {f"end_{name}": values for name, values in zip(plant.coordinates.names, off, strict=True)}
    return {**columns, "attracted": near}


def run_map(
    folder: Path,
    settings: RegionMap,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> RegionResult:
    """Run the chunks that are not on disk, one Parquet file each, and write the map and its figures.

    Args:
        folder: For the files; one of the same settings is continued.
        connect: To a Dask cluster (`cluster_client`); by default in this process, on all cores.

    Raises:
        BagError: The folder holds something else.
        ParameterError: A start lies beyond an end stop, or a drawn plant has no positive inertia.
    """
    open_results(folder, "map", settings.fingerprint(), settings.content())
    run_chunks(folder, _run_chunk, settings, settings.chunks, connect=connect, on_progress=on_progress)
    result = _map(folder, settings)
    write_columns(folder / "map.parquet", result.columns())
    write_json(folder / "region.json", result.to_json())
    return result


def _map(folder: Path, settings: RegionMap) -> RegionResult:
    shape = (settings.points, settings.points)
    hits, turned = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    believed = np.zeros(shape, dtype=np.bool_)
    moving = 0
    ends = ("theta_end", "theta_dot_end") if settings.is_of_one else ()
    for index in range(settings.chunks):
        columns = read_columns(chunk_path(folder, index), ("attracted", *ends))
        attracted = columns["attracted"].reshape(-1, *shape)
        hits += attracted.sum(axis=0)
        if index == 0:
            believed = attracted[0]
        if ends:
            angle, velocity = (columns[name].reshape(-1, *shape) for name in ends)
            turned += (attracted & (np.round((angle - UPRIGHT) / _TWO_PI) != 0.0)).sum(axis=0)
            # Negated, so that NaN counts as moving.
            moving += int((~attracted & ~(np.abs(velocity) < settings.tolerance[1])).sum())
    level = _level(settings)
    at = [axis.index for axis in settings.both]
    S = np.asarray(settings.gain.S)[np.ix_(at, at)]
    x, y = np.meshgrid(*settings.starts())
    inside = np.zeros(shape, dtype=np.bool_)
    if level is not None:
        inside = S[0, 0] * x * x + 2.0 * S[0, 1] * x * y + S[1, 1] * y * y <= level
    return RegionResult(
        settings=settings,
        share=hits / settings.plants,
        believed=believed,
        turned=turned / settings.plants,
        moving=moving / (settings.plants * settings.points**2),
        level=level,
        section=np.empty((0, 2)) if level is None else sublevel_ellipse(S, level),
        counterexamples=int(np.count_nonzero(inside & ~believed)),
        share_inside=float(hits[inside].sum() / (settings.plants * inside.sum())) if inside.any() else math.nan,
    )


def _level(settings: RegionMap) -> float | None:
    """Return c of the region x' S x <= c that the model attracts, or None."""
    plant = settings.nominal
    if settings.is_of_one:
        return proven_level(plant, settings.gain, plant.effort_limit)
    try:
        return sample_caught_region(plant, settings.gain).level
    except DesignError:
        return None


@dataclass(frozen=True)
class RegionResult:
    """The map.

    Attributes:
        share: Share of the plants that reach upright, shape (second axis, first axis).
        believed: Whether the nominal plant does, same shape.
        turned: Share of the plants of one joint that reach it after a whole turn, same shape.
        moving: Share of runs of one joint that reached neither upright nor rest: a longer duration may decide them.
        level: c of the region x' S x <= c that the LQR attracts without dry friction: proven for the nominal plant of
            one joint, sampled for several; None if none was found.
        section: Its boundary in the plane of the map, deviations from upright, shape (k, 2), or empty.
        counterexamples: Starts inside from which the nominal plant does not reach upright; expected 0.
        share_inside: Share of all runs from inside that reach upright; NaN without such a start.
    """

    settings: RegionMap
    share: Array
    believed: NDArray[np.bool_]
    turned: Array
    moving: float
    level: float | None
    section: Array
    counterexamples: int
    share_inside: float

    @property
    def axes(self) -> tuple[Array, Array]:
        """Starts of one joint along both axes: angles [rad], velocities [rad/s], shape (points,) each."""
        angle, velocity = self.settings.starts()
        return UPRIGHT + angle, velocity

    def _area(self, where: NDArray[np.bool_]) -> float:
        theta, theta_dot = self.axes
        return float(np.count_nonzero(where)) * float((theta[1] - theta[0]) * (theta_dot[1] - theta_dot[0]))

    @property
    def area(self) -> float:
        """Area from which at least half of the plants reach upright, of one joint [rad^2/s]."""
        return self._area(self.share >= 0.5)

    @property
    def certain_area(self) -> float:
        """Area from which every plant reaches upright, of one joint [rad^2/s]."""
        return self._area(self.share == 1.0)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON values; the map itself is in the Parquet file."""
        settings = self.settings
        inside = self.share_inside if math.isfinite(self.share_inside) else None
        content = {"settings": settings.content(), "runs": settings.plants * self.share.size}
        if not settings.is_of_one:
            return {
                **content,
                "axes": [asdict(axis) for axis in settings.both],
                "share": float(self.share.mean()),
                "share_believed": float(self.believed.mean()),
                "caught_level": self.level,
                "share_in_section": inside,
            }
        return {
            **content,
            "effort_limit": settings.nominal.effort_limit,
            "area": self.area,
            "certain_area": self.certain_area,
            "believed_area": self._area(self.believed),
            "proven_level": self.level,
            "counterexamples": self.counterexamples,
            "share_in_ellipse": inside,
            "still_moving": self.moving,
        }

    def columns(self) -> Columns:
        """Return the map, a row for each start."""
        plants = self.settings.plants
        if not self.settings.is_of_one:
            starts = np.meshgrid(*self.settings.starts())
            found = {axis.name: values.ravel() for axis, values in zip(self.settings.both, starts, strict=True)}
            return {**found, "share": self.share.ravel(), "attracted_believed": self.believed.ravel()}
        theta, theta_dot = np.meshgrid(*self.axes)
        return {
            "theta_0": theta.ravel(),
            "theta_dot_0": theta_dot.ravel(),
            "plants": np.full(theta.size, plants, dtype=np.int64),
            "attracted": np.rint(self.share * plants).astype(np.int64).ravel(),
            "share": self.share.ravel(),
            "attracted_believed": self.believed.ravel(),
            "turned": self.turned.ravel(),
        }
