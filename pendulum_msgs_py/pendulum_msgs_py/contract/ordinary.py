"""The supervisor's state in nominal periods as numbers, for the compiled loop.

A period is nominal if one driven joint is armed for effort, without change of commander, trajectory, handover, push or
conflict. Texts and everything else stay in Python.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.commands import CommandGate
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.contract.supervisor import Input, Mode, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand

__all__ = ["GATE", "ORDINARY", "lend", "take_back"]

GATE = np.dtype(
    [
        ("timeout_ns", "i8"),
        ("newest_ns", "i8"),
        ("heard_ns", "i8"),
        ("effort", "f8"),
        ("expired", "i8"),
        ("accepted", "i8"),
    ],
    align=True,
)
"""State of a gate."""

ORDINARY = np.dtype(
    [
        ("command", GATE),
        ("disturbance", GATE),
        ("limit", "f8"),
        ("slew", "f8"),
        ("feedback_timeout", "f8"),
        ("lowest", "f8"),
        ("highest", "f8"),
        ("fastest", "f8"),
        ("commanded_ns", "i8"),
        ("decided_ns", "i8"),
        ("last_effort", "f8"),
        ("saturated", "i8"),
        ("decisions", "i8"),
    ],
    align=True,
)
"""State that a nominal decision reads and changes."""


def lend(supervisor: PlantSupervisor, record: Any) -> bool:
    """Write a supervisor's state into a record of :data:`ORDINARY`; return whether its next period may be nominal.

    The supervisor must not be used until :func:`take_back`.
    """
    commands, disturbances = supervisor.gates[Input.EFFORT_COMMAND], supervisor.gates[Input.DISTURBANCE]
    ordinary = (
        supervisor.mode is Mode.EFFORT
        and len(supervisor.coordinates.joints) == len(supervisor.limits.effort) == 1
        and supervisor._handover is None
        and not supervisor.commander_conflict
        # The switch's timeout is checked at each decision, which compiled code does not do.
        and math.isinf(supervisor.limits.enable_timeout)
        and commands._newest is not None
        and supervisor._commanding == commands._newest.source
        and supervisor._last_decision_ns is not None
        and not _may_act(supervisor.gates[Input.PUSH])
        and supervisor.reason == supervisor.commanded_by(commands._newest.source)
    )
    if not ordinary:
        return False
    limits = supervisor.limits
    _lend_gate(commands, record.command)
    _lend_gate(disturbances, record.disturbance)
    (record.limit,) = limits.effort
    record.slew, record.fastest, record.feedback_timeout = limits.slew, limits.velocity, limits.feedback_timeout
    (record.lowest,), (record.highest,) = limits.position_min, limits.position_max
    record.commanded_ns = supervisor._commanded_ns
    record.decided_ns = supervisor._last_decision_ns
    (record.last_effort,) = supervisor._last_effort
    record.saturated = record.decisions = 0
    return True


def take_back(supervisor: PlantSupervisor, record: Any) -> None:
    """Write the record back into the supervisor."""
    _take_gate_back(supervisor.gates[Input.EFFORT_COMMAND], record.command)
    _take_gate_back(supervisor.gates[Input.DISTURBANCE], record.disturbance)
    if not record.decisions:
        return
    supervisor.saturated_periods += int(record.saturated)
    supervisor._commanded_ns = int(record.commanded_ns)
    supervisor._last_time_ns = supervisor._last_decision_ns = int(record.decided_ns)
    supervisor._last_effort = (float(record.last_effort),)
    supervisor.report_applied(supervisor._last_effort)


def _may_act(gate: CommandGate) -> bool:
    return gate._newest is not None and not gate._expired


def _lend_gate(gate: CommandGate, record: Any) -> None:
    newest = gate._newest
    record.timeout_ns = gate.timeout_ns
    record.newest_ns = NEVER if newest is None else newest.stamp_ns
    record.heard_ns = gate._heard_ns
    record.effort = math.nan if newest is None else newest.effort[0]
    record.expired = gate._expired
    record.accepted = 0


def _take_gate_back(gate: CommandGate, record: Any) -> None:
    # It may have expired without a new one.
    gate._expired = bool(record.expired)
    if not record.accepted:
        return
    newest = gate._newest
    assert newest is not None, "a loop took a command where no layout was known"
    gate._newest = JointCommand(int(record.newest_ns), (float(record.effort),), newest.source, newest.joints)
    gate._heard_ns = int(record.heard_ns)
    gate.accepted += int(record.accepted)
