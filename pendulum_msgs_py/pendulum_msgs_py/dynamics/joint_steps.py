"""Steps of a mechanism with true stiction and end stops: pure functions on tuples, interpreted or compiled by numba.

Between events each joint slides one way, is held, or is free: the equations are smooth and Runge-Kutta keeps order
four. Zero crossings of velocity and end stops are located inside the step. A joint at rest is held, exactly, while the
effort that holds it is within its dry friction; the others move as if it were welded. A stop is a plastic impact, whose
impulse reaches the other joints through the mass matrix. For one joint: :mod:`pendulum_sim.stepping.dry_friction`.

Sources: D. Karnopp, "Computer simulation of stick-slip friction in mechanical dynamic systems", 1985, events located;
F. Pfeiffer and C. Glocker, Multibody Dynamics with Unilateral Contacts, 1996, section 8 (impacts).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pendulum_msgs_py.dynamics import friction_magnitude
from pendulum_msgs_py.dynamics.runge_kutta import along_functions
from pendulum_msgs_py.dynamics.steps import actuator_torque, narrowed
from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "COULOMB",
    "FAR",
    "JOINT_ROWS",
    "LAG",
    "LOWER",
    "STATIC",
    "STRIBECK",
    "UPPER",
    "JointTable",
    "advance_joints",
    "joint_functions",
    "joint_modes",
]

JOINT_ROWS = ("coulomb_friction", "static_friction", "stribeck_velocity", "lower_stop", "upper_stop", "time_constant")
"""Rows of a ``JointTable``, by the names of plant files."""
COULOMB, STATIC, STRIBECK, LOWER, UPPER, LAG = range(len(JOINT_ROWS))
JointTable = tuple[tuple[float, ...], ...]
"""Rows of one number per joint, in the order of ``JOINT_ROWS``."""

_MAX_EVENTS = 12
_MAX_ROOT_STEPS = 60
FAR = 1e300
"""End stop out of reach [rad or m]."""


def put_1(_values: Any, _index: int, value: Any) -> Any:
    """Return the values of one joint with one replaced."""
    return (value,)


def put_2(values: Any, index: int, value: Any) -> Any:
    """Return the values of two joints with one replaced."""
    return (value, values[1]) if index == 0 else (values[0], value)


def put_3(values: Any, index: int, value: Any) -> Any:
    """Return the values of three joints with one replaced."""
    if index == 0:
        return (value, values[1], values[2])
    return (values[0], value, values[2]) if index == 1 else (values[0], values[1], value)


def lag_1(torque: Any, command: Any, elapsed: float, constants: Any) -> Any:
    """Return the effort of one lagging actuator after some time."""
    return (actuator_torque(torque[0], command[0], elapsed, constants[0]),)


def lag_2(torque: Any, command: Any, elapsed: float, constants: Any) -> Any:
    """Return the efforts of two lagging actuators after some time."""
    return (
        actuator_torque(torque[0], command[0], elapsed, constants[0]),
        actuator_torque(torque[1], command[1], elapsed, constants[1]),
    )


def lag_3(torque: Any, command: Any, elapsed: float, constants: Any) -> Any:
    """Return the efforts of three lagging actuators after some time."""
    return (
        actuator_torque(torque[0], command[0], elapsed, constants[0]),
        actuator_torque(torque[1], command[1], elapsed, constants[1]),
        actuator_torque(torque[2], command[2], elapsed, constants[2]),
    )


_PUT = {1: put_1, 2: put_2, 3: put_3}
_LAG_FUNCTIONS = {1: lag_1, 2: lag_2, 3: lag_3}


def joint_functions(count: int) -> tuple[Callable[..., Any], ...]:
    """Return (along, put, lag) for 1 to 3 joints, written out for the compiler; else raise a ParameterError."""
    if count not in _PUT:
        raise ParameterError(f"a mechanism of {count} joints is not stepped yet; expected 1 to 3")
    return along_functions(count), _PUT[count], _LAG_FUNCTIONS[count]


def _loaded(put: Any, v: Any, torque: Any, direction: Any, table: Any) -> Any:
    for i in range(len(torque)):
        if direction[i] != 0.0:
            friction = friction_magnitude(v[i], table[COULOMB][i], table[STATIC][i], table[STRIBECK][i])
            torque = put(torque, i, torque[i] - direction[i] * friction)
    return torque


def _constrained(
    forward: Any, along: Any, put: Any, q: Any, v: Any, torque: Any, direction: Any, held: Any, p: Any, table: Any
) -> Any:
    """Return q'' with friction against ``direction``, exactly 0 at held joints."""
    tau = _loaded(put, v, torque, direction, table)
    a = forward(q, v, tau, p)
    count = 0
    first = last = 0
    for i in range(len(a)):
        if held[i] > 0.0:
            first = last if count else i
            count += 1
            last = i
    if count == len(a):
        return along(a, -1.0, a)
    if count > 0:
        # The acceleration is affine in the effort: a second point gives the holding effort.
        more = forward(q, v, put(tau, last, tau[last] + 1.0), p)
        column = along(more, -1.0, a)
        other = along(forward(q, v, put(tau, first, tau[first] + 1.0), p), -1.0, a) if count == 2 else column
        a = put(along(a, -a[last] / column[last], column), last, 0.0)
        if count == 2:
            other = along(other, -other[last] / column[last], column)
            a = put(put(along(a, -a[first] / other[first], other), first, 0.0), last, 0.0)
    return a


def _step(
    forward: Any, along: Any, put: Any, lag: Any, q: Any, v: Any, torque: Any, command: Any, push: Any, begin: float,
    h: float, direction: Any, held: Any, p: Any, table: Any,
) -> Any:  # fmt: skip
    """Return (q, v) after h in one mode; ``begin`` is the time since the effort was ``torque``."""
    half = 0.5 * h
    constants = table[LAG]
    t_0 = along(lag(torque, command, begin, constants), 1.0, push)
    t_m = along(lag(torque, command, begin + half, constants), 1.0, push)
    t_1 = along(lag(torque, command, begin + h, constants), 1.0, push)
    a_1 = _constrained(forward, along, put, q, v, t_0, direction, held, p, table)
    v_2 = along(v, half, a_1)
    a_2 = _constrained(forward, along, put, along(q, half, v), v_2, t_m, direction, held, p, table)
    v_3 = along(v, half, a_2)
    a_3 = _constrained(forward, along, put, along(q, half, v_2), v_3, t_m, direction, held, p, table)
    v_4 = along(v, h, a_3)
    a_4 = _constrained(forward, along, put, along(q, h, v_3), v_4, t_1, direction, held, p, table)
    sixth, third = h / 6.0, h / 3.0
    return (
        along(along(along(along(q, sixth, v), third, v_2), third, v_3), sixth, v_4),
        along(along(along(along(v, sixth, a_1), third, a_2), third, a_3), sixth, a_4),
    )


def joint_modes(forward: Any, along: Any, put: Any, q: Any, v: Any, torque: Any, p: Any, table: Any) -> Any:
    """Return (direction, held) of each joint: the direction of sliding, and 1 if held at rest."""
    n = len(q)
    direction = along(v, -1.0, v)
    held = direction
    rest = 0
    for i in range(n):
        if v[i] != 0.0:
            if table[STATIC][i] > 0.0:
                direction = put(direction, i, 1.0 if v[i] > 0.0 else -1.0)
        elif table[STATIC][i] > 0.0 or q[i] <= table[LOWER][i] or q[i] >= table[UPPER][i]:
            held = put(held, i, 1.0)
            rest += 1
    # Release the joints that cannot be held, one at a time, the largest excess over friction first.
    for _ in range(n):
        if rest == 0:
            break
        worst, excess, way = -1, 0.0, 0.0
        for i in range(n):
            if held[i] > 0.0:
                # The effort that holds joint i while the other held joints stay.
                free = put(held, i, 0.0)
                loose = _constrained(forward, along, put, q, v, torque, direction, free, p, table)
                pulled = _constrained(
                    forward, along, put, q, v, put(torque, i, torque[i] + 1.0), direction, free, p, table
                )
                needed = loose[i] / (pulled[i] - loose[i])
                limit = table[STATIC][i]
                over = abs(needed) - limit
                if (needed > 0.0 and q[i] >= table[UPPER][i]) or (needed < 0.0 and q[i] <= table[LOWER][i]):
                    over = -1.0
                if over > excess:
                    worst, excess, way = i, over, 1.0 if needed > 0.0 else -1.0
        if worst < 0:
            break
        held = put(held, worst, 0.0)
        rest -= 1
        if table[STATIC][worst] > 0.0:
            direction = put(direction, worst, way)
    return direction, held


def _passed(kind: int, i: int, q: Any, v: Any, direction: Any, table: Any) -> float:
    """Return an event function, > 0 before the event: 0 velocity crosses zero, 1 lower stop, 2 upper stop."""
    if kind == 0:
        return float(v[i] * direction[i])
    if kind == 1:
        return float(q[i] - table[LOWER][i])
    return float(table[UPPER][i] - q[i])


def advance_joints(
    forward: Any, along: Any, put: Any, lag: Any, q: Any, v: Any, torque: Any, command: Any, push: Any, h: float,
    p: Any, table: Any,
) -> Any:  # fmt: skip
    """Return (q, v) after h [s], with as many events as occur.

    ``along``, ``put`` and ``lag`` are from :func:`joint_functions`, ``table`` from
    :func:`pendulum_msgs_py.plants.plant_parameters.pack_joints`. Efforts [N m or N]: of the actuators at the start, 0
    at passive joints; commanded; and on the joints themselves. ``forward`` is the mechanism's equation with parameters
    ``p``.
    """
    left = h
    n = len(q)
    for _ in range(_MAX_EVENTS):
        begin = h - left
        now = along(lag(torque, command, begin, table[LAG]), 1.0, push)
        direction, held = joint_modes(forward, along, put, q, v, now, p, table)
        q_1, v_1 = _step(forward, along, put, lag, q, v, torque, command, push, begin, left, direction, held, p, table)
        for i in range(n):
            if v[i] == 0.0 and direction[i] != 0.0 and v_1[i] * direction[i] < 0.0:
                # It broke away and came back within the step: hold it.
                held = put(held, i, 1.0)
                direction = put(direction, i, 0.0)
                q_1, v_1 = _step(
                    forward, along, put, lag, q, v, torque, command, push, begin, left, direction, held, p, table
                )
        first, joint, which = left, -1, 0
        for i in range(n):
            for kind in range(3):
                if held[i] > 0.0 or (kind == 0 and direction[i] == 0.0):
                    continue
                if _passed(kind, i, q_1, v_1, direction, table) >= 0.0:
                    continue
                low, g_low = 0.0, _passed(kind, i, q, v, direction, table)
                high, g_high = left, _passed(kind, i, q_1, v_1, direction, table)
                root, side = 0.0 if g_low <= 0.0 else left, 0
                for _ in range(_MAX_ROOT_STEPS):
                    if g_low <= 0.0 or high - low <= 1e-15 * h:
                        break
                    root = (low * g_high - high * g_low) / (g_high - g_low)
                    if not low < root < high:
                        break
                    q_r, v_r = _step(
                        forward, along, put, lag, q, v, torque, command, push, begin, root, direction, held, p, table
                    )
                    g = _passed(kind, i, q_r, v_r, direction, table)
                    if abs(g) <= 1e-15:
                        break
                    low, g_low, high, g_high, side = narrowed(low, g_low, high, g_high, side, root, g, g > 0.0)
                if joint < 0 or root < first:
                    first, joint, which = root, i, kind
        if joint < 0:
            return q_1, v_1
        q, v = _step(forward, along, put, lag, q, v, torque, command, push, begin, first, direction, held, p, table)
        # A joint that reversed within the step may have started at a stop.
        q = put(q, joint, min(max(q[joint], table[LOWER][joint]), table[UPPER][joint]))
        if which > 0:
            q = put(q, joint, table[LOWER][joint] if which == 1 else table[UPPER][joint])
            # A plastic impact: its impulse moves the other joints too. Dry friction, a finite effort, cannot resist an
            # impulse; an end stop can.
            for i in range(n):
                if table[LOWER][i] < q[i] < table[UPPER][i]:
                    held = put(held, i, 0.0)
            a = _constrained(forward, along, put, q, v, now, direction, held, p, table)
            more = _constrained(forward, along, put, q, v, put(now, joint, now[joint] + 1.0), direction, held, p, table)
            column = along(more, -1.0, a)
            v = along(v, -v[joint] / column[joint], column)
        v = put(v, joint, 0.0)
        left -= first
        if left <= 1e-12 * h:
            return q, v
    return q, v
