"""Compiled loops of the batch engine: blocks of pendulums side by side, each block on one thread.

Within a block the loop over pendulums is the inner one and has no branches, so that it becomes vector code; the state
of a block stays in the first-level cache for the whole run. The equations, the integrators and the noise are those
of the single plant, compiled.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.dynamics.steps import actuator_torque
from pendulum_msgs_py.programs.kept_kernels import keep_kernel
from pendulum_sim import vector_math
from pendulum_sim.compiling import compile_tree, tuple_loader
from pendulum_sim.dry_friction import LAG, PACKED, acceleration_with_friction, advance_dry, is_dry
from pendulum_sim.integrators import get_integrator

__all__ = ["BLOCK", "block_loop", "coefficients_kernel", "general_kernel", "smooth_kernel"]

BLOCK = 256
"""Pendulums in a block."""

_PLANT_ROWS = len(PACKED)
ROWS = (
    "x", "v", "torque", "noise", "amplitude", "gain_1", "gain_2", "limit", "max", "sum_x", "sum_xx", "sum_v", "sum_vv",
    "max_x", *PACKED,
)  # fmt: skip
"""Rows of a block's array, the integrator's coefficients below them."""
(
    _X, _V, _TORQUE, _NOISE, _AMPLITUDE, _GAIN_1, _GAIN_2, _LIMIT, _MAX, _SUM_X, _SUM_XX, _SUM_V, _SUM_VV,
    _MAX_X, _PLANT,
) = (row * BLOCK for row in range(len(ROWS) - _PLANT_ROWS + 1))  # fmt: skip
_COEFFICIENTS = len(ROWS) * BLOCK
_scramble = compile_tree(noise.scramble)
_unit_interval = compile_tree(noise.unit_interval)
_wrap = compile_tree(vector_math.wrap)


def block_loop(run_block: Any, lanes: int) -> Any:
    """Return the loop over blocks, in parallel.

    Args:
        run_block: Compiled loop of one block: (array, keys, target, step [s], steps, hold, more, record); ``more`` is
            its own, as a number of sub-steps.
        lanes: Plants in a block.
    """

    @numba.njit(parallel=True)
    def run(columns: Any, keys: Any, target: Any, step: float, steps: int, hold: int, more: Any, record: Any) -> None:
        rows, size = columns.shape
        for block in numba.prange((size + lanes - 1) // lanes):
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


@cache
def smooth_kernel(method: str, coefficient_rows: int) -> Any:
    """Return the loop for pendulums without dry friction, lag and delay.

    Args:
        method: Integrator.
        coefficient_rows: How many numbers its coefficients are.
    """
    integrator = get_integrator(method)
    step = compile_tree(integrator.step, vector=True)
    acceleration = compile_tree(acceleration_with_friction, vector=True)
    load_plant = tuple_loader(_PLANT_ROWS, BLOCK)
    load_coefficients = tuple_loader(coefficient_rows, BLOCK)

    @numba.njit(fastmath={"contract"}, error_model="numpy")
    def run_block(
        w: Any, keys: Any, target: float, h: float, steps: int, hold: int, substeps: int, record: Any
    ) -> None:
        for k in range(steps):
            if k % hold == 0:
                index = np.uint64(k // hold)
                for j in range(BLOCK):
                    w[_NOISE + j] = w[_AMPLITUDE + j] * _unit_interval(_scramble(keys[j], index))
            for j in range(BLOCK):
                deviation = _wrap(w[_X + j] - target)
                v = w[_V + j]
                control = -(w[_GAIN_1 + j] * deviation + w[_GAIN_2 + j] * v)
                w[_MAX + j] = max(w[_MAX + j], abs(control))
                w[_MAX_X + j] = max(w[_MAX_X + j], abs(deviation))
                w[_SUM_X + j] += deviation
                w[_SUM_XX + j] += deviation * deviation
                w[_SUM_V + j] += v
                w[_SUM_VV + j] += v * v
                limit = w[_LIMIT + j]
                w[_TORQUE + j] = min(limit, max(-limit, control + w[_NOISE + j]))
            for j in range(record.shape[2] if record.shape[0] > 0 else 0):
                record[k, 0, j] = w[_X + j]
                record[k, 1, j] = w[_V + j]
                record[k, 2, j] = w[_TORQUE + j]
            for _ in range(substeps):
                for j in range(BLOCK):
                    torque = w[_TORQUE + j]
                    w[_X + j], w[_V + j] = step(
                        acceleration,
                        w[_X + j],
                        w[_V + j],
                        torque,
                        torque,
                        torque,
                        0.0,
                        h,
                        load_coefficients(w, _COEFFICIENTS + j),
                        load_plant(w, _PLANT + j),
                    )

    return keep_kernel(block_loop(run_block, BLOCK), "smooth_kernel", integrator.step, coefficient_rows)


@cache
def coefficients_kernel(method: str) -> Any:
    """Return the loop that fills ``out``, shape (coefficients, B), for damping rates of shape (B,) and one step."""
    integrator = get_integrator(method)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)

    @numba.njit(parallel=True, error_model="numpy")
    def run(rates: Any, h: float, out: Any) -> None:
        for j in numba.prange(rates.size):
            for row, value in enumerate(coefficients_of(rates[j], h)):
                out[row, j] = value

    return keep_kernel(run, "coefficients_kernel", integrator.coefficients)


@cache
def general_kernel(method: str) -> Any:
    """Return the loop for pendulums with dry friction, actuator lag or transport delay, one after another.

    Args:
        method: Integrator.
        coefficient_rows: How many numbers its coefficients are.
    """
    integrator = get_integrator(method)
    step = compile_tree(integrator.step, inline=True)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)
    acceleration = compile_tree(acceleration_with_friction, inline=True)
    advance = compile_tree(advance_dry, inline=True)
    lagged = compile_tree(actuator_torque, inline=True)
    has_dry_friction = compile_tree(is_dry, inline=True)
    load_plant = tuple_loader(_PLANT_ROWS, 1)

    @numba.njit(fastmath={"contract"}, error_model="numpy")
    def run_one(
        w: Any,
        delay: float,
        key: Any,
        target: float,
        dt: float,
        steps: int,
        hold: int,
        substeps: int,
        record: Any,
    ) -> None:
        plant = load_plant(w, _PLANT // BLOCK)
        rate = plant[1] / plant[0]
        dry = has_dry_friction(plant)
        lag = plant[LAG]
        periods = delay / dt
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
        x, v, torque, disturbance = w[0], w[1], 0.0, 0.0
        for k in range(steps):
            if k % hold == 0:
                disturbance = w[_AMPLITUDE // BLOCK] * _unit_interval(_scramble(key, np.uint64(k // hold)))
            deviation = _wrap(x - target)
            control = -(w[_GAIN_1 // BLOCK] * deviation + w[_GAIN_2 // BLOCK] * v)
            w[_MAX // BLOCK] = max(w[_MAX // BLOCK], abs(control))
            w[_MAX_X // BLOCK] = max(w[_MAX_X // BLOCK], abs(deviation))
            w[_SUM_X // BLOCK] += deviation
            w[_SUM_XX // BLOCK] += deviation * deviation
            w[_SUM_V // BLOCK] += v
            w[_SUM_VV // BLOCK] += v * v
            limit = w[_LIMIT // BLOCK]
            wanted = min(limit, max(-limit, control + disturbance))
            if record.shape[0] > 0:
                record[k, 0], record[k, 1], record[k, 2] = x, v, wanted
            for index in range(whole + 1):
                line[index] = line[index + 1]
            line[whole + 1] = wanted
            for part in range(2):
                command = line[part]
                h = lengths[part]
                c = c_0 if part == 0 else c_1
                for _ in range(counts[part]):
                    if dry:
                        x, v = advance(step, coefficients_of, acceleration, x, v, torque, command, 0.0, h, c, plant)
                        torque = lagged(torque, command, h, lag)
                    else:
                        torque_0 = torque if lag > 0.0 else command
                        torque_mid = lagged(torque, command, 0.5 * h, lag)
                        torque = lagged(torque, command, h, lag)
                        x, v = step(acceleration, x, v, torque_0, torque_mid, torque, 0.0, h, c, plant)
        w[0], w[1] = x, v

    @numba.njit(parallel=True)
    def run(
        columns: Any,
        delays: Any,
        keys: Any,
        target: float,
        dt: float,
        steps: int,
        hold: int,
        substeps: int,
        record: Any,
    ) -> None:
        rows, size = columns.shape
        for j in numba.prange(size):
            w = np.empty(rows)
            for row in range(rows):
                w[row] = columns[row, j]
            run_one(w, delays[j], keys[j], target, dt, steps, hold, substeps, record[:, :, j])
            for row in range(rows):
                columns[row, j] = w[row]

    return keep_kernel(run, "general_kernel", integrator.step, integrator.coefficients)
