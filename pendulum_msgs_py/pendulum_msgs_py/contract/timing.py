"""Loop statistics and clocks; the time of each event is an argument."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["LoopStatistics", "RingOfTimes", "SteadyWallClock", "Throttle"]


class SteadyWallClock:
    """Wall-clock time that moves only forward, at the pace of the monotonic clock [ns].

    The wall clock is read once: a step of it (NTP, a user) must not make a command look fresh or a loop miss deadlines.
    """

    def __init__(
        self, wall: Callable[[], int] = time.time_ns, monotonic: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._monotonic = monotonic
        self.ahead_ns = wall() - monotonic()
        """Lead over the monotonic clock [ns]."""

    def __call__(self) -> int:
        """Return the time [ns]."""
        return self._monotonic() + self.ahead_ns


class RingOfTimes:
    """The last N durations, stored without allocation."""

    def __init__(self, size: int = 4096) -> None:
        # Not numpy's: an item is written several times a period, and read twice a second.
        self._values = array("q", bytes(8 * size))
        self._size = size
        self._count = 0

    def add(self, duration_ns: int) -> None:
        """Add one duration [ns]."""
        self._values[self._count % self._size] = duration_ns
        self._count += 1

    def extend(self, durations_ns: Sequence[int]) -> None:
        """Add several durations, the oldest first [ns]."""
        kept = durations_ns[-self._size :]
        begin = (self._count + len(durations_ns) - len(kept)) % self._size
        until_end = min(len(kept), self._size - begin)
        self._values[begin : begin + until_end] = array("q", kept[:until_end])
        self._values[: len(kept) - until_end] = array("q", kept[until_end:])
        self._count += len(durations_ns)

    @property
    def count(self) -> int:
        """Number of durations ever added."""
        return self._count

    def percentiles_us(self, *percents: float) -> list[float]:
        """Return percentiles by nearest rank [us]; NaN before the first duration."""
        kept = np.frombuffer(self._values, dtype=np.int64)[: min(self._count, self._size)]
        if kept.size == 0:
            return [float("nan")] * len(percents)
        # In the middle of a loop, where numpy's general percentile would cost a quarter of a period at 1 kHz.
        ranks = [round((kept.size - 1) * percent / 100.0) for percent in percents]
        ordered = np.partition(kept, ranks)
        return [float(ordered[rank]) / 1e3 for rank in ranks]


class Throttle:
    """Passes at most one line per interval [s], and counts the suppressed ones."""

    def __init__(self, interval: float) -> None:
        self._interval = interval
        self._last = float("-inf")
        self._left_out = 0

    def ask(self, now: float, *, urgent: bool = False) -> int | None:
        """Return how many lines were suppressed before this one at a time [s], or None to suppress it too."""
        if now - self._last < self._interval and not urgent:
            self._left_out += 1
            return None
        self._last = now
        left_out, self._left_out = self._left_out, 0
        return left_out

    def flush(self, now: float) -> int:
        """Return how many lines were suppressed once the interval is over, to log the last state; else 0."""
        return 0 if not self._left_out or now - self._last < self._interval else self.ask(now) or 0


class LoopStatistics:
    """Rate, jitter, overruns and command latency of a loop with this period [ns]."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self.jitter = RingOfTimes()
        self.latency = RingOfTimes()
        self.answered_age = RingOfTimes()
        self.overruns = 0
        self.cycles = 0
        self._window_start_ns = 0
        self._window_cycles = 0

    def cycle(self, now_ns: int, deadline_ns: int) -> None:
        """Record a cycle: when it ran and when it was due [ns]; late by a period is an overrun."""
        late = now_ns - deadline_ns
        self.jitter.add(abs(late))
        if late >= self.period_ns:
            self.overruns += 1
        if self.cycles == 0:
            self._window_start_ns = now_ns
        self.cycles += 1
        self._window_cycles += 1

    def punctual_cycles(self, late_ns: Sequence[int], first_ns: int) -> None:
        """Record cycles without overrun: lateness of each, and when the first ran [ns]."""
        self.jitter.extend(late_ns)
        if self.cycles == 0:
            self._window_start_ns = first_ns
        self.cycles += len(late_ns)
        self._window_cycles += len(late_ns)

    def round_trip(self, duration_ns: int) -> None:
        """Record the time from publishing a state until its command arrives [ns]."""
        self.latency.add(duration_ns)

    def act_on_age(self, age_ns: int) -> None:
        """Record the age of a measurement when its command is taken: the loop's delay [ns]."""
        self.answered_age.add(age_ns)

    def summary(self, now_ns: int) -> Mapping[str, float]:
        """Return the figures for diagnostics, with the rate since the last summary."""
        elapsed = (now_ns - self._window_start_ns) / NANOSECONDS
        rate = self._window_cycles / elapsed if elapsed > 0 and self.cycles else float("nan")
        self._window_start_ns = now_ns
        self._window_cycles = 0
        jitter = self.jitter.percentiles_us(50, 99, 100)
        latency = self.latency.percentiles_us(50, 99, 100)
        figures = {
            "rate_hz": rate,
            "cycles": self.cycles,
            "overruns": self.overruns,
            "jitter_p50_us": jitter[0],
            "jitter_p99_us": jitter[1],
            "jitter_max_us": jitter[2],
            "command_latency_p50_us": latency[0],
            "command_latency_p99_us": latency[1],
            "command_latency_max_us": latency[2],
        }
        if self.answered_age.count:
            ages = self.answered_age.percentiles_us(50, 99, 100)
            names = ("answered_age_p50_us", "answered_age_p99_us", "answered_age_max_us")
            figures.update(zip(names, ages, strict=True))
        return figures
