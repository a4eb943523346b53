"""Timing of a disturbance: the disturbance node without ROS."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pendulum_lqr.disturbances.disturbance import Disturbance
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["INTERVALS", "DisturbanceAnswer", "DisturbanceLoop"]

INTERVALS = 31
"""Number of intervals whose median is used: few enough to follow a restart at another rate, enough that lost or bunched
states have no effect.
"""


class DisturbanceAnswer(NamedTuple):
    """Torque for one state, and its event (``noise_start``, ``noise_end`` or empty)."""

    torque: float
    event: str


class DisturbanceLoop:
    """Turns stamps into torques: zero, then the signal from the first state after the start, then zero again.

    The torque for a state acts until the next state, so the signal is sampled in the middle of that interval. At the
    edges of its holds, jitter of the stamps would repeat some samples and skip others.

    Args:
        signal: Disturbance.
        duration: [s]; 0 until it is stopped.
        simulated_time: A stamp before the newest means a new simulation.
        autostart: Start with the first state, of a new simulation too.
    """

    def __init__(
        self, signal: Disturbance, duration: float = 0.0, *, simulated_time: bool = False, autostart: bool = False
    ) -> None:
        self.newest_stamp_ns: int | None = None
        self.answered = 0
        self.refused = 0
        self.last_torque = 0.0
        self.signal = signal
        self.duration_ns = round(duration * NANOSECONDS)
        self._simulated_time = simulated_time
        self._autostart = autostart
        self._armed = autostart
        self.start_ns: int | None = None
        self.intervals_ns: deque[int] = deque(maxlen=INTERVALS)
        self._window = (0, 0)
        self._ending = False

    @property
    def running(self) -> bool:
        """Whether the disturbance acts, or will from the next state on."""
        return self._armed or self.start_ns is not None

    def start(self) -> bool:
        """Start with the next state; return False if it is running."""
        if self.running:
            return False
        self._armed = True
        return True

    def stop(self) -> bool:
        """End with the next state; return False if it was not running."""
        was_running = self.running
        # Only a started disturbance has an end event, and an unpublished one stays pending.
        self._ending |= self.start_ns is not None
        self._armed, self.start_ns = False, None
        return was_running

    def replace(self, signal: Disturbance, duration: float) -> None:
        """Set another signal for the next start."""
        self.signal = signal
        self.duration_ns = round(duration * NANOSECONDS)

    def answer(self, stamp_ns: int) -> DisturbanceAnswer | None:
        """Return the torque for a state's stamp [ns], or None for a state with a torque already or an old one."""
        newest = self.newest_stamp_ns
        if newest is not None and stamp_ns <= newest:
            if not self._simulated_time or stamp_ns == newest:
                self.refused += 1
                # A plant in lockstep repeats a state if the reply was lost: send the same reply again.
                return DisturbanceAnswer(self.last_torque, "") if self._simulated_time else None
            self._restart()
        elif newest is not None:
            self.intervals_ns.append(stamp_ns - newest)
        self.newest_stamp_ns = stamp_ns
        self.answered += 1
        event = ""
        # One event per state: after a pending end, a new start waits for the next state.
        if self._armed and not self._ending:
            self._armed, self.start_ns = False, stamp_ns
            event = Event.NOISE_START
        torque = 0.0
        if self.start_ns is not None:
            elapsed = stamp_ns - self.start_ns
            if elapsed < 0 or (self.duration_ns and elapsed >= self.duration_ns):
                self.start_ns = None
                event = Event.NOISE_END
            else:
                torque = self.signal(elapsed + self._interval_ns // 2)
        elif self._ending:
            event = Event.NOISE_END
        self._ending = False
        self.last_torque = torque
        return DisturbanceAnswer(torque, event)

    @property
    def goes_on(self) -> bool:
        """Whether the next state, if it is a nominal one, starts and ends nothing."""
        return self.newest_stamp_ns is not None and not self._armed and not self._ending

    def count(self, stamps_ns: Sequence[int], torque: float) -> None:
        """Record the stamps [ns] of states answered by the compiled loop, the newest with a torque [N m]."""
        for stamp_ns in stamps_ns:
            assert self.newest_stamp_ns is not None
            self.intervals_ns.append(stamp_ns - self.newest_stamp_ns)
            self.newest_stamp_ns = stamp_ns
        self.answered += len(stamps_ns)
        self.last_torque = torque

    @property
    def _interval_ns(self) -> int:
        """Interval between states [ns]; 0 before the second one."""
        return round(statistics.median_low(self.intervals_ns)) if self.intervals_ns else 0

    def _restart(self) -> None:
        """Forget the plant whose simulation has ended, so that the next one gets the same signal."""
        armed = self._armed or self._autostart
        self.stop()
        self._armed = armed
        # A start event implies the end of the noise before.
        self._ending &= not armed
        self.intervals_ns.clear()

    def summary(self, now_ns: int) -> Mapping[str, object]:
        """Return the figures for diagnostics at a monotonic time [ns]; the rate is since the last summary."""
        before_ns, before = self._window
        elapsed = (now_ns - before_ns) / NANOSECONDS
        rate = (self.answered - before) / elapsed if before_ns and elapsed > 0.0 else math.nan
        self._window = (now_ns, self.answered)
        return {"answered": self.answered, "refused": self.refused, "answer_rate_hz": rate, "torque": self.last_torque}
