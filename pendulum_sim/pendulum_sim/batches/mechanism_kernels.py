"""Compiled loops of the batch engine for plants of several joints, blocks side by side, each block on one thread.

As in :mod:`pendulum_sim.batches.batch_kernels` the loop over plants is the inner one and has no branches where nothing
sticks, so that it becomes vector code. Equations and steps are those of
:class:`pendulum_sim.stepping.mechanism_plant.MechanismPlant`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.dynamics.joint_steps import JOINT_ROWS, LAG, advance_joints, joint_functions
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.programs.kept_kernels import keep_kernel
from pendulum_sim.batches import vector_math
from pendulum_sim.batches.batch_kernels import BLOCK, block_loop
from pendulum_sim.batches.compiling import WITHIN, compile_tree, tuple_loader

__all__ = ["Layout", "general_joints_kernel", "smooth_joints_kernel"]

_scramble = compile_tree(noise.scramble)
_unit_interval = compile_tree(noise.unit_interval)
_wrap = compile_tree(vector_math.wrap)


@dataclass(frozen=True)
class Layout:
    """First row of each quantity in a block's array, for n joints of which m are driven.

    Attributes:
        name: The mechanism.
        driven: Indices of the driven joints.
    """

    name: str
    driven: tuple[int, ...]

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(MECHANISMS[self.name].joints)

    @property
    def starts(self) -> dict[str, int]:
        """First row by quantity; ``end`` is the number of rows."""
        n, m = self.joints, len(self.driven)
        sizes = {
            "q": n, "v": n, "effort": n, "deviation": n, "noise": m, "amplitude": m, "limit": m, "gain": m * 2 * n,
            "max_effort": m, "max": n, "sum": n, "square": n, "p": len(MECHANISMS[self.name].parameter_names),
            "table": len(JOINT_ROWS) * n,
        }  # fmt: skip
        starts, row = {}, 0
        for key, size in sizes.items():
            starts[key] = row
            row += size
        return {**starts, "end": row}


def _store_1(w: Any, start: int, _stride: int, values: Any) -> None:
    w[start] = values[0]


def _store_2(w: Any, start: int, stride: int, values: Any) -> None:
    w[start] = values[0]
    w[start + stride] = values[1]


_STORES = {1: _store_1, 2: _store_2}


def _control(layout: Layout, lanes: int) -> Any:
    """Return the compiled loop that measures, counts, and sets the efforts of a block for one step."""
    n, m = layout.joints, len(layout.driven)
    s = layout.starts
    o_q, o_v, o_effort, o_deviation = (s[key] * lanes for key in ("q", "v", "effort", "deviation"))
    o_noise, o_amplitude, o_limit, o_gain = (s[key] * lanes for key in ("noise", "amplitude", "limit", "gain"))
    o_max_effort, o_max, o_sum, o_square = (s[key] * lanes for key in ("max_effort", "max", "sum", "square"))
    turns = tuple(joint.turns for joint in MECHANISMS[layout.name].joints)
    driven = layout.driven

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def control(w: Any, keys: Any, goal: Any, k: int, hold: int, record: Any) -> None:
        for i in range(n):
            for j in range(lanes):
                deviation = w[o_q + i * lanes + j] - goal[i]
                if turns[i]:
                    deviation = _wrap(deviation)
                w[o_deviation + i * lanes + j] = deviation
                w[o_max + i * lanes + j] = max(w[o_max + i * lanes + j], abs(deviation))
                w[o_sum + i * lanes + j] += deviation
                w[o_square + i * lanes + j] += deviation * deviation
        for a in range(m):
            if k % hold == 0:
                index = np.uint64((k // hold) * m + a)
                for j in range(lanes):
                    unit = _unit_interval(_scramble(keys[j], index))
                    w[o_noise + a * lanes + j] = w[o_amplitude + a * lanes + j] * unit
            for j in range(lanes):
                effort = 0.0
                for i in range(n):
                    effort -= w[o_gain + (a * 2 * n + i) * lanes + j] * w[o_deviation + i * lanes + j]
                    effort -= w[o_gain + (a * 2 * n + n + i) * lanes + j] * w[o_v + i * lanes + j]
                w[o_max_effort + a * lanes + j] = max(w[o_max_effort + a * lanes + j], abs(effort))
                limit = w[o_limit + a * lanes + j]
                wanted = effort + w[o_noise + a * lanes + j]
                w[o_effort + driven[a] * lanes + j] = min(limit, max(-limit, wanted))
        if record.shape[0] > 0:
            for row in range(3 * n):
                for j in range(record.shape[2]):
                    record[k, row, j] = w[row * lanes + j]

    return control


@cache
def smooth_joints_kernel(layout: Layout) -> Any:
    """Return the loop for plants without dry friction, stops, lag and delay; ``more`` is the number of sub-steps."""
    n = layout.joints
    s = layout.starts
    o_q, o_v, o_effort, o_p = (s[key] * BLOCK for key in ("q", "v", "effort", "p"))
    mechanism = MECHANISMS[layout.name]
    forward = compile_tree(mechanism.forward, vector=True)
    along = compile_tree(along_functions(n), vector=True)
    step = compile_tree(rk4_joints, vector=True)
    load = tuple_loader(n, BLOCK)
    load_p = tuple_loader(len(mechanism.parameter_names), BLOCK)
    store = numba.njit(_STORES[n], forceinline=True, **WITHIN)
    control = _control(layout, BLOCK)

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def run_block(w: Any, keys: Any, goal: Any, dt: float, steps: int, hold: int, substeps: int, record: Any) -> None:
        h = dt / substeps
        for k in range(steps):
            control(w, keys, goal, k, hold, record)
            for _ in range(substeps):
                for j in range(BLOCK):
                    effort = load(w, o_effort + j)
                    q, v = step(
                        forward,
                        along,
                        load(w, o_q + j),
                        load(w, o_v + j),
                        effort,
                        effort,
                        effort,
                        h,
                        load_p(w, o_p + j),
                    )
                    store(w, o_q + j, BLOCK, q)
                    store(w, o_v + j, BLOCK, v)

    return keep_kernel(block_loop(run_block, BLOCK), "smooth_joints_kernel", mechanism.forward, layout)


@cache
def general_joints_kernel(layout: Layout) -> Any:
    """Return the loop for plants of any kind, one after another; ``more`` is (sub-steps, delay [s])."""
    n = layout.joints
    s = layout.starts
    o_q, o_v, o_effort, o_p, o_table = (s[key] for key in ("q", "v", "effort", "p", "table"))
    mechanism = MECHANISMS[layout.name]
    forward = compile_tree(mechanism.forward, inline=True)
    along, put, lag = (compile_tree(function, inline=True) for function in joint_functions(n))
    advance = compile_tree(advance_joints, inline=True)
    load = tuple_loader(n, 1)
    load_p = tuple_loader(len(mechanism.parameter_names), 1)
    store = numba.njit(_STORES[n], **WITHIN)
    control = _control(layout, 1)

    @numba.njit(fastmath={"contract"}, error_model="numpy", **WITHIN)
    def run_block(w: Any, keys: Any, goal: Any, dt: float, steps: int, hold: int, more: Any, record: Any) -> None:
        substeps = int(more[0])
        periods = more[1] / dt
        if abs(periods - np.rint(periods)) < 1e-9:
            periods = np.rint(periods)
        whole = int(np.floor(periods))
        p = load_p(w, o_p)
        table = (
            load(w, o_table),
            load(w, o_table + n),
            load(w, o_table + 2 * n),
            load(w, o_table + 3 * n),
            load(w, o_table + 4 * n),
            load(w, o_table + 5 * n),
        )
        line = np.zeros((whole + 2, n))
        still = along(load(w, o_v), -1.0, load(w, o_v))
        torque = still
        for k in range(steps):
            control(w, keys, goal, k, hold, record)
            for index in range(whole + 1):
                for i in range(n):
                    line[index, i] = line[index + 1, i]
            for i in range(n):
                line[whole + 1, i] = w[o_effort + i]
            q, v = load(w, o_q), load(w, o_v)
            for part in range(2):
                share = periods - whole if part == 0 else 1.0 - (periods - whole)
                if share <= 0.0:
                    continue
                count = max(1, int(np.ceil(share * substeps - 1e-9)))
                h = share * dt / count
                command = load(line[part], 0)
                for _ in range(count):
                    q, v = advance(forward, along, put, lag, q, v, torque, command, still, h, p, table)
                    torque = lag(torque, command, h, table[LAG])
            store(w, o_q, 1, q)
            store(w, o_v, 1, v)

    return keep_kernel(block_loop(run_block, 1), "general_joints_kernel", mechanism.forward, layout)
