"""Compiled loops of the batch engine: blocks of plants side by side, each block on one thread, or one on a GPU.

Within a block the loop over plants is the inner one and has no branches where nothing sticks, so that it becomes vector
code; the state of a block stays in the first-level cache for the whole run. On a GPU a block is one plant, whose state
stays in registers. Equations, integrators and noise are those of the single plant, compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial, reduce
from typing import Any

import numba
import numpy as np

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.dynamics.joint_steps import JOINT_ROWS, LAG, advance_joints, joint_functions
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches import vector_math
from pendulum_sim.batches.compiling import WITHIN, compile_tree, tuple_loader
from pendulum_sim.stepping.dry_friction import PACKED, is_dry, link_acceleration_of
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import advance_rigid

__all__ = ["BLOCK", "Layout", "coefficients_kernel", "lane", "loop", "run_threads"]

BLOCK = 256
"""Plants in a block that becomes vector code."""
_FIRST = np.uint64(1)
_OPTIONS: Any = {"fastmath": {"contract"}, "error_model": "numpy", **WITHIN}
_INLINE: Any = {"forceinline": True, **_OPTIONS}


@dataclass(frozen=True)
class Layout:
    """First row of each quantity in a block's array, for n joints of which m are driven.

    Attributes:
        method: Integrator of a rigid link.
        mechanism: Name of a mechanism, which Runge-Kutta integrates; empty for a rigid link.
        driven: Indices of the driven joints.
        torques: Whether a rigid link has torques of its own.
    """

    method: str
    mechanism: str = ""
    driven: tuple[int, ...] = (0,)
    torques: bool = False

    @property
    def turns(self) -> tuple[bool, ...]:
        """Whether each joint turns, so that its deviation is wrapped."""
        return tuple(joint.turns for joint in MECHANISMS[self.mechanism].joints) if self.mechanism else (True,)

    @property
    def starts(self) -> dict[str, int]:
        """First row by quantity; the results end at ``results``, all rows at ``end``."""
        n, m = len(self.turns), len(self.driven)
        if self.mechanism:
            own = {"p": len(MECHANISMS[self.mechanism].parameter_names), "table": len(JOINT_ROWS) * n}
        else:
            own = {"p": len(PACKED), "table": len(get_integrator(self.method).coefficients(1.0, 1e-3))}
        sizes = {
            "q": n, "v": n, "effort": n, "max_effort": m, "max": n, "sum": n, "square": n, "sum_v": n, "square_v": n,
            "results": 0, "noise": m, "deviation": n, "goal": n, "amplitude": m, "limit": m, "gain": m * 2 * n,
            "delay": 1, **own,
        }  # fmt: skip
        starts, row = {}, 0
        for key, size in sizes.items():
            starts[key] = row
            row += size
        return {**starts, "end": row}

    def offsets(self, lanes: int) -> dict[str, int]:
        """Return where each quantity begins in the array of a block of plants."""
        return {key: row * lanes for key, row in self.starts.items()}


@cache
def loop(layout: Layout, *, smooth: bool) -> Any:
    """Return the loop over blocks, for :func:`run_threads`.

    Args:
        layout: Of the plants.
        smooth: None of them has dry friction, end stops, lag or delay.
    """
    lanes = BLOCK if smooth else 1
    run_block = (_smooth_block if smooth else _general_block)(layout, lanes, gpu=False)
    scramble = compile_tree(noise.scramble)
    joints = len(layout.turns)

    # Threads of Python share the blocks: numba's own would have all that is in the loop compiled three times.
    @numba.njit(nogil=True, no_cfunc_wrapper=True)
    def run(
        constants: Any, source: Any, varied: Any, seeds: Any, results: Any, dt: float, steps: int, hold: int,
        substeps: int, record: Any, depth: int, begin: int, end: int,
    ) -> None:  # fmt: skip
        size = results.shape[1]
        line = np.zeros((depth, joints))
        # One array with rows at fixed distances: the compiler sees that no row overlaps another. Loops, because
        # assignments of slices take it far longer to compile.
        w = np.empty(constants.size * lanes)
        keys = np.empty(lanes, dtype=np.uint64)
        for block in range(begin, end):
            first = block * lanes
            last = min(first + lanes, size)
            for j in range(lanes):
                # A block that is not full repeats its last plant.
                plant = min(first + j, size - 1)
                keys[j] = scramble(seeds[min(plant, seeds.size - 1)], _FIRST)
                for row in range(constants.size):
                    w[row * lanes + j] = constants[row] if source[row] < 0 else varied[source[row], plant]
            run_block(w, keys, dt, steps, hold, substeps, record[:, :, first:last], line)
            for row in range(results.shape[0]):
                for j in range(last - first):
                    results[row, first + j] = w[row * lanes + j]

    return keep_kernel(run, "loop", *_source(layout), layout, smooth)


def run_threads(kernel: Any, lanes: int, threads: int | None, size: int, *arguments: Any) -> None:
    """Run a loop on all plants of a batch.

    Args:
        kernel: What :func:`loop` returned.
        lanes: Plants in its blocks.
        threads: Threads to use; None for numba's default, which is also the most.
        size: Plants.
        arguments: Of the loop, up to the first block.
    """
    blocks = -(-size // lanes)
    most = numba.config.NUMBA_NUM_THREADS
    count = min(threads or most, most, blocks)
    ends = [blocks * index // count for index in range(count + 1)]
    if count == 1:
        kernel(*arguments, 0, blocks)
        return
    with ThreadPoolExecutor(count) as pool:
        # All are waited for, and what one raises is raised here.
        list(pool.map(partial(kernel, *arguments), ends[:-1], ends[1:]))


def lane(layout: Layout, *, smooth: bool, gpu: bool) -> Any:
    """Return the compiled loop of one plant: (array, seed, step [s], steps, hold, substeps, record, delay line).

    Args:
        layout: Of the plant.
        smooth: As of :func:`loop`.
        gpu: Compile for a GPU.
    """
    run_block = (_smooth_block if smooth else _general_block)(layout, 1, gpu=gpu)
    scramble = compile_tree(noise.scramble)
    fill = _coefficients(layout)

    # With a wrapper: a simulated GPU calls it from Python.
    @numba.njit(fastmath={"contract"}, error_model="numpy", no_cfunc_wrapper=True)
    def run(w: Any, seed: Any, dt: float, steps: int, hold: int, substeps: int, record: Any, line: Any) -> None:
        fill(w, dt / substeps)
        run_block(w, (scramble(seed, _FIRST),), dt, steps, hold, substeps, record, line)

    return run if gpu else keep_kernel(run, "lane", *_source(layout), layout, smooth)


@cache
def coefficients_kernel(method: str) -> Any:
    """Return the loop that fills ``out``, shape (coefficients, B), for damping rates of shape (B,) and one step."""
    integrator = get_integrator(method)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)

    @numba.njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)
    def run(rates: Any, h: float, out: Any) -> None:
        for j in range(rates.size):
            for row, value in enumerate(coefficients_of(rates[j], h)):
                out[row, j] = value

    return keep_kernel(run, "coefficients_kernel", integrator.coefficients)


def _source(layout: Layout) -> tuple[Callable[..., Any], ...]:
    """Return the functions of a layout that a loop is made of."""
    if layout.mechanism:
        return (MECHANISMS[layout.mechanism].forward,)
    integrator = get_integrator(layout.method)
    return integrator.step, integrator.coefficients


def _coefficients(layout: Layout) -> Any:
    """Return the compiled function that fills in the integrator's coefficients of one rigid link for a step."""
    o_p, o_table = layout.starts["p"], layout.starts["table"]
    if layout.mechanism:
        return numba.njit(lambda w, h: None, **_INLINE)
    coefficients_of = compile_tree(get_integrator(layout.method).coefficients, inline=True)
    store = _storer(layout.starts["end"] - o_table, 1)

    @numba.njit(**_INLINE)
    def fill(w: Any, h: float) -> None:
        store(w, o_table, coefficients_of(w[o_p + 1] / w[o_p], h))

    return fill


