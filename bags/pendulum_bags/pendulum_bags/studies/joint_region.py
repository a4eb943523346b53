"""From which starts is a plant of several joints brought to rest upright, over all that is not known of it?

A grid over two of its positions or velocities, the others as upright at rest, run for many plants through the batch
engine; chunks and files are those of :mod:`pendulum_bags.studies.region_map`. Plant 0 is the one that is believed in.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.joint_run import design_for
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.chunks import Connect, chunk_path, open_results, read_columns, run_chunks, write_columns
from pendulum_bags.studies.joint_monte_carlo import scatter
from pendulum_lqr.design import DesignError, Gain
from pendulum_lqr.mechanism_catch import CaughtRegion, sample_caught_region
from pendulum_lqr.mechanism_model import linearise_mechanism, mechanism_lqr
from pendulum_lqr.roa import sublevel_ellipse
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism
from pendulum_sim.mechanism_batch import simulate_mechanisms

__all__ = ["Axis", "JointRegion", "JointRegionResult", "run_joint_region"]

Array = NDArray[np.float64]

_RUNS_OF_CHUNK = 10_000
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
class JointRegion:
    """What to map.

    Attributes:
        plant: Preset or file of the plant that is believed in; its own LQR is designed on it.
        axes: Names of the two axes, joints or ``JOINT_dot``; empty for the positions of the first two joints.
        spans: Half widths of the grid along them [rad, m, rad/s or m/s].
        shares: Standard deviation of parameters as a share of their value, by name; others are known.
        plants: Plants at each start, the believed one first; 1 leaves the uncertainty out.
        points: Points along each axis; an odd number has upright at rest among them.
        duration: Of each run [s].
        dt: Period of the loop [s].
        tolerance: Largest deviation of a position [rad or m] and velocity at the end that count as upright at rest.
        seed: Seed of the plants.
    """

    plant: str
    axes: tuple[str, ...] = ()
    spans: tuple[float, float] = (1.0, 1.0)
    shares: Mapping[str, float] = field(default_factory=dict)
    plants: int = 10
    points: int = 41
    duration: float = 8.0
    dt: float = 0.002
    tolerance: tuple[float, float] = (0.1, 0.2)
    seed: int = 1

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        for name, value, low, high in (
            ("plants", self.plants, 1, 1_000_000),
            ("points", self.points, 3, 2001),
            ("seed", self.seed, 0, 2**63 - 1),
            ("duration", self.duration, self.dt, 1e4),
            ("first span", self.spans[0], 1e-6, 1e4),
            ("second span", self.spans[1], 1e-6, 1e4),
        ):
            if not low <= value <= high:
                raise ParameterError(f"{name} is {value}; expected {low:g} to {high:g}")
        _ = self.both

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

    @property
    def plants_of_chunk(self) -> int:
        """Plants in a chunk; part of the result's definition."""
        return max(1, _RUNS_OF_CHUNK // self.points**2)

    @property
    def chunks(self) -> int:
        """How many chunks there are."""
        return -(-self.plants // self.plants_of_chunk)

    def starts(self) -> tuple[Array, Array]:
        """Return deviations from upright at rest along both axes, shape (points,) each."""
        first, second = (np.linspace(-axis.span, axis.span, self.points) for axis in self.both)
        return first, second

    def fingerprint(self) -> str:
        """Return a hash of all that the result depends on."""
        content = json.dumps([asdict(self), load_mechanism(self.plant).numbers], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class JointRegionResult:
    """The map.

    Attributes:
        settings: What was mapped.
        share: Share of the plants that come to rest upright, shape (second axis, first axis).
        believed: Whether the plant that is believed in does, same shape.
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


def run_joint_region(
    folder: Path,
    settings: JointRegion,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> JointRegionResult:
    """Run what is not on disk yet, one Parquet file for each chunk, and write the map and its figures.

    Args:
        folder: Where the files go; a folder of the same settings is gone on with.
        settings: What to map.
        connect: To a Dask cluster; by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else.
        ParameterError: A start lies beyond an end stop, or a drawn plant has no positive inertia.
    """
    open_results(folder, "map", settings.fingerprint(), asdict(settings))
    job = (settings, load_mechanism(settings.plant))
    run_chunks(folder, _run_chunk, job, settings.chunks, connect=connect, on_progress=on_progress)
    result = _summarise(folder, settings)
    first, second = np.meshgrid(*settings.starts())
    names = [axis.name for axis in settings.both]
    columns = {names[0]: first.ravel(), names[1]: second.ravel(), "share": result.share.ravel()}
    write_columns(folder / "map.parquet", {**columns, "attracted_believed": result.believed.ravel()})
    write_json(folder / "region.json", result.to_json())
    return result


def _gain(plant: MechanismParameters) -> Gain:
    return mechanism_lqr(linearise_mechanism(design_for(plant)), *plant.mechanism.weights)


def _run_chunk(
    job: tuple[JointRegion, MechanismParameters], index: int, threads: int | None
) -> dict[str, NDArray[Any]]:
    settings, plant = job
    first = index * settings.plants_of_chunk
    count = min(settings.plants_of_chunk, settings.plants - first)
    generator = np.random.Generator(np.random.Philox(key=[settings.seed, index]))
    drawn = scatter(plant, settings.shares, settings.plants_of_chunk, generator)
    if first == 0:
        for name, values in drawn.items():
            values[0] = plant.value(name)
    x, y = np.meshgrid(*settings.starts())
    size, n = x.size, len(plant.joints)
    states = np.tile(np.array([*plant.coordinates.goal, *(0.0,) * n]), (size, 1))
    for axis, deviation in zip(settings.both, (x, y), strict=True):
        states[:, axis.index] += deviation.ravel()
    result = simulate_mechanisms(
        plant,
        variations={name: np.repeat(values[:count], size) for name, values in drawn.items()},
        steps=max(1, round(settings.duration / settings.dt)),
        dt=settings.dt,
        position=np.tile(states[:, :n], (count, 1)),
        velocity=np.tile(states[:, n:], (count, 1)),
        gain=_gain(plant).K,
        threads=threads,
    )
    off = np.array([plant.coordinates.deviation(tuple(position)) for position in result.position])
    near = (np.abs(off) < settings.tolerance[0]).all(axis=1)
    near &= (np.abs(result.velocity) < settings.tolerance[1]).all(axis=1)
    plants = np.repeat(np.arange(first, first + count, dtype=np.int32), size)
    every = {name: np.repeat(values[:count], size) for name, values in drawn.items()}
    ends = {f"end_{name}": off[:, i] for i, name in enumerate(plant.coordinates.names)}
    return {"plant": plants, **every, **ends, "attracted": near}


def _summarise(folder: Path, settings: JointRegion) -> JointRegionResult:
    plant = load_mechanism(settings.plant)
    shape = (settings.points, settings.points)
    hits, believed = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.bool_)
    for index in range(settings.chunks):
        attracted = read_columns(chunk_path(folder, index), ("attracted",))["attracted"].reshape(-1, *shape)
        hits += attracted.sum(axis=0)
        if index == 0:
            believed = attracted[0]
    gain = _gain(plant)
    try:
        caught: CaughtRegion | None = sample_caught_region(plant, gain)
    except DesignError:
        caught = None
    if caught is None:
        return JointRegionResult(settings, hits / settings.plants, believed, None, np.empty((0, 2)), math.nan)
    at = [axis.index for axis in settings.both]
    S = np.asarray(gain.S)[np.ix_(at, at)]
    x, y = np.meshgrid(*settings.starts())
    inside = S[0, 0] * x * x + 2.0 * S[0, 1] * x * y + S[1, 1] * y * y <= caught.level
    share = float(hits[inside].sum() / (settings.plants * inside.sum())) if inside.any() else math.nan
    section = sublevel_ellipse(S, caught.level)
    return JointRegionResult(settings, hits / settings.plants, believed, caught, section, share)
