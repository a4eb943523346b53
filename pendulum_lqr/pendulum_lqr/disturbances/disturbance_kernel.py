"""Compiled loop of a disturbance, imported by the compiler's process only."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_lqr.disturbances.compiled_disturbance import DISTURBING
from pendulum_lqr.disturbances.disturbing import INTERVALS
from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.loops.answer_kernel import answer_loop, count_answer
from pendulum_msgs_py.loops.primitives import compiled, publish
from pendulum_msgs_py.loops.trees import compile_tree

__all__ = ["uniform_loop"]


def uniform_loop() -> Any:
    """Return the compiled loop of uniform noise, or of zero before its start and after its end."""
    scramble = compile_tree(noise.scramble, exact=True)
    unit_interval = compile_tree(noise.unit_interval, exact=True)

    @compiled
    def middle_interval(own: Any, known: Any) -> Any:
        """Return the lower median of a number of intervals, as ``statistics.median_low`` does."""
        for index in range(known):
            value, place = own.interval_ns[index], index
            while place > 0 and own.ordered_ns[place - 1] > value:
                own.ordered_ns[place] = own.ordered_ns[place - 1]
                place -= 1
            own.ordered_ns[place] = value
        return own.ordered_ns[(known - 1) // 2]

    @compiled
    def answer(s: Any, _arrived_ns: Any) -> Any:
        own = s.own
        stamp_ns = s.state.stamp_ns
        if stamp_ns <= own.newest_ns:
            return False
        elapsed_ns = stamp_ns - own.start_ns
        if own.acts and (elapsed_ns < 0 or (own.duration_ns > 0 and elapsed_ns >= own.duration_ns)):
            return False
        place = own.count % INTERVALS
        replaced_ns = own.interval_ns[place]
        own.interval_ns[place] = stamp_ns - own.newest_ns
        torque = 0.0
        if own.acts:
            time_ns = elapsed_ns + middle_interval(own, min(own.count + 1, INTERVALS)) // 2
            torque = own.amplitude * unit_interval(scramble(own.key, np.uint64(time_ns // own.hold_ns)))
        s.answer.value[0] = torque
        if not publish(s.answer, stamp_ns):
            own.interval_ns[place] = replaced_ns
            return False
        own.count += 1
        own.newest_ns = stamp_ns
        own.torque = torque
        count_answer(s, stamp_ns, 0, 0)
        return True

    return answer_loop(DISTURBING, answer)
