"""Closed-loop runs of a plant of several joints over what is not known of it: parameters, noise and start.

The plant is held upright by its own LQR, as in ``experiment joints``. Chunks, seeds and files are those of
:mod:`pendulum_bags.studies.monte_carlo`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.joint_run import design_for, identified_names
from pendulum_bags.studies.chunks import Connect
from pendulum_bags.studies.random_runs import RandomRuns, carry_out_runs, figures_of_runs
from pendulum_bags.studies.uncertain import share_of_interval
from pendulum_lqr.mechanism_model import linearise_mechanism, mechanism_lqr
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism, load_mechanism_file
from pendulum_sim.mechanism_batch import MechanismBatch, simulate_mechanisms

__all__ = ["JointMonteCarlo", "joint_shares", "replay_joints", "run_joint_chunk", "run_joint_monte_carlo", "scatter"]

Array = NDArray[np.float64]

_LIMIT_PER_NOISE = 10.0
"""Effort limit per amplitude of the noise where nobody chose one, as ``experiment joints`` takes it [-]."""


@dataclass(frozen=True)
class JointMonteCarlo(RandomRuns):
    """What to draw and to run, of a plant of several joints; see :class:`RandomRuns`.

    Attributes:
        shares: Standard deviation of parameters as a share of their value, by name; others are known.
        amplitude: None for a tenth of each driven joint's effort limit.
    """

    shares: Mapping[str, float] = field(default_factory=dict)

    def numbers_of_plant(self) -> Any:
        """Return all numbers of the plant."""
        return load_mechanism(self.plant).numbers


def joint_shares(text: str, plant: str) -> dict[str, float]:
    """Return how far the parameters of a plant of several joints are known, by name.

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
        intervals = load_mechanism_file(plant)[1].get("intervals", {}) if Path(plant).suffix else {}
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
    plant: MechanismParameters, shares: Mapping[str, float], count: int, generator: np.random.Generator
) -> dict[str, Array]:
    """Return values of uncertain parameters, shape (count,) each: log-normal and independent, for no mass is negative.

    Args:
        plant: The plant that is believed in.
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


def run_joint_chunk(settings: JointMonteCarlo, index: int, threads: int | None = None) -> dict[str, NDArray[Any]]:
    """Run a chunk and return its columns; a pure function of settings and index."""
    return _run_chunk((settings, load_mechanism(settings.plant)), index, threads)


def run_joint_monte_carlo(
    folder: Path,
    settings: JointMonteCarlo,
    *,
    connect: Connect = nullcontext,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run all chunks that are not on disk yet and sum up, as :func:`carry_out_runs` says.

    Args:
        folder: Where the files go.
        settings: What to run.
        connect: To a Dask cluster; by default in this process, on all cores.
        on_progress: Called with chunks done and in all.

    Raises:
        BagError: The folder holds something else, or more runs.
        ParameterError: A drawn plant has no positive inertia.
    """
    return carry_out_runs(
        folder,
        settings,
        _run_chunk,
        (settings, load_mechanism(settings.plant)),
        _summarise,
        connect=connect,
        on_progress=on_progress,
    )


def replay_joints(settings: JointMonteCarlo, number: int) -> tuple[dict[str, float], Array]:
    """Run one run again, alone, and return what was drawn for it and its motion.

    Args:
        settings: As of the Monte Carlo.
        number: Of the run, from 0.

    Returns:
        The row of the table, and positions, velocities and efforts of all joints at each step, shape (steps, 3 n).
    """
    index, place = settings.place(number)
    plant = load_mechanism(settings.plant)
    drawn = {name: values[place] for name, values in _draw(settings, index, plant).items()}
    result = _batch(settings, plant, drawn, None, record=True)
    assert result.trajectories is not None
    return {name: float(v[0]) for name, v in _columns(plant, drawn, result).items()}, result.trajectories[:, :, 0]


def _draw(settings: JointMonteCarlo, index: int, plant: MechanismParameters) -> dict[str, NDArray[Any]]:
    """Return parameters, starts and noise seeds of a chunk."""

    def draw(generator: np.random.Generator, count: int) -> dict[str, NDArray[Any]]:
        drawn: dict[str, NDArray[Any]] = {**scatter(plant, settings.shares, count, generator)}
        for name, goal in zip(plant.coordinates.names, plant.coordinates.goal, strict=True):
            drawn[f"start_{name}"] = goal + settings.start * generator.uniform(-1.0, 1.0, count)
        return drawn

    return settings.draw(index, draw)


def _run_chunk(
    job: tuple[JointMonteCarlo, MechanismParameters], index: int, threads: int | None
) -> dict[str, NDArray[Any]]:
    # The plant travels with the job: its file need not be where a worker runs.
    settings, plant = job
    drawn = _draw(settings, index, plant)
    return _columns(plant, drawn, _batch(settings, plant, drawn, threads))


def _batch(
    settings: JointMonteCarlo,
    plant: MechanismParameters,
    drawn: Mapping[str, NDArray[Any]],
    threads: int | None,
    record: bool = False,
) -> MechanismBatch:
    gain = mechanism_lqr(linearise_mechanism(design_for(plant)), *plant.mechanism.weights).K
    limits = np.array(plant.effort_limits)
    return simulate_mechanisms(
        plant,
        variations={name: drawn[name] for name in settings.shares},
        steps=settings.steps,
        dt=settings.dt,
        position=np.stack([drawn[f"start_{name}"] for name in plant.coordinates.names], axis=1),
        gain=gain,
        seeds=drawn["noise_seed"],
        amplitude=limits / _LIMIT_PER_NOISE if settings.amplitude is None else settings.amplitude,
        hold=max(1, round(settings.hold_time / settings.dt)),
        record=record,
        threads=threads,
    )


def _columns(
    plant: MechanismParameters, drawn: Mapping[str, NDArray[Any]], result: MechanismBatch
) -> dict[str, NDArray[Any]]:
    """Return what was drawn and what came of it, a column each; SI units."""
    columns = dict(drawn)
    for i, name in enumerate(plant.coordinates.names):
        columns[f"max_{name}"] = result.max_deviation[:, i]
        columns[f"std_{name}"] = result.std_deviation[:, i]
        columns[f"end_{name}"] = result.position[:, i]
        columns[f"end_velocity_{name}"] = result.velocity[:, i]
    for i, name in enumerate(plant.coordinates.driven_names):
        columns[f"max_effort_{name}"] = result.max_effort[:, i]
    return columns


def _summarise(folder: Path, settings: JointMonteCarlo) -> dict[str, Any]:
    """Return the probability that all joints stay within the bound, quantiles and the worst runs, from the files."""
    coordinates = load_mechanism(settings.plant).coordinates
    units = {f"{what}_{joint.name}": joint.unit for what in ("max", "std") for joint in coordinates.joints}
    units |= {f"max_effort_{coordinates.joints[i].name}": coordinates.joints[i].effort_unit for i in coordinates.driven}
    figures, _ = figures_of_runs(
        folder,
        settings,
        units,
        lambda columns: np.max([columns[f"max_{name}"] for name in coordinates.names], axis=0),
        lambda run, farthest: {"max_deviation": farthest, **replay_joints(settings, run)[0]},
    )
    return {**figures, "joints": list(coordinates.names), "units": units}