def _in_turn(functions: Sequence[Any]) -> Any:
    """Return a compiled function that calls each of some with its arguments (array, plant)."""

    def both(first: Any, second: Any) -> Any:
        def call(w: Any, j: int) -> None:
            first(w, j)
            second(w, j)

        return numba.njit(call, **_INLINE)

    return reduce(both, functions, numba.njit(lambda w, j: None, **_INLINE))


def _control(layout: Layout, lanes: int, *, gpu: bool) -> Any:
    """Return the compiled loop that measures, counts, and sets the efforts of a block for one step.

    Its arguments: array, keys, step, number of the noise sample that begins there or -1, record.
    """
    n, m = len(layout.turns), len(layout.driven)
    o = layout.offsets(lanes)
    o_v, o_effort, o_noise, o_amplitude, o_limit = (o[key] for key in ("v", "effort", "noise", "amplitude", "limit"))
    o_gain, o_deviation, o_goal, o_max_effort = (o[key] for key in ("gain", "deviation", "goal", "max_effort"))
    o_max, o_sum, o_square, o_sum_v, o_square_v = (o[key] for key in ("max", "sum", "square", "sum_v", "square_v"))
    scramble, unit_interval = compile_tree(noise.scramble), compile_tree(noise.unit_interval)
    wrap = compile_tree(vector_math.wrap, gpu=gpu)

    def measuring(i: int) -> Any:
        row, turns = i * lanes, layout.turns[i]

        def measure(w: Any, j: int) -> None:
            at = row + j
            deviation = w[at] - w[o_goal + at]
            if turns:
                deviation = wrap(deviation)
            v = w[o_v + at]
            w[o_deviation + at] = deviation
            w[o_max + at] = max(w[o_max + at], abs(deviation))
            w[o_sum + at] += deviation
            w[o_square + at] += deviation * deviation
            w[o_sum_v + at] += v
            w[o_square_v + at] += v * v

        return numba.njit(measure, **_INLINE)

    def driving(a: int) -> Any:
        row, o_torque, o_row = a * lanes, o_effort + layout.driven[a] * lanes, o_gain + a * 2 * n * lanes
        positions = [i * lanes for i in range(n)]
        last = positions[-1]

        def drive(w: Any, j: int) -> None:
            total = w[o_row + n * lanes + last + j] * w[o_v + last + j]
            for i in range(n - 1):
                total = w[o_row + (n + i) * lanes + j] * w[o_v + i * lanes + j] + total
            for i in range(n):
                total = w[o_row + i * lanes + j] * w[o_deviation + i * lanes + j] + total
            wanted = -total
            w[o_max_effort + row + j] = max(w[o_max_effort + row + j], abs(wanted))
            limit = w[o_limit + row + j]
            w[o_torque + j] = min(limit, max(-limit, wanted + w[o_noise + row + j]))

        return numba.njit(drive, **_INLINE)

    command = _in_turn([*map(measuring, range(n)), *map(driving, range(m))])

    @numba.njit(**_OPTIONS)
    def control(w: Any, keys: Any, k: int, sample: int, record: Any) -> None:
        if sample >= 0:
            for a in range(m):
                index = np.uint64(sample * m + a)
                for j in range(lanes):
                    unit = unit_interval(scramble(keys[j], index))
                    w[o_noise + a * lanes + j] = w[o_amplitude + a * lanes + j] * unit
        for j in range(lanes):
            command(w, j)
        if record.shape[0] > 0:
            for row in range(3 * n):
                # Of a block of one, a constant, so that its array can stay in registers.
                for j in range(record.shape[2] if lanes > 1 else 1):
                    record[k, row, j] = w[row * lanes + j]

    return control


