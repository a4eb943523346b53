"""The plant of a training: its parameters as rows of numbers, and one compiled period.

The equations are the simulator's: :mod:`pendulum_sim.stepping.dry_friction` for the pendulum, and
:mod:`pendulum_msgs_py.dynamics.joint_steps` for mechanisms, both with Runge-Kutta of order four.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_learning.task import VARIED
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_steps import (
    COULOMB,
    JOINT_ROWS,
    LAG,
    LOWER,
    STATIC,
    UPPER,
    advance_joints,
    joint_functions,
)
from pendulum_msgs_py.dynamics.steps import actuator_torque
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.mechanisms import Mechanism
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay, pack_joints
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches.compiling import WITHIN, compile_by_type, compile_tree, tuple_loader
from pendulum_sim.stepping.dry_friction import LAG as LAG_OF_ONE
from pendulum_sim.stepping.dry_friction import PACKED, advance_dry, link_acceleration_of
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import pack

__all__ = ["TrainingPlant", "body_of", "can_exist", "kicks_of", "start_spread", "travel_of", "velocity_scales"]

_GROWTH = 0.8
"""Largest product of the damping rate and the step, well within Runge-Kutta's stability [-]."""
_LONGEST, _LONGEST_OF_SEVERAL = 0.01, 0.005
_ANGLES = 32
BEYOND = 1.25
"""Position of the end stops in training, as a share of the allowed travel [-]."""


@dataclass(frozen=True)
class TrainingPlant:
    """A plant as a training needs it; n joints, m of them driven.

    Attributes:
        limits: Largest effort of each driven joint, shape (m,) [N m or N].
        kicks: Largest kick of each joint at share 1, shape (n,): its effort limit, or without a motor the largest
            torque of gravity [N m or N].
        row: Its parameters in the order of the kernel, shape (p,).
        columns: Column of each parameter in ``row``, by name.
        ratios: Columns of static and Coulomb friction, and their fixed ratio, of each joint that has any.
        offsets: Columns of the constant effort at each driven joint.
        longest: Longest step of the integrator [s].
        advance: Compiled: motion, parameters, efforts, delays, kicks, period and longest step to the next motion.
        privileged: From parameters (N, p) to the critic's view of them, shape (N, k).
        height: From deviations (N, n) to the height, -1 to 1, shape (N,).
        excess: From deviations (N, n), velocities (N, n) and parameters (N, p) to the energy above rest upright, -1
            hanging at rest, shape (N,); None if each joint is driven.
        possible: From parameters (N, p) to whether they make a plant, shape (N,).
        held: From parameters (N, p), efforts (N, 1) and whether above the middle (N,) to the deviations at which
            gravity and effort balance, shape (N, 1); None for several joints.
    """

    coordinates: Coordinates
    limits: Array
    kicks: Array
    row: Array
    columns: Mapping[str, int]
    ratios: tuple[tuple[int, int, float], ...]
    offsets: tuple[int, ...]
    longest: float
    advance: Callable[..., None]
    privileged: Callable[[Array], list[Array]]
    height: Callable[[Array], Array]
    excess: Callable[[Array, Array, Array], Array] | None
    possible: Callable[[Array], NDArray[np.bool_]]
    held: Callable[[Array, Array, NDArray[np.bool_]], Array] | None


def body_of(plant: PlantParameters, ranges: Mapping[str, tuple[float, float]], travel: float) -> TrainingPlant:
    """Return what a training needs of a plant, with the range of each varied parameter and ``travel`` [m].

    A ParameterError if it is series elastic, has no motor, or a delay of its own.
    """
    if not plant.is_pendulum:
        return _mechanism(plant, ranges, travel)
    if plant.drivetrain is not None:
        raise ParameterError(
            f"plant {plant.name!r} is series elastic; expected a rigid one, such as the plant that `identify` fits"
        )
    return _pendulum(plant, ranges)


def travel_of(plant: PlantParameters, travel: float) -> tuple[float, ...]:
    """Return each joint's largest deviation in training: pi if it turns, else from ``travel`` [rad or m]."""
    return tuple(
        math.pi if joint.turns else min(BEYOND * travel, joint.goal - low, high - joint.goal)
        for joint, (low, high) in zip(plant.coordinates.joints, plant.stops, strict=True)
    )


_START_SPEED, _START_SLIDE = 0.7, 0.25
"""Velocities at a start, as a share of the scale, of joints that turn and that slide [-]."""
_START_TRAVEL = 0.6
"""Largest deviation at a start of joints that slide, as a share of the way to the stop [-]."""


