"""Nominal decisions of a plant of one joint: the supervisor's rules on the numbers of a record.

Plain functions, compiled by loops and run unchanged by tests. Each checks everything before it changes anything and
returns False for any other case, which Python decides.
"""

from __future__ import annotations

import math
from typing import Any

from pendulum_msgs_py.contract.rules import (
    ACCEPTED,
    NEVER,
    age_of,
    has_expired,
    has_lapsed,
    is_ahead,
    is_inside,
    is_last,
    judge_stamp,
    rise_within,
    within,
)
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["accept", "decide"]


def accept(source: Any, gate: Any, now_ns: int) -> bool:
    """Accept a message's torque (``INPUT``) into a gate (``GATE``) at a time [ns]; return whether it passed."""
    if not math.isfinite(source.value[0]) or gate.newest_ns == NEVER:
        return False
    verdict = judge_stamp(source.stamp_ns, now_ns, gate.timeout_ns, gate.newest_ns, gate.heard_ns, False)
    if verdict != ACCEPTED:
        return False
    gate.expired = source.value[0] == 0.0 and is_last(source.stamp_ns, gate.newest_ns)
    gate.newest_ns = source.stamp_ns
    gate.heard_ns = now_ns
    gate.effort = source.value[0]
    gate.accepted += 1
    return True


def decide(s: Any, now_ns: int) -> bool:
    """Decide as the supervisor does, on a plant's record at a time [ns]; return False, unchanged, if not nominal."""
    r = s.rules
    age = age_of(s.sample_ns, now_ns)
    if age < -r.feedback_timeout or age > r.feedback_timeout:
        return False
    if not (math.isfinite(s.position) and math.isfinite(s.velocity)) or math.isinf(s.effort):
        return False
    if not is_inside(r.lowest, s.position, r.highest, s.velocity, r.fastest):
        return False
    command, disturbance = r.command, r.disturbance
    if command.expired or has_expired(command.newest_ns, command.heard_ns, now_ns, command.timeout_ns):
        return False
    if is_ahead(command.newest_ns, now_ns) or has_lapsed(r.commanded_ns, now_ns):
        return False
    beside = 0.0
    if disturbance.newest_ns != NEVER:
        if has_expired(disturbance.newest_ns, disturbance.heard_ns, now_ns, disturbance.timeout_ns):
            disturbance.expired = 1
        if not disturbance.expired and not is_ahead(disturbance.newest_ns, now_ns):
            beside = disturbance.effort
    total = command.effort + beside
    wanted = within(total, r.limit)
    r.saturated += wanted != total
    if not math.isinf(r.slew):
        wanted = rise_within(r.last_effort, wanted, r.slew * max(0, now_ns - r.decided_ns) / NANOSECONDS)
    r.last_effort = wanted
    r.decided_ns = r.commanded_ns = now_ns
    r.decisions += 1
    return True
