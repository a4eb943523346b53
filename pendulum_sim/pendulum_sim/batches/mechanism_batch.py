"""Many plants of several joints at once: compiled, closed loop under linear state feedback and seeded noise.

Each plant has its own parameters, gain, start, seed and noise amplitude; of driven joint a::

    u_a = clamp(-K_a [q - goal (wrapped where it turns), v] + noise(seed, (k // hold) m + a), effort limit of a)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_steps import COULOMB, JOINT_ROWS, LOWER, STATIC, UPPER
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, common_delay, pack_joints
from pendulum_sim.batches.engine import Batch, Results, batch_size, finite_columns, seed_column
from pendulum_sim.stepping.mechanism_plant import check_decay, check_stable_step, is_smooth_mechanism

__all__ = ["simulate_mechanisms"]

Array = NDArray[np.float64]
Rows = dict[str, list[Array]]


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
    device: str = "cpu",
) -> Results:
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
        device: As of :func:`pendulum_sim.batches.batch.simulate_batch`.

    Raises:
        ParameterError: Shapes do not go together, or a value is outside its domain.
        FaultError: There is no GPU.
    """
    from pendulum_sim.batches.batch_kernels import Layout

    batch = Batch(steps, dt, substeps, hold, record, threads, device)
    coordinates = parameters.coordinates
    n, m = len(coordinates.joints), len(coordinates.driven)
    aim = np.array(coordinates.goal if goal is None else goal, dtype=np.float64)
    if aim.shape != (n,) or not np.isfinite(aim).all():
        raise ParameterError(f"goal is {aim.tolist()}; expected {n} finite numbers")
    own_seeds = seed_column(seeds)
    columns = {
        "q": finite_columns("position", aim if position is None else position, n),
        "v": finite_columns("velocity", np.full(n, velocity) if np.ndim(velocity) == 0 else velocity, n),
        "gain": finite_columns("gain", _flat_gain(gain, m, n), m * 2 * n),
        "amplitude": finite_columns("amplitude", np.full(m, amplitude) if np.ndim(amplitude) == 0 else amplitude, m),
        "limit": np.array([parameters.effort_limits]),
        "goal": aim[None, :],
        "delay": np.array([[common_delay(parameters)]]),
        "p": np.array([parameters.packed]),
        "table": np.concatenate([np.array(row) for row in pack_joints(parameters)])[None, :],
    }
    if columns["amplitude"].size and columns["amplitude"].min() < 0.0:
        raise ParameterError(f"amplitude has a value of {columns['amplitude'].min()}; expected >= 0")
    varied = {
        name: finite_columns(name, np.reshape(values, (-1, 1)), 1)[:, 0] for name, values in (variations or {}).items()
    }
    lengths = {name: len(column) for name, column in {**columns, **varied}.items()} | {"seeds": len(own_seeds)}
    batch_size(lengths)
    rows = {name: list(column.T) for name, column in columns.items()}
    for name, values in varied.items():
        _vary(parameters, rows, name, values)
    if varied:
        _check_varied(parameters, rows, dt / substeps)
    _check_starts(parameters, rows)
    check_stable_step(parameters, dt / substeps)

    smooth = is_smooth_mechanism(parameters) and not any(name.partition(".")[2] in JOINT_ROWS for name in varied)
    layout = Layout("rk4", parameters.mechanism.name, coordinates.driven)
    return batch.run(layout, rows, own_seeds, smooth=smooth)


def _flat_gain(gain: ArrayLike | None, m: int, n: int) -> Array:
    if gain is None:
        return np.zeros((1, m * 2 * n))
    K = np.asarray(gain, dtype=np.float64)
    if K.shape[-2:] != (m, 2 * n) or K.ndim not in {2, 3}:
        raise ParameterError(f"gain has shape {K.shape}; expected ({m}, {2 * n}) or (B, {m}, {2 * n})")
    return K.reshape(-1, m * 2 * n)


def _vary(parameters: MechanismParameters, rows: Rows, name: str, values: Array) -> None:
    """Put values in place of one parameter, by its name."""
    if name not in parameters.specs:
        raise ParameterError(f"variation {name!r} is unknown; expected one of {', '.join(parameters.specs)}")
    for value in (float(values.min()), float(values.max())):
        parameters.specs[name].check(value, where="variations")
    names = parameters.mechanism.parameter_names
    joint, _, key = name.partition(".")
    if name in names:
        rows["p"][names.index(name)] = values
        return
    index = parameters.coordinates.names.index(joint)
    if key == "effort_limit":
        rows["limit"][parameters.coordinates.driven.index(index)] = values
        return
    if key == "transport_delay":
        raise ParameterError(f"variation {name!r} is one delay for all; expected it in the plant, or a batch for each")
    n = len(parameters.joints)
    rows["table"][JOINT_ROWS.index(key) * n + index] = values
    if key == "coulomb_friction" and parameters.joints[index].static_friction is None:
        rows["table"][STATIC * n + index] = values


def _check_starts(parameters: MechanismParameters, rows: Rows) -> None:
    n = len(parameters.joints)
    for i, joint in enumerate(parameters.mechanism.joints):
        q, low, high = np.broadcast_arrays(rows["q"][i], *(rows["table"][row * n + i] for row in (LOWER, UPPER)))
        outside = ~((low <= q) & (q <= high) & (low < high))
        if outside.any():
            plant = int(np.argmax(outside))
            raise ParameterError(
                f"position of {joint.name} of plant {plant} is {q[plant]} {joint.unit}; expected "
                f"{low[plant]:g} to {high[plant]:g}, between its stops"
            )


def _check_varied(parameters: MechanismParameters, rows: Rows, h: float) -> None:
    n = len(parameters.joints)
    for i, name in enumerate(parameters.coordinates.names):
        coulomb, static = np.broadcast_arrays(*(rows["table"][row * n + i] for row in (COULOMB, STATIC)))
        if (static < coulomb).any():
            plant = int(np.argmax(static < coulomb))
            raise ParameterError(
                f"static_friction of {name} of plant {plant} is {static[plant]}; "
                f"expected >= coulomb_friction = {coulomb[plant]}"
            )
    mass = in_arithmetic(parameters.mechanism.mass, np)
    p = np.broadcast_arrays(*rows["p"])
    damping = np.stack(p[-n:], axis=1)
    for angle in np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False):
        entries = [np.broadcast_to(value, p[0].shape) for row in mass((float(angle),) * n, tuple(p)) for value in row]
        matrices = np.array(entries).T.reshape(-1, n, n)
        lowest = np.linalg.eigvalsh(matrices)[:, 0]
        if (worst := int(np.argmin(lowest))) >= 0 and not lowest[worst] > 0.0:
            raise ParameterError(f"the masses and inertias of plant {worst} of the batch give no positive inertia")
        decay = np.linalg.solve(matrices, damping[:, :, None] * np.eye(n))
        rate = np.max(np.linalg.eigvals(decay).real, axis=1)
        check_decay(float(rate.max()), h, f"plant {int(np.argmax(rate))} of the batch")
