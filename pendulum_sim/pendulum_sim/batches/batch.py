"""Many plants at once: compiled, closed loop under linear state feedback and seeded noise.

Each plant has its own parameters, gain, start, seed and noise amplitude; of driven joint a of m, in step k::

    u_a = clamp(-K_a [q - goal (wrapped where it turns), v] + noise(seed, (k // hold) m + a), limit of a)

The command u_a of a motor is a voltage, and so are gain, noise and ``max_effort``; dead bands are refused.
Equations, integrators and noise are those of the single plants of :mod:`pendulum_sim.stepping` and of
``pendulum_msgs_py.contract.noise``, compiled, so that one plant of a batch moves like one on the graph.
Memory does not depend on the number of steps, unless trajectories are requested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_steps import COULOMB, JOINT_ROWS, LOWER, STATIC, UPPER
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import Motor
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay, pack_joints
from pendulum_sim.batches.engine import Batch, Results, batch_size, finite_columns, seed_column
from pendulum_sim.stepping.dry_friction import DRY, LAG, PACKED
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.mechanism_plant import check_decay, check_stable_step, is_smooth
from pendulum_sim.stepping.plant import pack
from pendulum_sim.stepping.stability import MOST_GROWTH, check_stability, growth_rate

if TYPE_CHECKING:
    from pendulum_sim.batches.batch_kernels import Layout

__all__ = ["simulate_batch"]

Array = NDArray[np.float64]
Columns = dict[str, Array]


_MOTOR = tuple(entry.name for entry in fields(Motor))


class _Rows(NamedTuple):
    """What depends on the kind of plant: layout, parameters, table of joints or of coefficients, whether smooth."""

    layout: Layout
    p: list[Array]
    table: list[Array]
    smooth: bool


def simulate_batch(
    parameters: PlantParameters | Sequence[PlantParameters],
    *,
    variations: Mapping[str, ArrayLike] | None = None,
    steps: int,
    dt: float = 2e-3,
    method: str = "auto",
    substeps: int = 1,
    position: ArrayLike | None = None,
    velocity: ArrayLike = 0.0,
    gain: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    seeds: ArrayLike = 0,
    amplitude: ArrayLike = 0.0,
    hold: int = 1,
    record: bool = False,
    threads: int | None = None,
    device: str = "cpu",
) -> Results:
    """Integrate a batch; its size B is that of the longest argument, and single values hold for all.

    Where a plant has one joint or one motor, shapes (B, 1) may be (B,), and (B, 1, 2n) may be (B, 2n).

    Args:
        parameters: One plant or B plants, all rigid and of one mechanism.
        variations: Values of plant parameters, each scalar or (B,), by the names that ``with_values`` takes, in place
            of those of the one plant: a million plants without a million objects.
        steps: Steps to take, >= 1.
        dt: Step, over which control and noise are held [s].
        method: Integrator of pendulums, any of ``integrators.METHODS`` but ``adaptive``; ``auto`` is etd4, and
            Runge-Kutta of order four for other mechanisms, which have no other.
        substeps: Integration steps in a step.
        position: Initial positions, (n,) or (B, n); None for the goal [rad or m].
        velocity: Initial velocities, scalar, (n,) or (B, n).
        gain: K, shape (m, 2n) or (B, m, 2n); None for an open loop.
        goal: n positions to regulate to; None for upright.
        seeds: Seeds of the noise, scalar or (B,), 0 to 2^64 - 1.
        amplitude: Half width of the uniform noise on each driven joint, scalar, (m,) or (B, m) [N m or N, or V].
        hold: Steps for which a noise sample is held, >= 1.
        record: Return the trajectories.
        threads: Threads to use; None for numba's default.
        device: ``cpu``, ``cuda`` for the GPU, or ``auto`` for the GPU where there is one; results agree to rounding.

    Raises:
        ParameterError: Shapes do not go together, or a value is outside its domain.
        FaultError: There is no GPU.
    """
    batch = Batch(steps, dt, substeps, hold, record, threads, device)
    plants = [parameters] if isinstance(parameters, PlantParameters) else list(parameters)
    coordinates = _coordinates_of(plants)
    n, m = len(coordinates.joints), len(coordinates.driven)
    aim = np.atleast_1d(np.array(coordinates.goal if goal is None else goal, dtype=np.float64))
    if aim.shape != (n,) or not np.isfinite(aim).all():
        raise ParameterError(f"goal is {aim.tolist()}; expected {n} finite numbers")
    own_seeds = seed_column(seeds)
    columns = {
        "q": finite_columns("position", aim if position is None else position, n),
        "v": finite_columns("velocity", velocity, n),
        "gain": _gain_columns(gain, m, n),
        "amplitude": finite_columns("amplitude", amplitude, m),
        "goal": aim[None, :],
        "limit": np.array([plant.command_limits for plant in plants]),
        "delay": np.array([[common_delay(plant)] for plant in plants]),
    }
    if columns["amplitude"].size and columns["amplitude"].min() < 0.0:
        raise ParameterError(f"amplitude has a value of {columns['amplitude'].min()}; expected >= 0")
    varied = _checked_variations(variations or {}, plants)
    long_names = {"q": "position", "v": "velocity"}
    lengths = {long_names.get(name, name): len(column) for name, column in {**columns, **varied}.items()}
    batch_size({**lengths, "parameters": len(plants), "seeds": len(own_seeds)})
    rows = {name: list(column.T) for name, column in columns.items()}
    for index, name in zip(coordinates.driven, coordinates.driven_names, strict=True):
        prefix = f"{name}." if n > 1 else ""
        limit = varied.pop(f"{prefix}{'voltage' if coordinates.volts else 'effort'}_limit", None)
        if limit is not None:
            rows["limit"][coordinates.driven.index(index)] = limit
    if plants[0].is_pendulum:
        own = _pendulum_rows(plants, varied, "etd4" if method == "auto" else method, batch)
    else:
        if method != "auto":
            raise ParameterError(f"method is {method!r}; expected auto for plants of {plants[0].mechanism.name}")
        motors = _motors(plants, varied) if coordinates.volts else []
        own = _joint_rows(plants, varied, dt / substeps, motors)
        _check_starts(coordinates, rows["q"], own.table)
        for a, motor in enumerate(motors):
            # What follows is in efforts, of the plant behind its motors.
            for name, width in (("gain", 2 * n), ("amplitude", 1), ("limit", 1)):
                for row in range(a * width, (a + 1) * width):
                    rows[name][row] = rows[name][row] * motor.gain
        results = batch.run(own.layout, {**rows, "p": own.p, "table": own.table}, own_seeds, smooth=own.smooth)
        return _in_volts(results, motors, coordinates) if motors else results
    return batch.run(own.layout, {**rows, "p": own.p, "table": own.table}, own_seeds, smooth=own.smooth)


def _coordinates_of(plants: Sequence[PlantParameters]) -> Coordinates:
    first = plants[0]
    for plant in plants:
        if plant.drivetrain is not None:
            raise ParameterError(f"a batch takes rigid plants; plant {plant.name!r} is series elastic")
        kinds = {(one.coordinates, one.mechanism.name, one.is_pendulum) for one in (first, plant)}
        if len(kinds) > 1:
            raise ParameterError(f"plants {first.name!r} and {plant.name!r} of a batch differ; expected one mechanism")
    return first.coordinates


def _gain_columns(gain: ArrayLike | None, m: int, n: int) -> Array:
    K = np.zeros((m, 2 * n)) if gain is None else np.asarray(gain, dtype=np.float64)
    if K.shape[-2:] != (m, 2 * n) and m == 1 and K.ndim <= 2:
        K = K[..., None, :]
    if K.shape[-2:] != (m, 2 * n) or K.ndim > 3:
        shape = np.asarray(gain).shape
        raise ParameterError(f"gain has shape {shape}; expected ({m}, {2 * n}) or (B, {m}, {2 * n})")
    return finite_columns("gain", K.reshape(-1, m * 2 * n), m * 2 * n)


def _checked_variations(variations: Mapping[str, ArrayLike], plants: Sequence[PlantParameters]) -> Columns:
    """Return the columns of what varies by name, a static friction that follows its Coulomb friction among them."""
    if variations and len(plants) != 1:
        raise ParameterError(f"variations go with one plant; got {len(plants)}")
    plant = plants[0]
    joint_rows = PACKED if plant.is_pendulum else JOINT_ROWS
    found: Columns = {}
    for name, values in variations.items():
        key = name.rpartition(".")[2]
        known = name in plant.mechanism.parameter_names or {key, key.removeprefix("actuator_")} & {*joint_rows, *_MOTOR}
        if name not in plant.specs or not (known or key in {"effort_limit", "transport_delay"}):
            raise ParameterError(f"variation {name!r} is unknown; expected one of {', '.join(plant.specs)}")
        if key == "transport_delay":
            raise ParameterError(
                f"variation {name!r} is one delay for all; expected it in the plant, or a batch for each"
            )
        found[name] = finite_columns(name, np.reshape(values, -1), 1)[:, 0]
        for value in (float(found[name].min()), float(found[name].max())):
            plant.specs[name].check(value, where="variations")
    for joint, own in zip(plant.coordinates.names, plant.joints, strict=True):
        prefix = f"{joint}." if len(plant.joints) > 1 else ""
        if own.static_friction is None and f"{prefix}coulomb_friction" in found:
            found.setdefault(f"{prefix}static_friction", found[f"{prefix}coulomb_friction"])
    return found


def _pendulum_rows(plants: Sequence[PlantParameters], varied: Columns, method: str, batch: Batch) -> _Rows:
    """Return the rows of pendulums, whose friction is exact and whose integrator is a choice."""
    from pendulum_sim.batches.batch_kernels import Layout, coefficients_kernel

    integrator = get_integrator(method)
    if method == "adaptive":
        raise ParameterError("method is 'adaptive' in a batch; expected a compiled one, such as etd4")
    packed = dict(zip(PACKED, np.array([pack(plant) for plant in plants], dtype=np.float64).T, strict=True)) | varied
    _check_friction(plants[0].coordinates.names[0], packed["coulomb_friction"], packed["static_friction"])
    h = batch.dt / batch.substeps
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
        wrong = plants[min(worst, len(plants) - 1)].with_values(values)
        check_stability(integrator, wrong, batch.dt, batch.substeps, h)
    late = any(plant.transport_delay for plant in plants)
    smooth = not (late or any(packed[PACKED[index]].any() for index in (*DRY, LAG)))
    torques = any(np.any(packed[name]) for name in JOINT_TORQUES)
    return _Rows(Layout(method, torques=torques), list(packed.values()), list(coefficients), smooth)


def _motors(plants: Sequence[PlantParameters], varied: Columns) -> list[Motor]:
    """Return the driven joints' motors, whose values are columns; what varies of them is taken from ``varied``."""
    found = []
    names, several = plants[0].coordinates.driven_names, len(plants[0].joints) > 1
    for each in zip(names, *(plant.actuators for plant in plants), strict=True):
        name, motors = each[0], [actuator.motor for actuator in each[1:]]
        columns: dict[str, Any] = {}
        for key in _MOTOR:
            own = [getattr(motor, key) for motor in motors]
            column = varied.pop(f"{name}.{key}" if several else key, None)
            columns[key] = column if column is not None else None if None in own else np.array(own)
        if np.any(columns["dead_band"]):
            raise ParameterError(f"the motor of {name} has a dead band; expected none in a batch")
        found.append(Motor(**columns))
    return found


