"""Which states a controller answers, and what its diagnostics say: the controller node without ROS."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from enum import Enum

from pendulum_lqr.controller import Controller
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.contract.timing import RingOfTimes
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample

__all__ = ["AnswerLoop", "StateRefusal"]

_RESTART_NS = NANOSECONDS
"""In simulated time, a stamp this far before the newest one means that the simulation began anew [ns]."""


class StateRefusal(str, Enum):
    """Why a state was not answered; the value is the key in diagnostics."""

    MALFORMED = "malformed"
    NOT_FINITE = "not_finite"
    STALE = "stale"
    FROM_FUTURE = "from_future"
    OUT_OF_ORDER = "out_of_order"
    DUPLICATE = "duplicate"
    NO_ANSWER = "no_answer"


class AnswerLoop:
    """Answers each new state once and keeps count.

    Args:
        controller: The controller.
        state_timeout: Age beyond which a state is not answered [s]; inf for any age.
        simulated_time: Stamps are those of a simulator, so that their age says nothing and they may start anew.
        monotonic: Clock for the compute time [ns].
    """

    def __init__(
        self,
        controller: Controller,
        state_timeout: float,
        *,
        simulated_time: bool = False,
        monotonic: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.controller = controller
        self.simulated_time = simulated_time
        self.refused: Counter[StateRefusal] = Counter()
        self.answered = 0
        self.saturated = 0
        self.restarts = 0
        self.last_effort = 0.0
        self.last_reason = ""
        self.age = RingOfTimes()
        self.compute_time = RingOfTimes()
        self.newest_stamp_ns: int | None = None
        self._monotonic = monotonic
        self._timeout_ns = math.inf if simulated_time else state_timeout * NANOSECONDS
        self._start_ns: int | None = None
        self._window = (0, 0, 0)

    def restart(self) -> None:
        """Forget the past: the next state is the first one."""
        self.controller.reset()
        self.newest_stamp_ns = None
        self._start_ns = None
        self.last_effort = 0.0

    def replace(self, controller: Controller) -> None:
        """Swap the controller between two states; integrals and filters are carried over."""
        controller.carry_over(self.controller)
        self.controller = controller

    def answer(self, sample: JointSample | None, now_ns: int) -> float | None:
        """Return the torque that answers a state, or None where the state is refused [N m].

        Args:
            sample: The state; None for a message that carries none of our joint.
            now_ns: Time of arrival on the clock of the stamps [ns]; not used in simulated time.
        """
        refusal = self._judge(sample, now_ns)
        if refusal is not None:
            self.refused[refusal] += 1
            # A plant in lockstep repeats a state when the answer did not reach it: the same answer again.
            repeated = refusal is StateRefusal.DUPLICATE and self.simulated_time
            return self.last_effort if repeated else None
        assert sample is not None
        if self._start_ns is None:
            self._start_ns = sample.stamp_ns
        self.newest_stamp_ns = sample.stamp_ns
        began = self._monotonic()
        x = (from_upright(sample.position), sample.velocity)
        try:
            effort = self.controller.command((sample.stamp_ns - self._start_ns) / NANOSECONDS, x)
        except (ArithmeticError, ValueError, RuntimeError) as error:
            # A solver that gives up must not end the node: without an answer the plant's timeout makes it zero.
            self.last_reason = f"{type(error).__name__}: {error}"
            effort = math.nan
        if not math.isfinite(effort):
            self.last_reason = self.last_reason or f"controller answered {effort} N m"
            self.refused[StateRefusal.NO_ANSWER] += 1
            return None
        self.compute_time.add(self._monotonic() - began)
        if not self.simulated_time:
            self.age.add(now_ns - sample.stamp_ns)
        self.answered += 1
        if abs(effort) >= self.controller.effort_limit:
            self.saturated += 1
        self.last_effort = effort
        return effort

    def summary(self, now_ns: int) -> Mapping[str, object]:
        """Return the figures for diagnostics; rate and saturation are those since the last summary.

        Args:
            now_ns: Monotonic time [ns].
        """
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
            "effort": self.last_effort,
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
        if not (math.isfinite(sample.position) and math.isfinite(sample.velocity)):
            return StateRefusal.NOT_FINITE
        if not self.simulated_time:
            age = now_ns - sample.stamp_ns
            if age > self._timeout_ns:
                return StateRefusal.STALE
            if age < -self._timeout_ns:
                return StateRefusal.FROM_FUTURE
        newest = self.newest_stamp_ns
        if newest is None:
            return None
        if sample.stamp_ns == newest:
            return StateRefusal.DUPLICATE
        if sample.stamp_ns < newest:
            if self.simulated_time and newest - sample.stamp_ns >= _RESTART_NS:
                self.restarts += 1
                self.restart()
                return None
            return StateRefusal.OUT_OF_ORDER
        return None