@cache
def _storer(length: int, stride: int) -> Any:
    """Return the compiled function (array, start, tuple) that stores what ``tuple_loader`` loads."""
    half = length // 2
    offset = half * stride
    if length == 1:

        def store(w: Any, start: int, values: Any) -> None:
            w[start] = values[0]

    else:
        first, second = _storer(half, stride), _storer(length - half, stride)

        def store(w: Any, start: int, values: Any) -> None:
            first(w, start, values[:half])
            second(w, start + offset, values[half:])

    return numba.njit(store, **_INLINE)


def _smooth_block(layout: Layout, lanes: int, *, gpu: bool) -> Any:
    """Return the loop of a block of plants without dry friction, stops, lag and delay."""
    control = _control(layout, lanes, gpu=gpu)
    move = (_move_joints if layout.mechanism else _move_link)(layout, lanes, gpu=gpu)

    @numba.njit(**_OPTIONS)
    def run_block(w: Any, keys: Any, dt: float, steps: int, hold: int, substeps: int, record: Any, _line: Any) -> None:
        h = dt / substeps
        held = sample = 0
        for k in range(steps):
            control(w, keys, k, sample if held == 0 else -1, record)
            held += 1
            if held == hold:
                held, sample = 0, sample + 1
            for _ in range(substeps):
                for j in range(lanes):
                    move(w, j, h)

    return run_block


