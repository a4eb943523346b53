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
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.batches.engine import Batch, batch_size, seed_column
from pendulum_sim.stepping.dry_friction import DRY, LAG, PACKED
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import pack
from pendulum_sim.stepping.stability import MOST_GROWTH, check_stability, growth_rate

__all__ = ["BatchResult", "simulate_batch"]

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
    device: str = "cpu",
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
        device: ``cpu``, ``cuda`` for the GPU, or ``auto`` for the GPU where there is one; results agree to rounding.

    Raises:
        ParameterError: Shapes do not go together, or a value is outside its domain.
        FaultError: There is no GPU.
    """
    from pendulum_sim.batches.batch_kernels import Layout, coefficients_kernel

    batch = Batch(steps, dt, substeps, hold, record, threads, device)
    integrator = get_integrator(method)
    if method == "adaptive":
        raise ParameterError("method is 'adaptive' in a batch; expected a compiled one, such as etd4")
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
    own_seeds = seed_column(seeds)
    lengths = {name: column.size for name, column in columns.items()}
    varied = {name: _column(name, values) for name, values in (variations or {}).items()}
    if "coulomb_friction" in varied and "static_friction" not in varied and _static_follows(plants):
        varied["static_friction"] = varied["coulomb_friction"]
    _check_variations(varied, plants)
    lengths |= {name: column.size for name, column in varied.items()}
    batch_size({**lengths, "parameters": len(plants), "gain": len(gains), "seeds": len(own_seeds)})

    packed = dict(zip(PACKED, np.array([pack(plant) for plant in plants], dtype=np.float64).T, strict=True)) | varied
    _check_friction(packed)
    h = dt / substeps
    rates = packed["damping"] / packed["inertia"]
    if varied:
        coefficients = np.empty((len(integrator.coefficients(1.0, h)), rates.size))
        coefficients_kernel(method)(rates, h, coefficients)
    else:
        coefficients = np.array([integrator.coefficients(float(rate), h) for rate in rates], dtype=np.float64).T
    growth = growth_rate(integrator, rates, packed["gravity"] / packed["inertia"], h, list(coefficients))
    if (worst := int(np.argmax(growth))) >= 0 and growth[worst] > MOST_GROWTH:
        values = {
            name: float(packed[name][min(worst, len(packed[name]) - 1)]) for name in ("inertia", "damping", "gravity")
        }
        # The plant at fault, rebuilt, so that its own check reports the cause and a value that works.
        check_stability(integrator, plants[min(worst, len(plants) - 1)].with_values(**values), dt, substeps, h)
    delays = np.array([plant.transport_delay for plant in plants])
    smooth = not (delays.any() or any(packed[PACKED[index]].any() for index in (*DRY, LAG)))
    result = batch.run(
        Layout(method),
        {
            "q": [columns["theta"]],
            "v": [columns["theta_dot"]],
            "goal": [np.array([target])],
            "amplitude": [columns["amplitude"]],
            "limit": [np.array([plant.effort_limit for plant in plants])],
            "gain": list(gains.T),
            "delay": [delays],
            "p": list(packed.values()),
            "table": list(coefficients),
        },
        own_seeds,
        smooth=smooth,
    )
    return BatchResult(
        theta=result.position[:, 0],
        theta_dot=result.velocity[:, 0],
        max_effort=result.max_effort[:, 0],
        max_theta=result.max_deviation[:, 0],
        mean_theta=result.mean_deviation[:, 0],
        std_theta=result.std_deviation[:, 0],
        mean_theta_dot=result.mean_velocity[:, 0],
        std_theta_dot=result.std_velocity[:, 0],
        trajectories=result.trajectories,
    )


def _static_follows(plants: Sequence[PlantParameters]) -> bool:
    """Return whether static friction is no parameter of its own: where it was left out, it is the Coulomb friction."""
    return all(plant.static_friction == plant.coulomb_friction for plant in plants)


def _check_friction(packed: Mapping[str, Array]) -> None:
    coulomb, static = np.broadcast_arrays(packed["coulomb_friction"], packed["static_friction"])
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
