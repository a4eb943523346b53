"""Selection of states that get a reply, and diagnostics: the controller node without ROS."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from enum import Enum

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.nodes.answer_rules import (
    DUPLICATE,
    FROM_FUTURE,
    LONGEST,
    NEW,
    OUT_OF_ORDER,
    STALE,
    is_saturated,
    judge_state,
)
from pendulum_msgs_py.contract.rules import NEVER
from pendulum_msgs_py.contract.timing import RingOfTimes
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample, Vector, written

__all__ = ["ControlLoop", "StateRefusal"]


class StateRefusal(str, Enum):
    """Why a state got no command; the value is the key in diagnostics."""

    MALFORMED = "malformed"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    FROM_FUTURE = "from_future"
    OUT_OF_ORDER = "out_of_order"
    DUPLICATE = "duplicate"
    NO_ANSWER = "no_answer"


_REFUSALS = {
    STALE: StateRefusal.STALE,
    FROM_FUTURE: StateRefusal.FROM_FUTURE,
    DUPLICATE: StateRefusal.DUPLICATE,
    OUT_OF_ORDER: StateRefusal.OUT_OF_ORDER,
}


class ControlLoop:
    """Replies to each new state once, and counts.

    Args:
        controller: Controller.
        state_timeout: Largest age of a state [s]; inf for any age.
        simulated_time: Stamps are those of a simulator, so that their age has no meaning and they may restart.
        send: Called with a state and the efforts [N m or N], before anything is counted.
        monotonic: Clock for the compute time [ns].

    Attributes:
        newest: Newest processed state; None before the first.
        answered_ns: Stamp of the newest state that got a command [ns]; None before the first.
        kept_answer: Efforts for it [N m or N], or None.
        start_ns: Stamp of the first state since a restart [ns], or None.
        timeout_ns: Largest age of a state [ns].
        age: Ages of the states that got a command [ns].
        compute_time: Compute times of the commands [ns].
    """

    def __init__(
        self,
        controller: Controller,
        state_timeout: float,
        *,
        simulated_time: bool = False,
        send: Callable[[JointSample, Vector], None] = lambda sample, effort: None,
        monotonic: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.controller = controller
        self.simulated_time = simulated_time
        self.refused: Counter[StateRefusal] = Counter()
        self.answered = 0
        self.saturated = 0
        self.restarts = 0
        self._take(controller)
        self.last_effort = self._nothing
        self.last_reason = ""
        self.age = RingOfTimes()
        self.compute_time = RingOfTimes()
        self.newest: JointSample | None = None
        self.answered_ns: int | None = None
        self.kept_answer: Vector | None = None
        self._send = send
        self._monotonic = monotonic
        self._timeout = state_timeout
        # Whole nanoseconds, as ages are.
        self.timeout_ns = math.floor(min(LONGEST, state_timeout * NANOSECONDS))
        self.start_ns: int | None = None
        self._window = (0, 0, 0)

    @property
    def newest_stamp_ns(self) -> int | None:
        """Stamp of the newest processed state [ns]; None before the first."""
        return None if self.newest is None else self.newest.stamp_ns

    def restart(self) -> None:
        """Forget the past: the next state is the first one."""
        self.controller.reset()
        self.newest = self.answered_ns = None
        self.start_ns = None
        self.last_effort = self._nothing

    def replace(self, controller: Controller) -> None:
        """Swap the controller between two states; integrals and filters are carried over."""
        controller.carry_over(self.controller)
        self.controller = controller
        self._take(controller)

    def _take(self, controller: Controller) -> None:
        self._efforts, self._limits = controller.efforts, controller.effort_limits
        self._nothing = (0.0,) * len(self._limits)

    def answer(self, sample: JointSample | None, now_ns: int, problem: str = "") -> Vector | None:
        """Send the efforts for a state and return them, or None if the state is refused [N m or N].

        Args:
            sample: State; None for a message without the plant's joints.
            now_ns: Time of arrival on the clock of the stamps [ns]; not used in simulated time.
            problem: Problem of a message without a state.
        """
        refusal = self._judge(sample, now_ns)
        if refusal is not None:
            self.refused[refusal] += 1
            self.last_reason = problem if sample is None else self._problem(refusal, sample, now_ns)
            # A plant in lockstep repeats a state if the reply was lost: send the same reply again, if any.
            if sample is None or refusal is not StateRefusal.DUPLICATE or not self.simulated_time:
                return None
            if self.kept_answer is not None:
                self._send(sample, self.kept_answer)
            return self.kept_answer
        assert sample is not None
        if self.start_ns is None:
            self.start_ns = sample.stamp_ns
        self.newest, self.kept_answer = sample, None
        began = self._monotonic()
        reason = ""
        try:
            time_s = (sample.stamp_ns - self.start_ns) / NANOSECONDS
            effort = self._efforts(time_s, sample.position, sample.velocity)
        except (ArithmeticError, ValueError, RuntimeError) as error:
            # A failing solver must not end the node: without a command the plant's timeout applies zero torque.
            effort, reason = (math.nan,), f"{type(error).__name__}: {error}"
        if not all(map(math.isfinite, effort)):
            unit = " N m" if len(sample.position) == 1 else ""  # of several joints, each has its own
            self.last_reason = reason or f"controller answered {written(effort)}{unit}"
            self.refused[StateRefusal.NO_ANSWER] += 1
            return None
        ended = self._monotonic()
        self.last_effort = self.kept_answer = effort
        # Before counting: the plant waits for it, and counting is slow in a process that has just woken up.
        self._send(sample, effort)
        self.answered_ns = sample.stamp_ns
        self.compute_time.add(ended - began)
        if not self.simulated_time:
            self.age.add(now_ns - sample.stamp_ns)
        self.answered += 1
        for value, limit in zip(effort, self._limits, strict=True):
            if is_saturated(value, limit):
                self.saturated += 1
                break
        return effort

    def count(
        self,
        sample: JointSample,
        effort: Vector,
        *,
        answered: int,
        saturated: int,
        ages_ns: Sequence[int],
        compute_times_ns: Sequence[int],
    ) -> None:
        """Count replies already sent: efforts [N m or N], number, number at a limit, ages and compute times [ns]."""
        self.newest, self.kept_answer, self.last_effort = sample, effort, effort
        self.answered_ns = sample.stamp_ns
        self.answered += answered
        self.saturated += saturated
        self.compute_time.extend(compute_times_ns)
        if not self.simulated_time:
            self.age.extend(ages_ns)

    def summary(self, now_ns: int) -> Mapping[str, object]:
        """Return figures for diagnostics at a monotonic time [ns]; rate and saturation since the last summary."""
        before_ns, before_answered, before_saturated = self._window
        answers = self.answered - before_answered
        elapsed = (now_ns - before_ns) / NANOSECONDS
        age = self.age.percentiles_us(50, 99, 100)
        compute = self.compute_time.percentiles_us(50, 99, 100)
        values: dict[str, object] = {
            "answered": self.answered,
            "answer_rate_hz": answers / elapsed if before_ns and elapsed > 0.0 else math.nan,
            "saturation_share": (self.saturated - before_saturated) / answers if answers else 0.0,
            "state_age_p50_us": age[0],
            "state_age_p99_us": age[1],
            "state_age_max_us": age[2],
            "compute_time_p50_us": compute[0],
            "compute_time_p99_us": compute[1],
            "compute_time_max_us": compute[2],
            "effort": self.last_effort[0] if len(self.last_effort) == 1 else written(self.last_effort, ".6g"),
            "restarts": self.restarts,
        }
        for refusal in StateRefusal:
            if self.refused[refusal]:
                values[f"refused.{refusal.value}"] = self.refused[refusal]
        if self.last_reason:
            values["reason"] = self.last_reason
        self._window = (now_ns, self.answered, self.saturated)
        return values

    def _judge(self, sample: JointSample | None, now_ns: int) -> StateRefusal | None:
        if sample is None:
            return StateRefusal.MALFORMED
        if not all(map(math.isfinite, sample.position + sample.velocity)):
            return StateRefusal.NOT_FINITE
        newest = self.newest
        found = judge_state(
            sample.stamp_ns,
            sample.stamp_ns if self.simulated_time else now_ns,
            self.timeout_ns,
            NEVER if newest is None else newest.stamp_ns,
        )
        if found == NEW:
            return None
        # Angle and velocity alone: the measured torque is not part of the state.
        if self.simulated_time and newest is not None and sample[:3] != newest[:3]:
            # Messages of one writer are never reordered, so simulated time that goes back, or another state with the
            # same stamp, is a restarted simulation, however short the previous one was.
            self.restarts += 1
            self.restart()
            return None
        return _REFUSALS[found]

    def _problem(self, refusal: StateRefusal, sample: JointSample, now_ns: int) -> str:
        age = (now_ns - sample.stamp_ns) / NANOSECONDS
        limit = f"expected at most {self._timeout:g} s"
        if refusal is StateRefusal.NOT_FINITE:
            where, speed = written(sample.position), written(sample.velocity)
            if len(sample.position) > 1:  # each in its own unit
                return f"position is {where}, velocity {speed}; expected finite numbers"
            return f"position is {where} rad, velocity {speed} rad/s; expected finite numbers"
        if refusal is StateRefusal.STALE:
            return f"header.stamp is {age:.6g} s old; {limit}"
        if refusal is StateRefusal.FROM_FUTURE:
            return f"header.stamp is {-age:.6g} s ahead of this clock; {limit}"
        return f"header.stamp is {sample.stamp_ns} ns; the newest was {self.newest_stamp_ns} ns"
