"""Compiled motion of a mechanism over many windows, for several sets of parameters at a time.

The steps are the plant's own (:func:`pendulum_msgs_py.dynamics.joint_steps.advance_joints`): true stiction, end stops,
Runge-Kutta of order four between events. Within a step the input is a straight line with the input's own mean.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numba

from pendulum_bags.arrays import Array
from pendulum_msgs_py.dynamics.joint_steps import COULOMB, advance_joints, joint_functions, joint_modes
from pendulum_msgs_py.loops.trees import WITHIN, compile_tree, tuple_loader
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_msgs_py.programs.kernel_cache import keep_kernel

__all__ = ["lagged", "motion_kernel"]


_BREAKAWAY = 2e-5
"""Resolution of the instant at which a resting joint breaks away [s]."""


@numba.njit(cache=True)
def lagged(effort: Array, rise: Array, steps: Array, lag: float) -> Array:
    """Return a first-order lag > 0 [s] of an input of straight pieces at each stamp, at rest before, shape (s, n).

    The pieces have starts, shape (s, n), slopes (s - 1, n) and lengths (s - 1,) [s].
    """
    found = effort.copy()
    for k in range(steps.size):
        decay = math.exp(-steps[k] / lag)
        for i in range(effort.shape[1]):
            settled = rise[k, i] * lag
            end = effort[k, i] + rise[k, i] * steps[k]
            found[k + 1, i] = end - settled + (found[k, i] - effort[k, i] + settled) * decay
    return found


@cache
def motion_kernel(name: str) -> Any:
    """Return the compiled motion of a mechanism.

    It is called as (p, table, push, shift, drive, which, h, states, path), for c sets of w windows of l instants and n
    joints: parameters (c, .), rows of joints (c, 6, n), efforts on the joints (c, n), positions of the encoders' zeros
    (c, n), inputs at the start of each step and their slopes (d, w, l - 1, 2 n) and which of them each set has (c,),
    steps (w, l - 1) [s], starts (c, w, 2 n) and the motion that it writes, (c, w, l, 2 n).
    """
    mechanism = MECHANISMS[name]
    n, size = len(mechanism.joints), len(mechanism.parameter_names)
    forward = compile_tree(mechanism.forward, inline=True)
    along, put, _ = (compile_tree(function, inline=True) for function in joint_functions(n))
    advance, modes = compile_tree(advance_joints, inline=True), compile_tree(joint_modes, inline=True)
    load, load_p = tuple_loader(n, 1), tuple_loader(size, 1)

    @numba.njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
    def ramp(torque: Any, rise: Any, elapsed: float, _constants: Any) -> Any:
        """Return a rising effort after some time, in the place of an actuator's lag."""
        return along(torque, elapsed, rise)

    @numba.njit(error_model="numpy", fastmath={"contract"}, **WITHIN)
    def breaks(q: Any, v: Any, effort: Any, p: Any, table: Any) -> bool:
        """Return whether a joint at rest is not held by its friction."""
        rest = 0.0
        for i in range(n):
            rest += v[i] == 0.0 and table[COULOMB][i] > 0.0
        if rest > 0.0:
            _, held = modes(forward, along, put, q, v, effort, p, table)
            for i in range(n):
                # What is held without friction is held by an end stop.
                rest -= held[i] > 0.0 and table[COULOMB][i] > 0.0
        return rest > 0.0

    @numba.njit(error_model="numpy", fastmath={"contract"}, **WITHIN)
    def hides(q: Any, v: Any, q_1: Any, v_1: Any, part: float, effort: Any, effort_1: Any, p: Any, table: Any) -> bool:
        """Return whether a joint broke away within a step, or rested, so that the step does not resolve when."""
        before, reversals, started = v_1, 0.0, 0.0
        for i in range(n):
            if v[i] == 0.0:
                started += v_1[i] != 0.0 and table[COULOMB][i] > 0.0
            elif table[COULOMB][i] > 0.0:
                way, mean = 1.0 if v[i] > 0.0 else -1.0, (q_1[i] - q[i]) / part
                if v_1[i] == 0.0:
                    before = put(before, i, v[i])
                elif v_1[i] * way < 0.0:
                    reversals += 1.0
                else:
                    # Sliding one way at both ends, it may have rested between: its velocity as a parabola.
                    slope = way * (6.0 * mean - 4.0 * v[i] - 2.0 * v_1[i])
                    bend = way * (3.0 * (v[i] + v_1[i]) - 6.0 * mean)
                    reversals += -2.0 * bend < slope < 0.0 and slope * slope > 4.0 * bend * way * v[i]
        if reversals > 0.0 or breaks(q_1, v_1, effort_1, p, table):
            return True
        if before == v_1 and started == 0.0:
            return False
        loose = breaks(q, v, effort, p, table)
        # The friction of one that comes to rest drops another that it dragged along, or holds one that broke away.
        return (started > 0.0 and not loose) or (before != v_1 and (loose or breaks(q_1, before, effort_1, p, table)))

    @numba.njit(error_model="numpy", fastmath={"contract"})
    def run(p: Any, table: Any, push: Any, shift: Any, drive: Any, which: Any, h: Any, states: Any, path: Any) -> None:
        for c in range(p.shape[0]):
            own = load_p(p[c], 0)
            rows = (
                load(table[c, 0], 0),
                load(table[c, 1], 0),
                load(table[c, 2], 0),
                load(table[c, 3], 0),
                load(table[c, 4], 0),
                load(table[c, 5], 0),
            )
            pushed, zero = load(push[c], 0), load(shift[c], 0)
            for w in range(h.shape[0]):
                q, v = along(load(states[c, w], 0), -1.0, zero), load(states[c, w], n)
                for i in range(2 * n):
                    path[c, w, 0, i] = states[c, w, i]
                for k in range(h.shape[1]):
                    if h[w, k] > 0.0:
                        effort = drive[which[c], w, k]
                        rise = load(effort, n)
                        # A joint at rest breaks away at the start of a step only. Where one would do so within it,
                        # bisection finds when, and a new step starts there.
                        done, part, ahead = 0.0, h[w, k], False
                        while part > 0.0:
                            begun = along(load(effort, 0), done, rise)
                            q_1, v_1 = advance(forward, along, put, ramp, q, v, begun, rise, pushed, part, own, rows)
                            u, u_1 = along(begun, 1.0, pushed), along(along(begun, part, rise), 1.0, pushed)
                            if part > _BREAKAWAY and hides(q, v, q_1, v_1, part, u, u_1, own, rows):
                                part *= 0.5
                                ahead = True
                            else:
                                q, v = q_1, v_1
                                done += part
                                # What twice that step hid lies within as long a step again.
                                ahead = ahead and part > _BREAKAWAY
                                part = 0.5 * part if ahead else h[w, k] - done
                    for i in range(n):
                        path[c, w, k + 1, i] = q[i] + zero[i]
                        path[c, w, k + 1, n + i] = v[i]

    return keep_kernel(run, "motion_kernel", mechanism.forward)
