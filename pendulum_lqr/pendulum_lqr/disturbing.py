"""When a disturbance acts: the disturbance node without ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from pendulum_lqr.disturbance import Disturbance
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["DisturbanceAnswer", "DisturbanceLoop"]

_RESTART_NS = NANOSECONDS


class DisturbanceAnswer(NamedTuple):
    """Torque for one state, and the event that it marks (``noise_start``, ``noise_end`` or empty)."""

    torque: float
    event: str


class DisturbanceLoop:
    """Turns stamps into torques: zero, then the signal from the first state after the start, then zero again.

    The torque that answers a state acts until the next state, so the signal is taken at the middle of that interval.
    A plant at the rate of the signal's holds whose stamps jitter by a fraction of a millisecond would otherwise read
    the edges of the holds: some samples twice, others never, and not the signal that another plant gets.

    Args:
        signal: The disturbance.
        duration: How long it acts [s]; 0 until it is stopped.
        simulated_time: A stamp a second or more before the newest means a new simulation.
    """

    def __init__(self, signal: Disturbance, duration: float = 0.0, *, simulated_time: bool = False) -> None:
        self.newest_stamp_ns: int | None = None
        self.answered = 0
        self.refused = 0
        self.last_torque = 0.0
        self._signal = signal
        self._duration_ns = round(duration * NANOSECONDS)
        self._simulated_time = simulated_time
        self._armed = False
        self._start_ns: int | None = None
        self._shortest_interval_ns: int | None = None
        self._window = (0, 0)
        self._ending = False

    @property
    def running(self) -> bool:
        """Whether the disturbance acts, or will from the next state on."""
        return self._armed or self._start_ns is not None

    def start(self) -> bool:
        """Begin with the next state; return False if it runs already."""
        if self.running:
            return False
        self._armed = True
        return True

    def stop(self) -> bool:
        """End with the next state; return False if it was not running."""
        was_running = self.running
        # The end is an event only where there was a beginning.
        self._ending = self._start_ns is not None
        self._armed, self._start_ns = False, None
        return was_running

    def replace(self, signal: Disturbance, duration: float) -> None:
        """Take another signal for the next start."""
        self._signal = signal
        self._duration_ns = round(duration * NANOSECONDS)

    def answer(self, stamp_ns: int) -> DisturbanceAnswer | None:
        """Return the torque for a state, or None for a state that was answered or overtaken already.

        Args:
            stamp_ns: Stamp of the state [ns].
        """
        newest = self.newest_stamp_ns
        if (
            newest is not None
            and stamp_ns <= newest
            and not (self._simulated_time and newest - stamp_ns >= _RESTART_NS)
        ):
            self.refused += 1
            # A plant in lockstep repeats a state when the answer did not reach it: the same answer again.
            repeated = self._simulated_time and stamp_ns == newest
            return DisturbanceAnswer(self.last_torque, "") if repeated else None
        if newest is not None and stamp_ns > newest:
            interval = stamp_ns - newest
            # The shortest: a state that was lost on the way must not look like a longer period.
            known = self._shortest_interval_ns
            self._shortest_interval_ns = interval if known is None else min(known, interval)
        self.newest_stamp_ns = stamp_ns
        self.answered += 1
        event = ""
        if self._armed:
            self._armed, self._start_ns = False, stamp_ns
            event = "noise_start"
        torque = 0.0
        if self._start_ns is not None:
            elapsed = stamp_ns - self._start_ns
            if elapsed < 0 or (self._duration_ns and elapsed >= self._duration_ns):
                self._start_ns = None
                event = "noise_end"
            else:
                torque = self._signal(elapsed + (self._shortest_interval_ns or 0) // 2)
        elif self._ending:
            event = "noise_end"
        self._ending = False
        self.last_torque = torque
        return DisturbanceAnswer(torque, event)

    def summary(self, now_ns: int) -> Mapping[str, object]:
        """Return the figures for diagnostics; the rate is that since the last summary.

        Args:
            now_ns: Monotonic time [ns].
        """
        before_ns, before = self._window
        elapsed = (now_ns - before_ns) / NANOSECONDS
        rate = (self.answered - before) / elapsed if before_ns and elapsed > 0.0 else math.nan
        self._window = (now_ns, self.answered)
        return {
            "answered": self.answered,
            "refused": self.refused,
            "answer_rate_hz": rate,
            "torque": self.last_torque,
        }
