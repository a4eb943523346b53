"""Compiled loops of the batch engine: blocks of pendulums side by side, each block on one thread.

Within a block the loop over pendulums is the inner one and has no branches, so that it becomes vector code; the state
of a block stays in the first-level cache for the whole run. The equations, the integrators and the noise are those
of the single plant, compiled.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.programs.kept_kernels import keep_kernel
from pendulum_sim.batches import vector_math
from pendulum_sim.batches.compiling import WITHIN, compile_tree, tuple_loader
from pendulum_sim.stepping.dry_friction import PACKED, acceleration_with_friction, is_dry
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import advance_rigid

__all__ = ["BLOCK", "block_loop", "coefficients_kernel", "general_kernel", "run_blocks", "smooth_kernel"]

BLOCK = 256
"""Pendulums in a block."""

ROWS = (
    "x", "v", "torque", "noise", "amplitude", "gain_1", "gain_2", "limit", "delay", "max", "sum_x", "sum_xx", "sum_v",
    "sum_vv", "max_x", *PACKED,
)  # fmt: skip
"""Rows of a block's array, the integrator's coefficients below them."""
_scramble = compile_tree(noise.scramble)
_unit_interval = compile_tree(noise.unit_interval)
_wrap = compile_tree(vector_math.wrap)


def block_loop(run_block: Any, lanes: int) -> Any:
    """Return the loop over blocks, for :func:`run_blocks`.

    Args:
        run_block: Compiled loop of one block: (array, keys, target, step [s], steps, hold, more, record); ``more`` is
            its own, as a number of sub-steps.
        lanes: Plants in a block.
    """

    # Threads of Python share the blocks: numba's own would have all that is in the loop compiled three times.
    @numba.njit(nogil=True, no_cfunc_wrapper=True)
    def run(
        columns: Any, keys: Any, target: Any, step: float, steps: int, hold: int, more: Any, record: Any, begin: int,
        end: int,
    ) -> None:  # fmt: skip
        rows, size = columns.shape
        for block in range(begin, end):
            first = block * lanes
            last = min(first + lanes, size)
            # One array with rows at fixed distances: the compiler sees that no row overlaps another. Loops, because
            # assignments of slices take it far longer to compile.
            w = np.empty(rows * lanes)
            block_keys = np.empty(lanes, dtype=np.uint64)
            for j in range(lanes):
                # A block that is not full repeats its last plant.
                source = min(first + j, size - 1)
                block_keys[j] = keys[source]
                for row in range(rows):
                    w[row * lanes + j] = columns[row, source]
            run_block(w, block_keys, target, step, steps, hold, more, record[:, :, first:last])
            for row in range(rows):
                for j in range(last - first):
                    columns[row, first + j] = w[row * lanes + j]

    return run


def run_blocks(kernel: Any, lanes: int, threads: int | None, columns: NDArray[np.float64], *others: Any) -> None:
    """Run a kernel on all plants of a batch.

    Args:
        kernel: What :func:`block_loop` returned.
        lanes: Plants in its blocks.
        threads: Threads to use; None for numba's default, which is also the most.
        columns: Array of the plants, one in a column.
        others: Further arguments of the kernel, up to the record.
    """
    blocks = -(-columns.shape[1] // lanes)
    most = numba.config.NUMBA_NUM_THREADS
    count = min(threads or most, most, blocks)
    ends = [blocks * index // count for index in range(count + 1)]
    if count == 1:
        kernel(columns, *others, 0, blocks)
        return
    with ThreadPoolExecutor(count) as pool:
        # All are waited for, and what one raises is raised here.
        list(pool.map(partial(kernel, columns, *others), ends[:-1], ends[1:]))


def _starts(lanes: int) -> dict[str, int]:
    """Return where each row begins in a block's array."""
    return {name: row * lanes for row, name in enumerate((*ROWS, "coefficients"))}


