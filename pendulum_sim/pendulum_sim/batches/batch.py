"""Many pendulums at once: compiled, closed loop under linear state feedback and seeded noise.

Each pendulum has its own parameters, gain, start, seed and noise amplitude::

    u_k = clamp(-K [wrap(theta_k - target), theta_dot_k] + noise(seed, k // hold), effort_limit)

Equations, integrators and noise are those of :class:`pendulum_sim.stepping.plant.RigidPlant` and of
``pendulum_msgs_py.contract.noise``, compiled, so that one pendulum of a batch moves like one on the graph.
Memory does not depend on the number of steps, unless trajectories are requested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.noise import stream_key
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.dry_friction import DRY, LAG, PACKED
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import check_step, pack
from pendulum_sim.stepping.stability import MOST_GROWTH, check_stability, growth_rate

__all__ = ["BatchResult", "batch_size", "check_counts", "noise_keys", "simulate_batch"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BatchResult:
    """Results of a batch of B pendulums.

    Attributes:
        theta: Final angles, shape (B,), not wrapped [rad].
        theta_dot: Final velocities, shape (B,) [rad/s].
        max_effort: Largest |K x| before noise and limit, shape (B,) [N m].
        max_theta: Largest |wrap(theta - target)|, shape (B,) [rad].
        mean_theta: Mean of wrap(theta - target) over the steps, shape (B,) [rad].
        std_theta: Its standard deviation, shape (B,) [rad].
        mean_theta_dot: Mean of the velocity, shape (B,) [rad/s].
        std_theta_dot: Its standard deviation, shape (B,) [rad/s].
        trajectories: theta [rad], theta_dot [rad/s] and applied effort [N m] at the start of each step, shape
            (steps, 3, B); None unless requested.
    """

    theta: Array
    theta_dot: Array
    max_effort: Array
    max_theta: Array
    mean_theta: Array
    std_theta: Array
    mean_theta_dot: Array
    std_theta_dot: Array
    trajectories: Array | None = None


def simulate_batch(
    parameters: PlantParameters | Sequence[PlantParameters],
    *,
    variations: Mapping[str, ArrayLike] | None = None,
    steps: int,
    dt: float = 2e-3,
    method: str = "etd4",
    substeps: int = 1,
    theta: ArrayLike = UPRIGHT,
    theta_dot: ArrayLike = 0.0,
    gain: ArrayLike = (0.0, 0.0),
    target: float = UPRIGHT,
    seeds: ArrayLike = 0,
    amplitude: ArrayLike = 0.0,
    hold: int = 1,
    record: bool = False,
    threads: int | None = None,
) -> BatchResult:
    """Integrate a batch; its size B is that of the longest argument, and single values hold for all.

    Args:
        parameters: One plant or B plants, all rigid.
        variations: Values of plant parameters by name, each scalar or (B,), in place of those of the one plant: a
            million plants without a million objects.
        steps: Steps to take, >= 1.
        dt: Step, over which control and noise are held [s].
        method: Integrator, any of ``integrators.METHODS`` but ``adaptive``.
        substeps: Integration steps in a step.
        theta: Initial angles, scalar or (B,) [rad].
        theta_dot: Initial velocities, scalar or (B,) [rad/s].
        gain: K, shape (2,) or (B, 2) [N m/rad, N m s/rad]; zeros for an open loop.
        target: Angle to regulate to [rad].
        seeds: Seeds of the noise, scalar or (B,), 0 to 2^64 - 1.
        amplitude: Half width of the uniform noise, scalar or (B,) [N m].
        hold: Steps for which a noise sample is held, >= 1.
        record: Return the trajectories.
        threads: Threads to use; None for numba's default.

    Raises:
        ParameterError: Shapes do not go together, or a value is outside its domain.
    """
    from pendulum_sim.batches.batch_kernels import (
        BLOCK,
        ROWS,
        coefficients_kernel,
        general_kernel,
        run_blocks,
        smooth_kernel,
    )

    check_step(dt, substeps)
    integrator = get_integrator(method)
    if method == "adaptive":
        raise ParameterError("method is 'adaptive' in a batch; expected a compiled one, such as etd4")
    check_counts(steps, hold, threads)
    if not math.isfinite(target):
        raise ParameterError(f"target is {target} rad; expected a finite number")
    plants = [parameters] if isinstance(parameters, PlantParameters) else list(parameters)
    if any(plant.drivetrain is not None for plant in plants):
        raise ParameterError("a batch takes rigid plants; one of these is series elastic")
    gains = np.atleast_2d(np.asarray(gain, dtype=np.float64))
    if gains.ndim != 2 or gains.shape[1] != 2:
        raise ParameterError(f"gain has shape {gains.shape}; expected (2,) or (B, 2)")
    if not np.isfinite(gains).all():
        raise ParameterError("gain has a value that is not finite; expected numbers of N m/rad and N m s/rad")
    columns = {
        "theta": _column("theta", theta),
        "theta_dot": _column("theta_dot", theta_dot),
        "amplitude": _column("amplitude", amplitude),
    }
    if columns["amplitude"].min() < 0.0:
        raise ParameterError(f"amplitude has a value of {columns['amplitude'].min()} N m; expected >= 0")
    own_keys = noise_keys(seeds)
    lengths = {name: column.size for name, column in columns.items()}
    varied = {name: _column(name, values) for name, values in (variations or {}).items()}
    if "coulomb_friction" in varied and "static_friction" not in varied and _static_follows(plants):
        varied["static_friction"] = varied["coulomb_friction"]
    _check_variations(varied, plants)
    lengths |= {name: column.size for name, column in varied.items()}
    lengths |= {"parameters": len(plants), "gain": len(gains), "seeds": len(own_keys)}
    size = batch_size(lengths)

    packed = np.array([pack(plant) for plant in plants], dtype=np.float64)
    h = dt / substeps
    if varied:
        packed = np.repeat(packed, size, axis=0)
        for name, column in varied.items():
            packed[:, PACKED.index(name)] = column
        _check_friction(packed)
        rates = packed[:, 1] / packed[:, 0]
        count = len(integrator.coefficients(float(rates[0]), h))
        by_rate = np.empty((count, size))
        coefficients_kernel(method)(rates, h, by_rate)
        coefficients = by_rate.T
    else:
        rows_of = [integrator.coefficients(float(row[1] / row[0]), h) for row in packed]
        coefficients = np.array(rows_of, dtype=np.float64)
    growth = growth_rate(integrator, packed[:, 1] / packed[:, 0], packed[:, 2] / packed[:, 0], h, list(coefficients.T))
    if (worst := int(np.argmax(growth))) >= 0 and growth[worst] > MOST_GROWTH:
        values = {name: float(packed[worst, PACKED.index(name)]) for name in ("inertia", "damping", "gravity")}
        # The plant at fault, rebuilt, so that its own check reports the cause and a value that works.
        check_stability(integrator, plants[min(worst, len(plants) - 1)].with_values(**values), dt, substeps, h)
    delays = np.array([plant.transport_delay for plant in plants])
    smooth = not (delays.any() or packed[:, DRY].any() or packed[:, LAG].any())

    keys = np.broadcast_to(own_keys, (size,)).copy()
    record_of = np.empty((steps, 3, size)) if record else np.empty((0, 3, size))
    table = np.zeros((len(ROWS) + coefficients.shape[1], size))
    rows = dict(zip(ROWS, table, strict=False))
    rows["x"][:], rows["v"][:], rows["amplitude"][:] = (
        columns["theta"],
        columns["theta_dot"],
        columns["amplitude"],
    )
    rows["gain_1"][:], rows["gain_2"][:] = gains.T
    rows["limit"][:] = [plant.effort_limit for plant in plants]
    rows["delay"][:] = delays
    for name, values in zip(PACKED, packed.T, strict=True):
        rows[name][:] = values
    table[len(ROWS) :] = coefficients.T
    run = smooth_kernel(method, coefficients.shape[1]) if smooth else general_kernel(method)
    run_blocks(run, BLOCK if smooth else 1, threads, table, keys, target, dt, steps, hold, substeps, record_of)
    mean_x, mean_v = rows["sum_x"] / steps, rows["sum_v"] / steps
    return BatchResult(
        theta=rows["x"].copy(),
        theta_dot=rows["v"].copy(),
        max_effort=rows["max"].copy(),
        max_theta=rows["max_x"].copy(),
        mean_theta=mean_x,
        std_theta=np.sqrt(np.maximum(0.0, rows["sum_xx"] / steps - mean_x**2)),
        mean_theta_dot=mean_v,
        std_theta_dot=np.sqrt(np.maximum(0.0, rows["sum_vv"] / steps - mean_v**2)),
        trajectories=record_of if record else None,
    )


def check_counts(steps: object, hold: object, threads: object) -> None:
    """Refuse steps, steps of a noise sample or threads (None for the default) that are no whole number >= 1."""
    counts = {"steps": steps, "hold": hold, **({} if threads is None else {"threads": threads})}
    for name, value in counts.items():
        if not _is_whole(value) or value < 1:  # type: ignore[operator]
            raise ParameterError(f"{name} is {value!r}; expected a whole number >= 1")


def noise_keys(seeds: ArrayLike) -> NDArray[np.uint64]:
    """Return the key of each seed's noise, shape (1,) or (B,).

    Raises:
        ParameterError: A seed is no whole number from 0 to 2^64 - 1.
    """
    given = np.atleast_1d(np.asarray(seeds, dtype=object))
    for seed in given:
        if not _is_whole(seed) or not 0 <= seed < 2**64:
            raise ParameterError(f"seeds has {seed!r}; expected whole numbers from 0 to 2^64 - 1")
    return np.array([stream_key(int(seed)) for seed in given], dtype=np.uint64)


def batch_size(lengths: Mapping[str, int]) -> int:
    """Return the size of a batch, that of its longest argument; all others have one entry, or as many.

    Raises:
        ParameterError: One has another number of them.
    """
    size = max(lengths.values())
    for name, length in lengths.items():
        if length not in {1, size}:
            raise ParameterError(f"{name} has {length} entries; expected 1 or {size}")
    return size


def _is_whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))


def _static_follows(plants: Sequence[PlantParameters]) -> bool:
    """Return whether static friction is no parameter of its own: where it was left out, it is the Coulomb friction."""
    return all(plant.static_friction == plant.coulomb_friction for plant in plants)


def _check_friction(packed: Array) -> None:
    coulomb, static = packed[:, PACKED.index("coulomb_friction")], packed[:, PACKED.index("static_friction")]
    wrong = np.flatnonzero(static < coulomb)
    if wrong.size:
        first = wrong[0]
        raise ParameterError(
            f"static_friction of pendulum {first} is {static[first]} N m; "
            f"expected >= coulomb_friction = {coulomb[first]} N m"
        )


def _check_variations(varied: Mapping[str, Array], plants: Sequence[PlantParameters]) -> None:
    """Refuse what is no parameter of a rigid plant, or a value that no plant can have."""
    if varied and len(plants) != 1:
        raise ParameterError(f"variations go with one plant; got {len(plants)}")
    for name, column in varied.items():
        if name not in PACKED:
            raise ParameterError(f"variation {name!r} is unknown; expected one of {', '.join(PACKED)}")
        if name == "inertia" and column.min() <= 0.0:
            raise ParameterError(f"inertia has a value of {column.min()} kg m^2; expected > 0")
        if name not in {"inertia", "gravity", "torque_offset", "angle_offset"} and column.min() < 0.0:
            raise ParameterError(f"{name} has a value of {column.min()}; expected >= 0")


def _column(name: str, values: ArrayLike) -> Array:
    column = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if column.ndim != 1 or not np.all(np.isfinite(column)):
        raise ParameterError(f"{name} has shape {column.shape}; expected finite numbers, one or one per pendulum")
    return column
