"""The compiled loop that replies to each message of an input; imported by the compiler's process alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_msgs_py.loops.answer_record import ENDED, FAILED, LEFT, MOST_ANSWERS, answer_record
from pendulum_msgs_py.loops.primitives import (
    NOTHING,
    ORDINARY,
    OTHER,
    compiled,
    entry,
    is_called,
    steady_ns,
    take_one,
    wait_for_any,
)
from pendulum_msgs_py.loops.records import HAND_OVER_NS

__all__ = ["answer_loop", "count_answer"]


def answer_loop(own: np.dtype[Any], answer: Any) -> Any:
    """Return the compiled loop.

    Args:
        own: Layout of the node's own state.
        answer: Compiled ``answer(s, arrived_ns)``, at a time of the monotonic clock [ns]: replies to the message and
            counts the reply, or returns False before any change, so that Python handles the message.
    """

    @entry(answer_record(own))
    def run(s: Any) -> Any:
        while True:
            found = take_one(s.state)
            if found == OTHER:
                return LEFT
            now_ns = steady_ns(s.time)
            if found == ORDINARY:
                if not answer(s, now_ns):
                    return LEFT
                if s.answers >= MOST_ANSWERS or now_ns >= s.end_ns:
                    wait_for_any(s.time, s.counter, s.calls, HAND_OVER_NS)
                    return ENDED
            elif found != NOTHING:
                return FAILED
            elif now_ns >= s.end_ns or is_called(s.time, s.calls):
                return ENDED
            else:
                wait_for_any(s.time, s.counter, s.calls, s.end_ns - now_ns)

    return run


@compiled
def count_answer(s: Any, stamp_ns: Any, age_ns: Any, compute_ns: Any) -> None:
    """Record the times of a published reply [ns]."""
    s.stamp_ns[s.answers] = stamp_ns
    s.age_ns[s.answers] = age_ns
    s.compute_ns[s.answers] = compute_ns
    s.answers += 1