def _in_volts(results: Results, motors: Sequence[Motor], coordinates: Coordinates) -> Results:
    """Return results whose efforts are the voltages that gave them."""
    if (record := results.trajectories) is not None:
        for index, motor in zip(coordinates.driven, motors, strict=True):
            record[:, 2 * len(coordinates.joints) + index] /= motor.gain
    gains = np.stack(np.broadcast_arrays(*(motor.gain for motor in motors)), axis=-1)
    return replace(results, max_effort=results.max_effort / gains)


def _joint_rows(plants: Sequence[PlantParameters], varied: Columns, h: float, motors: Sequence[Motor]) -> _Rows:
    """Return the rows of plants of any joints, integrated by Runge-Kutta of order four."""
    from pendulum_sim.batches.batch_kernels import Layout

    for plant in plants:
        check_stable_step(plant, h)
    first = plants[0]
    n, joints, names = len(first.joints), first.coordinates.names, first.mechanism.parameter_names
    p = list(np.array([plant.packed for plant in plants]).T)
    table = list(
        np.array([np.concatenate([np.array(row) for row in pack_joints(plant.torque_plant)]) for plant in plants]).T
    )
    for index, motor in zip(first.coordinates.driven, motors, strict=False):
        own = np.array([plant.joints[index].damping for plant in plants])
        row = len(first.mechanism.parameters) + index
        p[row] = varied.pop(names[row], own) + motor.damping
        if np.any(motor.inductance):
            table[JOINT_ROWS.index("time_constant") * n + index] = motor.inductance / motor.resistance
    for name, values in varied.items():
        joint, _, key = name.rpartition(".")
        if name in names:
            p[names.index(name)] = values
        else:
            row = JOINT_ROWS.index(key.removeprefix("actuator_"))
            table[row * n + (joints.index(joint) if joint else 0)] = values
    for i, name in enumerate(joints):
        _check_friction(name, table[COULOMB * n + i], table[STATIC * n + i])
    if varied or motors:
        _check_masses(first, p, h)
    lagging = any(np.any(motor.inductance) for motor in motors)
    smooth = all(map(is_smooth, plants)) and not lagging and all(name in names for name in varied)
    return _Rows(Layout("rk4", first.mechanism.name, first.coordinates.driven), p, table, smooth)