def _move_link(layout: Layout, lanes: int, *, gpu: bool) -> Any:
    """Return the compiled smooth step of one rigid link of a block."""
    o = layout.offsets(lanes)
    o_v, o_effort, o_p, o_table = (o[key] for key in ("v", "effort", "p", "table"))
    step = compile_tree(get_integrator(layout.method).step, vector=True, gpu=gpu)
    acceleration = compile_tree(link_acceleration_of(layout.torques), vector=True, gpu=gpu)
    load_plant = tuple_loader(len(PACKED), lanes)
    load_coefficients = tuple_loader(layout.starts["end"] - layout.starts["table"], lanes)

    @numba.njit(**_INLINE)
    def move(w: Any, j: int, h: float) -> None:
        torque = w[o_effort + j]
        c, plant = load_coefficients(w, o_table + j), load_plant(w, o_p + j)
        w[j], w[o_v + j] = step(acceleration, w[j], w[o_v + j], torque, torque, torque, 0.0, h, c, plant)

    return move


def _move_joints(layout: Layout, lanes: int, *, gpu: bool) -> Any:
    """Return the compiled smooth step of one mechanism of a block."""
    n, mechanism = len(layout.turns), MECHANISMS[layout.mechanism]
    o = layout.offsets(lanes)
    o_v, o_effort, o_p = (o[key] for key in ("v", "effort", "p"))
    forward, along, step = (
        compile_tree(function, vector=True, gpu=gpu) for function in (mechanism.forward, along_functions(n), rk4_joints)
    )
    load, load_p = tuple_loader(n, lanes), tuple_loader(len(mechanism.parameter_names), lanes)
    store = _storer(n, lanes)

    @numba.njit(**_INLINE)
    def move(w: Any, j: int, h: float) -> None:
        effort = load(w, o_effort + j)
        q, v = step(forward, along, load(w, j), load(w, o_v + j), effort, effort, effort, h, load_p(w, o_p + j))
        store(w, j, q)
        store(w, o_v + j, v)

    return move


