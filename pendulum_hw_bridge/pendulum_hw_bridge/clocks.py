"""Clocks of the bridge: the wall's, and one that only moves when somebody waits for it."""

from __future__ import annotations

import threading
import time
from typing import Protocol

__all__ = ["Clock", "SteppedClock", "WallClock"]


class Clock(Protocol):
    """What tells the time and waits for it."""

    def now_ns(self) -> int:
        """Return the time [ns]."""

    def wait_until(self, time_ns: int) -> None:
        """Return at a time [ns], or at once where it is past."""


class WallClock:
    """System time at the start, monotonic from there: stamps compare with other nodes', yet never jump.

    Args:
        wake: Set to end a wait early, such as on shutdown.
    """

    def __init__(self, wake: threading.Event | None = None) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._wake = wake or threading.Event()

    def now_ns(self) -> int:
        """Return the time since the epoch [ns]."""
        return time.monotonic_ns() + self._offset_ns

    def wait_until(self, time_ns: int) -> None:
        """Sleep until a time [ns], or until woken."""
        remaining = time_ns - self.now_ns()
        if remaining > 0:
            self._wake.wait(remaining * 1e-9)


class SteppedClock:
    """Simulated time: waiting takes none.

    Args:
        start_ns: Time at the start [ns].
    """

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the simulated time [ns]."""
        return self._now_ns

    def wait_until(self, time_ns: int) -> None:
        """Move on to a time [ns]; never back."""
        self._now_ns = max(self._now_ns, time_ns)
