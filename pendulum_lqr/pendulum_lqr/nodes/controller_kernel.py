"""Compiled loop of a controller whose law is a function of numbers, imported by the compiler's process only."""

from __future__ import annotations

import importlib
import math
from typing import Any

from pendulum_lqr.controller_interface.sampling import goes_on
from pendulum_lqr.nodes.answer_rules import NEW, is_saturated, judge_state
from pendulum_lqr.nodes.compiled_controller import ANSWERING
from pendulum_msgs_py.contract.angles import deviation_from_upright
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.loops.answer_kernel import answer_loop, count_answer
from pendulum_msgs_py.loops.primitives import compiled, publish, steady_ns
from pendulum_msgs_py.loops.trees import compile_tree

__all__ = ["law_loop"]

_WHOLE = 2**53
"""From here on Python divides integers with more digits than a float has."""


def law_loop(law: str) -> Any:
    """Return the compiled loop of a controller by a law, ``module:function``."""
    module, _, function = law.partition(":")
    command = compile_tree(getattr(importlib.import_module(module), function), exact=True)
    judge = compile_tree(judge_state, exact=True)
    from_upright = compile_tree(deviation_from_upright, exact=True)
    saturated = compile_tree(is_saturated, exact=True)
    follows = compile_tree(goes_on, exact=True)

    @compiled
    def take_memory_back(own: Any) -> None:
        for index in range(own.remembered):
            own.memory[index] = own.before[index]

    @compiled
    def answer(s: Any, arrived_ns: Any) -> Any:
        own, state = s.own, s.state
        lent = own.lent
        stamp_ns, theta, velocity = state.stamp_ns, state.value[0], state.value[1]
        if not (math.isfinite(theta) and math.isfinite(velocity)):
            return False
        now_ns = stamp_ns if lent.simulated else arrived_ns + s.wall_ahead_ns
        if judge(stamp_ns, now_ns, lent.timeout_ns, lent.newest_ns) != NEW:
            return False
        interval_ns = stamp_ns - lent.watched_ns
        if not follows(interval_ns):
            return False
        if lent.interval_ns > 0 and interval_ns != lent.interval_ns:
            return False
        since_ns = stamp_ns - lent.start_ns
        if since_ns >= _WHOLE:
            return False
        for index in range(own.remembered):
            own.before[index] = own.memory[index]
        began_ns = steady_ns(s.time)
        effort = command(since_ns / NANOSECONDS, from_upright(theta), velocity, own.memory, own.numbers)
        ended_ns = steady_ns(s.time)
        if not math.isfinite(effort):
            take_memory_back(own)
            return False
        s.answer.value[0] = effort
        if not publish(s.answer, stamp_ns):
            take_memory_back(own)
            return False
        lent.newest_ns = lent.watched_ns = stamp_ns
        newest = own.newest
        newest.position, newest.velocity, newest.measured, newest.effort = theta, velocity, state.value[2], effort
        if saturated(effort, lent.limit):
            newest.saturated += 1
        count_answer(s, stamp_ns, now_ns - stamp_ns, ended_ns - began_ns)
        return True

    return answer_loop(ANSWERING, answer)
