"""Many plants of several joints at once: compiled, closed loop under linear state feedback and seeded noise.

Each plant has its own parameters, gain, start, seed and noise amplitude; of driven joint a::

    u_a = clamp(-K_a [q - goal (wrapped where it turns), v] + noise(seed, (k // hold) m + a), effort limit of a)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_steps import COULOMB, JOINT_ROWS, LOWER, STATIC, UPPER
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, common_delay, pack_joints
from pendulum_sim.batches.batch import batch_size, check_counts, noise_keys
from pendulum_sim.stepping.mechanism_plant import check_decay, check_stable_step, is_smooth_mechanism
from pendulum_sim.stepping.plant import check_step

__all__ = ["MechanismBatch", "simulate_mechanisms"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MechanismBatch:
    """Results of a batch of B plants of n joints, m of them driven.

    Attributes:
        position: Final positions, shape (B, n), not wrapped [rad or m].
        velocity: Final velocities, shape (B, n).
        max_effort: Largest |K x| before noise and limit, shape (B, m) [N m or N].
        max_deviation: Largest |q - goal|, wrapped where it turns, shape (B, n).
        mean_deviation: Mean of q - goal over the steps, shape (B, n).
        std_deviation: Its standard deviation, shape (B, n).
        trajectories: Positions, velocities and applied efforts of all joints at the start of each step, shape
            (steps, 3 n, B); None unless requested.
    """

    position: Array
    velocity: Array
    max_effort: Array
    max_deviation: Array
    mean_deviation: Array
    std_deviation: Array
    trajectories: Array | None = None


def simulate_mechanisms(
    parameters: MechanismParameters,
    *,
    variations: Mapping[str, ArrayLike] | None = None,
    steps: int,
    dt: float = 2e-3,
    substeps: int = 1,
    position: ArrayLike | None = None,
    velocity: ArrayLike = 0.0,
    gain: ArrayLike | None = None,
    goal: Sequence[float] | None = None,
    seeds: ArrayLike = 0,
    amplitude: ArrayLike = 0.0,
    hold: int = 1,
    record: bool = False,
    threads: int | None = None,
) -> MechanismBatch:
    """Integrate a batch; its size B is that of the longest argument, and single values hold for all.

    Args:
        parameters: The plant.
        variations: Values of its parameters, each scalar or (B,), by the names that its ``with_values`` takes.
        steps: Steps to take, >= 1.
        dt: Step, over which control and noise are held [s].
        substeps: Integration steps in a step.
        position: Initial positions, (n,) or (B, n); None for upright [rad or m].
        velocity: Initial velocities, scalar, (n,) or (B, n).
        gain: K, shape (m, 2n) or (B, m, 2n); None for an open loop.
        goal: n positions to regulate to; None for upright.
        seeds: Seeds of the noise, scalar or (B,), 0 to 2^64 - 1.
        amplitude: Half width of the uniform noise on each driven joint, scalar, (m,) or (B, m) [N m or N].
        hold: Steps for which a noise sample is held, >= 1.
        record: Return the trajectories.
        threads: Threads to use; None for numba's default.

    Raises:
        ParameterError: Shapes do not go together, or a value is outside its domain.
    """
    from pendulum_sim.batches.batch_kernels import BLOCK, run_blocks
    from pendulum_sim.batches.mechanism_kernels import Layout, general_joints_kernel, smooth_joints_kernel

    check_step(dt, substeps)
    check_counts(steps, hold, threads)
    coordinates = parameters.coordinates
    n, m = len(coordinates.joints), len(coordinates.driven)
    aim = np.array(coordinates.goal if goal is None else goal, dtype=np.float64)
    if aim.shape != (n,) or not np.isfinite(aim).all():
        raise ParameterError(f"goal is {aim.tolist()}; expected {n} finite numbers")
    own_keys = noise_keys(seeds)
    columns = {
        "q": _table("position", aim if position is None else position, n),
        "v": _table("velocity", np.full(n, velocity) if np.ndim(velocity) == 0 else velocity, n),
        "gain": _table("gain", _flat_gain(gain, m, n), m * 2 * n),
        "amplitude": _table("amplitude", np.full(m, amplitude) if np.ndim(amplitude) == 0 else amplitude, m),
        "limit": np.array([parameters.effort_limits]),
        "p": np.array([parameters.packed]),
        "table": np.concatenate([np.array(row) for row in pack_joints(parameters)])[None, :],
    }
    if columns["amplitude"].size and columns["amplitude"].min() < 0.0:
        raise ParameterError(f"amplitude has a value of {columns['amplitude'].min()}; expected >= 0")
    varied = {name: _table(name, np.reshape(values, (-1, 1)), 1)[:, 0] for name, values in (variations or {}).items()}
    lengths = {name: len(column) for name, column in {**columns, **varied}.items()} | {"seeds": len(own_keys)}
    size = batch_size(lengths)
    wide = {name: np.repeat(column, size // len(column), axis=0) for name, column in columns.items()}
    for name, values in varied.items():
        _vary(parameters, wide, name, values)
    if varied:
        _check_varied(parameters, wide, dt / substeps)
    _check_starts(parameters, wide)
    check_stable_step(parameters, dt / substeps)

    layout = Layout(parameters.mechanism.name, coordinates.driven)
    starts = layout.starts
    w = np.zeros((starts["end"], size))
    for name, column in wide.items():
        w[starts[name] : starts[name] + column.shape[1]] = column.T
    keys = np.broadcast_to(own_keys, (size,)).copy()
    recorded = np.empty((steps, 3 * n, size)) if record else np.empty((0, 3 * n, size))
    smooth = is_smooth_mechanism(parameters) and not any(name.partition(".")[2] in JOINT_ROWS for name in varied)
    if smooth:
        run_blocks(smooth_joints_kernel(layout), BLOCK, threads, w, keys, aim, dt, steps, hold, substeps, recorded)
    else:
        more = np.array([float(substeps), common_delay(parameters)])
        run_blocks(general_joints_kernel(layout), 1, threads, w, keys, aim, dt, steps, hold, more, recorded)

    def rows(name: str, count: int) -> Array:
        return w[starts[name] : starts[name] + count].T.copy()

    mean = rows("sum", n) / steps
    return MechanismBatch(
        position=rows("q", n),
        velocity=rows("v", n),
        max_effort=rows("max_effort", m),
        max_deviation=rows("max", n),
        mean_deviation=mean,
        std_deviation=np.sqrt(np.maximum(0.0, rows("square", n) / steps - mean**2)),
        trajectories=recorded if record else None,
    )


def _flat_gain(gain: ArrayLike | None, m: int, n: int) -> Array:
    if gain is None:
        return np.zeros((1, m * 2 * n))
    K = np.asarray(gain, dtype=np.float64)
    if K.shape[-2:] != (m, 2 * n) or K.ndim not in {2, 3}:
        raise ParameterError(f"gain has shape {K.shape}; expected ({m}, {2 * n}) or (B, {m}, {2 * n})")
    return K.reshape(-1, m * 2 * n)


def _table(name: str, values: ArrayLike, width: int) -> Array:
    """Return values as rows of a given width, (1, width) or (B, width)."""
    table = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if table.ndim != 2 or table.shape[1] != width:
        raise ParameterError(f"{name} has shape {np.shape(values)}; expected ({width},) or (B, {width})")
    if not np.isfinite(table).all():
        raise ParameterError(f"{name} has a value that is not finite; expected numbers")
    return table


def _vary(parameters: MechanismParameters, wide: dict[str, Array], name: str, values: Array) -> None:
    """Put values in place of one parameter, by its name."""
    if name not in parameters.specs:
        raise ParameterError(f"variation {name!r} is unknown; expected one of {', '.join(parameters.specs)}")
    for value in (float(values.min()), float(values.max())):
        parameters.specs[name].check(value, where="variations")
    names = parameters.mechanism.parameter_names
    joint, _, key = name.partition(".")
    if name in names:
        wide["p"][:, names.index(name)] = values
        return
    index = parameters.coordinates.names.index(joint)
    if key == "effort_limit":
        wide["limit"][:, parameters.coordinates.driven.index(index)] = values
        return
    if key == "transport_delay":
        raise ParameterError(f"variation {name!r} is one delay for all; expected it in the plant, or a batch for each")
    n = len(parameters.joints)
    wide["table"][:, JOINT_ROWS.index(key) * n + index] = values
    if key == "coulomb_friction" and parameters.joints[index].static_friction is None:
        wide["table"][:, STATIC * n + index] = values


def _check_starts(parameters: MechanismParameters, wide: Mapping[str, Array]) -> None:
    n = len(parameters.joints)
    low, high = (wide["table"][:, row * n : (row + 1) * n] for row in (LOWER, UPPER))
    outside = ~((low <= wide["q"]) & (wide["q"] <= high) & (low < high))
    if outside.any():
        row, joint = (int(value[0]) for value in np.nonzero(outside))
        each = parameters.mechanism.joints[joint]
        raise ParameterError(
            f"position of {each.name} of plant {row} is {wide['q'][row, joint]} {each.unit}; expected "
            f"{low[row, joint]:g} to {high[row, joint]:g}, between its stops"
        )


def _check_varied(parameters: MechanismParameters, wide: Mapping[str, Array], h: float) -> None:
    n = len(parameters.joints)
    coulomb, static = (wide["table"][:, row * n : (row + 1) * n] for row in (COULOMB, STATIC))
    if (static < coulomb).any():
        row, joint = (int(value[0]) for value in np.nonzero(static < coulomb))
        raise ParameterError(
            f"static_friction of {parameters.coordinates.names[joint]} of plant {row} is {static[row, joint]}; "
            f"expected >= coulomb_friction = {coulomb[row, joint]}"
        )
    mass = in_arithmetic(parameters.mechanism.mass, np)
    p = tuple(wide["p"].T)
    for angle in np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False):
        entries = [np.broadcast_to(value, (len(wide["p"]),)) for row in mass((float(angle),) * n, p) for value in row]
        rows = np.array(entries).T.reshape(-1, n, n)
        lowest = np.linalg.eigvalsh(rows)[:, 0]
        if (worst := int(np.argmin(lowest))) >= 0 and not lowest[worst] > 0.0:
            raise ParameterError(f"the masses and inertias of plant {worst} of the batch give no positive inertia")
        decay = np.linalg.solve(rows, wide["p"][:, -n:, None] * np.eye(n))
        rate = np.max(np.linalg.eigvals(decay).real, axis=1)
        check_decay(float(rate.max()), h, f"plant {int(np.argmax(rate))} of the batch")