def _check_friction(joint: str, coulombs: Array, statics: Array) -> None:
    coulomb, static = np.broadcast_arrays(coulombs, statics)
    if (wrong := np.flatnonzero(static < coulomb)).size:
        plant = int(wrong[0])
        raise ParameterError(
            f"static_friction of {joint} of plant {plant} is {static[plant]}; "
            f"expected >= coulomb_friction = {coulomb[plant]}"
        )


def _check_starts(coordinates: Coordinates, positions: Sequence[Array], table: Sequence[Array]) -> None:
    n = len(coordinates.joints)
    for i, joint in enumerate(coordinates.joints):
        q, low, high = np.broadcast_arrays(positions[i], *(table[row * n + i] for row in (LOWER, UPPER)))
        outside = ~((low <= q) & (q <= high) & (low < high))
        if outside.any():
            plant = int(np.argmax(outside))
            raise ParameterError(
                f"position of {joint.name} of plant {plant} is {q[plant]} {joint.unit}; expected "
                f"{low[plant]:g} to {high[plant]:g}, between its stops"
            )


def _check_masses(plant: PlantParameters, rows: Sequence[Array], h: float) -> None:
    n = len(plant.joints)
    mass = in_arithmetic(plant.mechanism.mass, np)
    p = np.broadcast_arrays(*rows)
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
