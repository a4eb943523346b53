"""Clocks of the bridge: wall time, and simulated time that advances by waiting."""

from __future__ import annotations

import time
from typing import Protocol

from pendulum_msgs_py.contract.timing import SteadyWallClock

__all__ = ["Clock", "SteppedClock", "WallClock"]


class Clock(Protocol):
    """A clock that can be waited for."""

    def now_ns(self) -> int:
        """Return the time [ns]."""

    def wait_until(self, time_ns: int) -> None:
        """Return at a time [ns], or at once where it is past."""


class WallClock:
    """Monotonic wall time."""

    def __init__(self) -> None:
        self._clock = SteadyWallClock()

    def now_ns(self) -> int:
        """Return the time since the epoch [ns]."""
        return self._clock()

    def wait_until(self, time_ns: int) -> None:
        """Sleep until a time [ns]."""
        remaining = time_ns - self.now_ns()
        if remaining > 0:
            time.sleep(remaining * 1e-9)


class SteppedClock:
    """Simulated time from ``start_ns`` [ns]: waiting returns at once."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the simulated time [ns]."""
        return self._now_ns

    def wait_until(self, time_ns: int) -> None:
        """Advance to a time [ns]; never back."""
        self._now_ns = max(self._now_ns, time_ns)