def _control(lanes: int) -> Any:
    """Return the compiled loop that measures, counts, and sets the torques of a block for one step."""
    s = _starts(lanes)
    o_v, o_torque, o_noise, o_amplitude, o_limit = (s[key] for key in ("v", "torque", "noise", "amplitude", "limit"))
    o_gain_1, o_gain_2, o_max, o_max_x = (s[key] for key in ("gain_1", "gain_2", "max", "max_x"))
    o_sum_x, o_sum_xx, o_sum_v, o_sum_vv = (s[key] for key in ("sum_x", "sum_xx", "sum_v", "sum_vv"))

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def control(w: Any, keys: Any, target: float, k: int, hold: int, record: Any) -> None:
        if k % hold == 0:
            index = np.uint64(k // hold)
            for j in range(lanes):
                w[o_noise + j] = w[o_amplitude + j] * _unit_interval(_scramble(keys[j], index))
        for j in range(lanes):
            deviation = _wrap(w[j] - target)
            v = w[o_v + j]
            wanted = -(w[o_gain_1 + j] * deviation + w[o_gain_2 + j] * v)
            w[o_max + j] = max(w[o_max + j], abs(wanted))
            w[o_max_x + j] = max(w[o_max_x + j], abs(deviation))
            w[o_sum_x + j] += deviation
            w[o_sum_xx + j] += deviation * deviation
            w[o_sum_v + j] += v
            w[o_sum_vv + j] += v * v
            limit = w[o_limit + j]
            w[o_torque + j] = min(limit, max(-limit, wanted + w[o_noise + j]))
        if record.shape[0] > 0:
            for row in range(3):
                for j in range(record.shape[2]):
                    record[k, row, j] = w[row * lanes + j]

    return control


@cache
def smooth_kernel(method: str, coefficient_rows: int) -> Any:
    """Return the loop for pendulums without dry friction, lag and delay, by an integrator with its coefficients."""
    integrator = get_integrator(method)
    step = compile_tree(integrator.step, vector=True)
    acceleration = compile_tree(acceleration_with_friction, vector=True)
    load_plant = tuple_loader(len(PACKED), BLOCK)
    load_coefficients = tuple_loader(coefficient_rows, BLOCK)
    control = _control(BLOCK)
    o_v, o_torque, o_plant, o_coefficients = (_starts(BLOCK)[key] for key in ("v", "torque", PACKED[0], "coefficients"))

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def run_block(
        w: Any, keys: Any, target: float, dt: float, steps: int, hold: int, substeps: int, record: Any
    ) -> None:
        h = dt / substeps
        for k in range(steps):
            control(w, keys, target, k, hold, record)
            for _ in range(substeps):
                for j in range(BLOCK):
                    torque = w[o_torque + j]
                    w[j], w[o_v + j] = step(
                        acceleration,
                        w[j],
                        w[o_v + j],
                        torque,
                        torque,
                        torque,
                        0.0,
                        h,
                        load_coefficients(w, o_coefficients + j),
                        load_plant(w, o_plant + j),
                    )

    return keep_kernel(block_loop(run_block, BLOCK), "smooth_kernel", integrator.step, coefficient_rows)


@cache
def coefficients_kernel(method: str) -> Any:
    """Return the loop that fills ``out``, shape (coefficients, B), for damping rates of shape (B,) and one step."""
    integrator = get_integrator(method)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)

    @numba.njit(error_model="numpy", no_cfunc_wrapper=True)
    def run(rates: Any, h: float, out: Any) -> None:
        for j in range(rates.size):
            for row, value in enumerate(coefficients_of(rates[j], h)):
                out[row, j] = value

    return keep_kernel(run, "coefficients_kernel", integrator.coefficients)


@cache
def general_kernel(method: str) -> Any:
    """Return the loop for pendulums with dry friction, actuator lag or transport delay, one after another."""
    integrator = get_integrator(method)
    step = compile_tree(integrator.step, inline=True)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)
    acceleration = compile_tree(acceleration_with_friction, inline=True)
    advance = compile_tree(advance_rigid, inline=True)
    has_dry_friction = compile_tree(is_dry, inline=True)
    load_plant = tuple_loader(len(PACKED), 1)
    control = _control(1)
    o_torque, o_delay, o_plant = (_starts(1)[key] for key in ("torque", "delay", PACKED[0]))

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def run_block(
        w: Any, keys: Any, target: float, dt: float, steps: int, hold: int, substeps: int, record: Any
    ) -> None:
        plant = load_plant(w, o_plant)
        rate = plant[1] / plant[0]
        dry = has_dry_friction(plant)
        periods = w[o_delay] / dt
        if abs(periods - np.rint(periods)) < 1e-9:
            periods = np.rint(periods)
        whole = int(np.floor(periods))
        line = np.zeros(whole + 2)
        counts = np.zeros(2, dtype=np.int64)
        lengths = np.zeros(2)
        for part in range(2):
            fraction = periods - whole
            share = fraction if part == 0 else 1.0 - fraction
            if share > 0.0:
                counts[part] = max(1, int(np.ceil(share * substeps - 1e-9)))
                lengths[part] = share * dt / counts[part]
        c_0 = coefficients_of(rate, lengths[0])
        c_1 = coefficients_of(rate, lengths[1])
        torque = 0.0
        for k in range(steps):
            control(w, keys, target, k, hold, record)
            for index in range(whole + 1):
                line[index] = line[index + 1]
            line[whole + 1] = w[o_torque]
            x, v = w[0], w[1]
            for part in range(2):
                command, h = line[part], lengths[part]
                c = c_0 if part == 0 else c_1
                for _ in range(counts[part]):
                    x, v, torque = advance(
                        step, coefficients_of, acceleration, x, v, torque, command, 0.0, h, c, plant, dry
                    )
            w[0], w[1] = x, v

    kernel = block_loop(run_block, 1)
    return keep_kernel(kernel, "general_kernel", integrator.step, integrator.coefficients)