def start_spread(plant: PlantParameters, travel: float, scales: Sequence[float]) -> tuple[Array, Array]:
    """Return the largest start deviations from upright and speeds [rad or m, rad/s or m/s]."""
    turns = np.array([joint.turns for joint in plant.coordinates.joints])
    furthest = np.where(turns, math.pi, _START_TRAVEL * np.array(travel_of(plant, travel)))
    return furthest, np.where(turns, _START_SPEED, _START_SLIDE) * np.array(scales)


def can_exist(mechanism: Mechanism, parameters: Array) -> NDArray[np.bool_]:
    """Return whether each body's inertia about its centre is positive, for parameters of shape (N, p); shape (N,)."""
    good = np.ones(len(parameters), dtype=np.bool_)
    for body in mechanism.bodies(tuple(parameters.T)):
        for value in (body.mass, *body.inertia):
            good &= np.asarray(value) > 0.0
    return good


def kicks_of(plant: PlantParameters) -> Array:
    """Return the largest kick of each joint at share 1: its effort limit, or the largest torque of gravity."""
    if plant.is_pendulum:
        return np.array([plant.effort_limit])
    limits = dict(zip(plant.coordinates.driven, plant.effort_limits, strict=True))
    return np.array([limits.get(i, torque) for i, torque in enumerate(_gravity(plant))])


def velocity_scales(plant: PlantParameters, travel: float) -> tuple[float, ...]:
    """Return the velocity of each joint that is scaled to 1 [rad/s or m/s].

    Under gravity, half of its frictionless speed after a fall from upright, at least 1; for a sliding joint, half of
    the speed that its motor reaches over ``travel`` [m].
    """
    if plant.is_pendulum:
        return (max(1.0, math.sqrt(plant.gravity / plant.inertia)),)
    n, driven = len(plant.joints), plant.coordinates.driven
    masses = plant.mechanism.mass((0.0,) * n, plant.packed)
    found = []
    for i, (joint, torque) in enumerate(zip(plant.mechanism.joints, _gravity(plant), strict=True)):
        if joint.turns:
            found.append(max(1.0, math.sqrt(torque / masses[i][i])))
        else:
            force = plant.effort_limits[driven.index(i)] if i in driven else masses[i][i] * 9.81
            found.append(math.sqrt(0.5 * force * travel / masses[i][i]))
    return tuple(found)


def _gravity(plant: PlantParameters) -> tuple[float, ...]:
    n, step = len(plant.joints), 1e-6
    found = []
    for i in range(n):
        slopes = []
        for angle in np.linspace(-math.pi, math.pi, _ANGLES, endpoint=False):
            ends = [tuple(float(angle) + way * step if k == i else 0.0 for k in range(n)) for way in (-1.0, 1.0)]
            low, high = (plant.mechanism.potential(q, plant.packed) for q in ends)
            slopes.append(abs(high - low) / (2.0 * step))
        found.append(max(slopes))
    return tuple(found)


def _pendulum(plant: PlantParameters, ranges: Mapping[str, tuple[float, float]]) -> TrainingPlant:
    columns = {name: k for k, name in enumerate(PACKED)}
    inertia, damping, gravity, coulomb = (columns[each] for each in VARIED)
    limit = plant.effort_limit
    fastest = ranges.get("damping", (0.0, plant.damping))[1]
    lightest = ranges.get("inertia", (plant.inertia, plant.inertia))[0]
    longest = min(_LONGEST, _GROWTH * lightest / fastest if fastest > 0.0 else _LONGEST)

    def privileged(parameters: Array) -> list[Array]:
        return [
            parameters[:, gravity] / limit - plant.gravity / limit,
            parameters[:, inertia] / plant.inertia - 1.0,
            (parameters[:, coulomb] - plant.coulomb_friction + parameters[:, damping] - plant.damping) / limit,
        ]

    def held(parameters: Array, efforts: Array, above: NDArray[np.bool_]) -> Array:
        x = np.arcsin(np.clip(-efforts / np.maximum(parameters[:, [gravity]], 1e-9), -1.0, 1.0))
        return np.where(above[:, None], x, math.pi - x)

    return TrainingPlant(
        coordinates=plant.coordinates,
        limits=np.array([limit]),
        kicks=kicks_of(plant),
        row=np.array(pack(plant), dtype=np.float64),
        columns=columns,
        ratios=_ratio(coulomb + 1, coulomb, plant.static_friction, plant.coulomb_friction),
        offsets=(columns["torque_offset"],),
        longest=longest,
        advance=_pendulum_kernel(plant.has_torques),
        privileged=privileged,
        height=lambda x: np.cos(x[:, 0]),
        excess=None,
        possible=lambda parameters: np.ones(len(parameters), dtype=np.bool_),
        held=held,
    )


