"""Nominal periods of a plant of one joint, compiled: take torques, decide, step, publish.

Every check comes before the first change: any other period or message ends the loop untouched, and Python handles it.
"""

from __future__ import annotations

from typing import Any

from pendulum_msgs_py.loops import plant_rules
from pendulum_msgs_py.loops.plant_record import (
    DISTURBANCE,
    EFFORT,
    ENDED,
    INPUTS,
    MESSAGE_WAITS,
    MOST_PERIODS,
    OWN_STAMPS,
    UNUSUAL,
    plant_record,
)
from pendulum_msgs_py.loops.primitives import (
    NOTHING,
    ORDINARY,
    compiled,
    copy,
    entry,
    has_listeners,
    is_called,
    publish,
    sleep_until,
    steady_ns,
    take_one,
    wait_for_any,
    wall_ns,
)
from pendulum_msgs_py.loops.records import HAND_OVER_NS
from pendulum_msgs_py.loops.trees import compile_tree

__all__ = ["plant_loop"]

_accept = compile_tree(plant_rules.accept, exact=True)
_decide = compile_tree(plant_rules.decide, exact=True)
_IS_READ = -1


@compiled
def _thread_waits(s: Any) -> Any:
    copy(s.waiting.ctypes.data, s.waiting_at, 8)
    return s.waiting[0] != 0


@compiled
def _is_answer(s: Any, stamp_ns: Any) -> Any:
    for back in range(OWN_STAMPS):  # noqa: SIM110  (compiled code has no any())
        if s.own_stamp_ns[(s.own_newest - back) % OWN_STAMPS] == stamp_ns:
            return True
    return False


@compiled
def _time_ns(s: Any) -> Any:
    return s.now_ns if s.lockstep else steady_ns(s.time) + s.wall_ahead_ns


@compiled
def _take_inputs(s: Any) -> Any:
    """Take new torques; return the input whose message is left to Python, or ``_IS_READ``."""
    for index in range(INPUTS):
        source = s.inputs[index]
        for _ in range(source.most):
            found = take_one(source)
            if found == NOTHING:
                break
            if found != ORDINARY:
                return index
            if index == EFFORT:
                if not _is_answer(s, source.stamp_ns) or not _accept(source, s.rules.command, _time_ns(s)):
                    return index
                # System time, as in DDS's arrival stamps and the interpreted loop.
                if not s.lockstep and source.stamp_ns == s.sample_ns and s.latencies < MOST_PERIODS:
                    s.latency_ns[s.latencies] = source.info[1] - s.published_ns
                    s.latencies += 1
            elif index == DISTURBANCE:
                if not _accept(source, s.rules.disturbance, _time_ns(s)):
                    return index
            else:
                return index
            if source.stamp_ns == s.now_ns:
                s.answered |= 1 << index
    return _IS_READ


def plant_loop(layout: Any, step: Any) -> Any:
    """Return the compiled loop for a kind of plant.

    Args:
        layout: Of the plant's part of the record.
        step: Compiled ``step(plant, effort)``: advances one period and sets ``theta``, ``theta_dot`` and ``torque``.
    """

    @compiled
    def advance(s: Any) -> Any:
        """Run one period from decision to publication; return whether the state was published."""
        until_ns = s.now_ns + s.period_ns
        # In lockstep a decision is as of the answered state, in real time as of the deadline.
        if not _decide(s, s.now_ns if s.lockstep else until_ns):
            return False
        before_ns = s.sample_ns
        applied = s.rules.last_effort
        step(s.plant, applied)
        s.now_ns = s.sample_ns = until_ns
        s.position, s.velocity, s.effort = s.plant.theta, s.plant.theta_dot, s.plant.torque
        s.answered = 0
        # The state first: the controller waits for it.
        out = s.states
        out.value[0], out.value[1], out.value[2] = s.position, s.velocity, s.effort
        s.published_ns = wall_ns(s.time)
        is_out = publish(out, until_ns)
        s.own_newest = (s.own_newest + 1) % OWN_STAMPS
        s.own_stamp_ns[s.own_newest] = until_ns
        if s.has_clock and has_listeners(s.clock):
            publish(s.clock, until_ns)
        if has_listeners(s.applied):
            s.applied.value[0] = applied
            publish(s.applied, before_ns)
        s.periods += 1
        return is_out

    @compiled
    def in_real_time(s: Any) -> Any:
        while s.periods < MOST_PERIODS and steady_ns(s.time) < s.end_ns:
            deadline_ns = s.now_ns + s.period_ns
            sleep_until(s.time, deadline_ns - s.wall_ahead_ns)
            late_ns = _time_ns(s) - deadline_ns
            if late_ns < 0 or late_ns >= s.period_ns or _thread_waits(s):
                return UNUSUAL
            if is_called(s.time, s.calls):
                return ENDED
            waits = _take_inputs(s)
            if waits != _IS_READ:
                return MESSAGE_WAITS + waits
            s.late_ns[s.periods] = late_ns
            if not advance(s):
                return UNUSUAL
        sleep_until(s.time, s.now_ns - s.wall_ahead_ns + min(HAND_OVER_NS, s.period_ns // 4))
        return ENDED

    @compiled
    def in_lockstep(s: Any) -> Any:
        while True:
            if _thread_waits(s):
                return UNUSUAL
            waits = _take_inputs(s)
            if waits != _IS_READ:
                return MESSAGE_WAITS + waits
            if s.answered & s.expected == s.expected:
                # Python does the last step, which also publishes the end.
                if s.now_ns + s.period_ns >= s.last_ns or not advance(s):
                    return UNUSUAL
                continue
            left_ns = s.end_ns - steady_ns(s.time)
            if left_ns <= 0 or is_called(s.time, s.calls):
                return ENDED
            wait_for_any(s.time, s.counter, s.calls, left_ns)

    @entry(plant_record(layout))
    def run(s: Any) -> Any:
        return in_lockstep(s) if s.lockstep else in_real_time(s)

    return run