def _general_block(layout: Layout, _lanes: int, *, gpu: bool) -> Any:
    """Return the loop of one plant with dry friction, end stops, actuator lag or transport delay."""
    n = len(layout.turns)
    o_v, o_effort, o_delay = (layout.starts[key] for key in ("v", "effort", "delay"))
    control = _control(layout, 1, gpu=gpu)
    prepare, advance = (_advance_joints if layout.mechanism else _advance_link)(layout)
    load, store = tuple_loader(n, 1), _storer(n, 1)

    @numba.njit(**_OPTIONS)
    def run_block(w: Any, keys: Any, dt: float, steps: int, hold: int, substeps: int, record: Any, line: Any) -> None:
        periods = w[o_delay] / dt
        # On a GPU floor and ceiling are no whole numbers.
        nearest = int(math.floor(periods + 0.5))  # noqa: RUF046
        if abs(periods - nearest) < 1e-9:
            periods = float(nearest)
        whole = int(math.floor(periods))  # noqa: RUF046
        # A period begins with the older command and ends with the newer one.
        share_0 = periods - whole
        share_1 = 1.0 - share_0
        count_1 = max(1, int(math.ceil(share_1 * substeps - 1e-9)))  # noqa: RUF046
        count_0 = max(1, int(math.ceil(share_0 * substeps - 1e-9))) if share_0 > 0.0 else 0  # noqa: RUF046
        h_0, h_1 = share_0 * dt / max(1, count_0), share_1 * dt / count_1
        ready = prepare(w, h_0, h_1)
        slots = whole + 2
        for slot in range(slots):
            for i in range(n):
                line[slot, i] = 0.0
        torque = load(line[0], 0)
        held = sample = 0
        for k in range(steps):
            control(w, keys, k, sample if held == 0 else -1, record)
            held += 1
            if held == hold:
                held, sample = 0, sample + 1
            for i in range(n):
                line[k % slots, i] = w[o_effort + i]
            q, v = load(w, 0), load(w, o_v)
            for part in range(2):
                command = load(line[(k + 1 + part) % slots], 0)
                h, count = (h_0, count_0) if part == 0 else (h_1, count_1)
                for _ in range(count):
                    q, v, torque = advance(ready, part, q, v, torque, command, h)
            store(w, 0, q)
            store(w, o_v, v)

    return run_block


def _advance_link(layout: Layout) -> tuple[Any, Any]:
    """Return the compiled functions that load a rigid link and advance it under one command."""
    integrator = get_integrator(layout.method)
    step, coefficients_of, acceleration, advance_one, has_dry_friction = (
        compile_tree(function, inline=True)
        for function in (
            integrator.step,
            integrator.coefficients,
            link_acceleration_of(layout.torques),
            advance_rigid,
            is_dry,
        )
    )
    load_plant = tuple_loader(len(PACKED), 1)
    o_p = layout.starts["p"]

    @numba.njit(**_INLINE)
    def prepare(w: Any, h_0: float, h_1: float) -> Any:
        plant = load_plant(w, o_p)
        rate = plant[1] / plant[0]
        return plant, has_dry_friction(plant), coefficients_of(rate, h_0), coefficients_of(rate, h_1)

    @numba.njit(**_INLINE)
    def advance(ready: Any, part: int, q: Any, v: Any, torque: Any, command: Any, h: float) -> Any:
        plant, dry, c_0, c_1 = ready
        c = c_0 if part == 0 else c_1
        x, x_dot, effort = advance_one(
            step, coefficients_of, acceleration, q[0], v[0], torque[0], command[0], 0.0, h, c, plant, dry
        )
        return (x,), (x_dot,), (effort,)

    return prepare, advance


def _advance_joints(layout: Layout) -> tuple[Any, Any]:
    """Return the compiled functions that load a mechanism and advance it under one command."""
    n, mechanism = len(layout.turns), MECHANISMS[layout.mechanism]
    o_p, o_table = layout.starts["p"], layout.starts["table"]
    functions: list[Callable[..., Any]] = [mechanism.forward, *joint_functions(n), advance_joints]
    forward, along, put, lag, advance_all = (compile_tree(function, inline=True) for function in functions)
    load, load_p = tuple_loader(n, 1), tuple_loader(len(mechanism.parameter_names), 1)

    @numba.njit(**_INLINE)
    def prepare(w: Any, _h_0: float, _h_1: float) -> Any:
        table = (
            load(w, o_table),
            load(w, o_table + n),
            load(w, o_table + 2 * n),
            load(w, o_table + 3 * n),
            load(w, o_table + 4 * n),
            load(w, o_table + 5 * n),
        )
        return load_p(w, o_p), table

    @numba.njit(**_INLINE)
    def advance(ready: Any, _part: int, q: Any, v: Any, torque: Any, command: Any, h: float) -> Any:
        p, table = ready
        still = along(command, -1.0, command)
        q, v = advance_all(forward, along, put, lag, q, v, torque, command, still, h, p, table)
        return q, v, lag(torque, command, h, table[LAG])

    return prepare, advance