def _mechanism(plant: PlantParameters, ranges: Mapping[str, tuple[float, float]], travel: float) -> TrainingPlant:
    coordinates, mechanism = plant.coordinates, plant.mechanism
    n, driven = len(plant.joints), coordinates.driven
    if not driven:
        raise ParameterError(f"plant {plant.name!r} has no driven joint; expected an actuator at one of them")
    if common_delay(plant) > 0.0:
        raise ParameterError(
            f"transport_delay of plant {plant.name!r} is {common_delay(plant):g} s; expected none in the plant: a "
            "training draws delays of its own"
        )
    width = len(plant.packed)
    table = [list(row) for row in pack_joints(plant)]
    for i, (joint, reach) in enumerate(zip(mechanism.joints, travel_of(plant, travel), strict=True)):
        if not joint.turns:
            table[LOWER][i], table[UPPER][i] = joint.goal - reach, joint.goal + reach
    row = np.array([*plant.packed, *(value for each in table for value in each), *([0.0] * n)])
    columns = {name: k for k, name in enumerate(mechanism.parameter_names)}
    columns |= {f"{joint.name}.damping": len(plant.values) + i for i, joint in enumerate(mechanism.joints)}
    for kind in (COULOMB, STATIC):
        for i, joint in enumerate(mechanism.joints):
            columns[f"{joint.name}.{JOINT_ROWS[kind]}"] = width + kind * n + i
    last = width + len(JOINT_ROWS) * n
    scales = {columns[name]: max(0.5 * (high - low), 1e-12) for name, (low, high) in ranges.items()}
    centre = row.copy()
    potential = in_arithmetic(mechanism.potential, np)
    bottom = mechanism.potential((0.0,) * n, plant.packed)
    top = mechanism.potential(coordinates.goal, plant.packed)
    goal = coordinates.goal
    masses = in_arithmetic(mechanism.mass, np)

    def height(x: Array) -> Array:
        above: Array = potential(tuple((x + goal).T), plant.packed)
        return (2.0 * above - top - bottom) / (top - bottom)

    def excess(x: Array, v: Array, parameters: Array) -> Array:
        p, q = tuple(parameters[:, :width].T), tuple((x + goal).T)
        ends = [potential(tuple(np.full(len(x), value) for value in at), p) for at in ((0.0,) * n, goal)]
        moving = sum(
            0.5 * v[:, i] * entry * v[:, k] for i, entries in enumerate(masses(q, p)) for k, entry in enumerate(entries)
        )
        found: Array = (moving + potential(q, p) - ends[1]) / (ends[1] - ends[0])
        return found

    return TrainingPlant(
        coordinates=coordinates,
        limits=np.array(plant.effort_limits),
        kicks=kicks_of(plant),
        row=row,
        columns=columns,
        ratios=tuple(
            each
            for i, joint in enumerate(plant.joints)
            for each in _ratio(width + STATIC * n + i, width + COULOMB * n + i, joint.breakaway, joint.coulomb_friction)
        ),
        offsets=tuple(last + i for i in driven),
        longest=min(_LONGEST_OF_SEVERAL, _GROWTH / max(_decay(plant), 1.0)),
        advance=_mechanism_kernel(mechanism.name, goal),
        privileged=lambda parameters: [(parameters[:, k] - centre[k]) / half for k, half in scales.items()],
        height=height,
        excess=excess if len(driven) < n else None,
        possible=lambda parameters: can_exist(mechanism, parameters[:, :width]),
        held=None,
    )


def _ratio(static: int, coulomb: int, value: float, of: float) -> tuple[tuple[int, int, float], ...]:
    return ((static, coulomb, value / of),) if of > 0.0 else ()


def _decay(plant: PlantParameters) -> float:
    """Return the largest damping rate of a joint, with half of its inertia as a margin [1/s]."""
    n = len(plant.joints)
    damping = np.diag([joint.damping for joint in plant.joints])
    rates = [0.0]
    for angle in np.linspace(0.0, np.pi, 9):
        rows = np.array(plant.mechanism.mass((float(angle),) * n, plant.packed))
        rates.append(2.0 * float(np.max(np.linalg.eigvals(np.linalg.solve(rows, damping)).real)))
    return max(rates)


@cache
def _pendulum_kernel(torques: bool) -> Any:
    integrator = get_integrator("rk4")
    step = compile_tree(integrator.step, inline=True)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)
    equation = link_acceleration_of(torques)
    acceleration = compile_tree(equation, inline=True)
    advance = compile_tree(advance_dry, inline=True)
    lagged = compile_tree(actuator_torque, inline=True)
    load_plant = tuple_loader(len(PACKED), 1)

    @numba.njit(error_model="numpy", forceinline=True, **WITHIN)
    def prepare(parameters: Any, longest: float) -> Any:
        plant = load_plant(parameters, 0)
        return plant, coefficients_of(plant[1] / plant[0], longest)

    @numba.njit(error_model="numpy", forceinline=True, **WITHIN)
    def forward(q: Any, v: Any, torque: Any, command: Any, push: Any, h: float, prepared: Any) -> Any:
        plant, c = prepared
        theta, speed = advance(
            step, coefficients_of, acceleration, q[0], v[0], torque[0], command[0], push[0], h, c, plant
        )
        return (theta,), (speed,), (lagged(torque[0], command[0], h, plant[LAG_OF_ONE]),)

    made_of = (equation, advance_dry, integrator.step, integrator.coefficients)
    return keep_kernel(_kernel((math.pi,), prepare, forward), "training_pendulum", *made_of)


@cache
def _mechanism_kernel(name: str, goal: tuple[float, ...]) -> Any:
    from pendulum_msgs_py.mechanisms import MECHANISMS

    mechanism = MECHANISMS[name]
    n, width = len(mechanism.joints), len(mechanism.parameter_names)
    equation, along, put, lag = (compile_by_type(each) for each in (mechanism.forward, *joint_functions(n)))
    advance = compile_tree(advance_joints)
    load, load_p = tuple_loader(n, 1), tuple_loader(width, 1)
    last = width + len(JOINT_ROWS) * n

    @numba.njit(error_model="numpy", forceinline=True, **WITHIN)
    def prepare(parameters: Any, _longest: float) -> Any:
        table = (
            load(parameters, width),
            load(parameters, width + n),
            load(parameters, width + 2 * n),
            load(parameters, width + 3 * n),
            load(parameters, width + 4 * n),
            load(parameters, width + 5 * n),
        )
        return load_p(parameters, 0), table, load(parameters, last)

    @numba.njit(error_model="numpy", forceinline=True, **WITHIN)
    def forward(q: Any, v: Any, torque: Any, command: Any, push: Any, h: float, prepared: Any) -> Any:
        p, table, offset = prepared
        total = along(push, 1.0, offset)
        q, v = advance(equation, along, put, lag, q, v, torque, command, total, h, p, table)
        return q, v, lag(torque, command, h, table[LAG])

    made_of = (mechanism.forward, compile_tree, name, goal)
    return keep_kernel(_kernel(goal, prepare, forward), "training_mechanism", *made_of)


def _kernel(goal: tuple[float, ...], prepare: Any, forward: Any) -> Any:
    n = len(goal)
    load = tuple_loader(n, 1)

    @numba.njit(error_model="numpy")
    def run(motion: Any, parameters: Any, efforts: Any, late: Any, pushes: Any, period: float, longest: float) -> None:
        for j in range(motion.shape[0]):
            row = motion[j]
            prepared = prepare(parameters[j], longest)
            # Positions are those from upright; the equations count from hanging.
            for i in range(n):
                row[i] += goal[i]
            q, v, torque = load(row, 0), load(row, n), load(row, 2 * n)
            held, pending, arrives = load(row, 3 * n), load(row, 4 * n), row[5 * n]
            push, newest = load(pushes[j], 0), load(efforts[j], 0)
            first = min(max(arrives, 0.0), period)
            # Commands stay in order, at most two periods late.
            comes = min(max(late[j], arrives), 2.0 * period)
            second = min(max(comes, first), period)
            for part in range(3):
                start = 0.0 if part == 0 else (first if part == 1 else second)
                end = first if part == 0 else (second if part == 1 else period)
                command = held if part == 0 else (pending if part == 1 else newest)
                if end <= start:
                    continue
                count = int(np.ceil((end - start) / longest - 1e-9))
                h = (end - start) / count
                for _ in range(count):
                    q, v, torque = forward(q, v, torque, command, push, h, prepared)
            for i in range(n):
                row[i], row[n + i], row[2 * n + i] = q[i] - goal[i], v[i], torque[i]
                row[3 * n + i] = pending[i] if comes >= period else newest[i]
                row[4 * n + i] = newest[i]
            row[5 * n] = comes - period if comes >= period else 0.0

    return run
