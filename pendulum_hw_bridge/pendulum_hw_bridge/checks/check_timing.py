"""Timing of an actuator's feedback, and whether the actuator or this computer causes irregularities.

The module's stamps show its regularity and losses; host stamps less module stamps, the transport time. A thread that
wakes every 2 ms shows whether this computer could have noticed, and so does the reader: a thread that has worked waits
longer for its turn than one that slept, and the records that it misses look like a module's gap.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pendulum_hw_bridge.port.actuator import Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["PULSE", "HostWatch", "Punctuality", "TimingFigures", "measure"]

PULSE = 0.002
"""Longest sleep of the watching thread and longest wait of a reader [s]."""
_LOST_GAP = 1.5
"""Interval from which a record is missing in between, in periods [-]."""


class Punctuality(Protocol):
    """Measures how late this computer wakes threads."""

    def start(self) -> None:
        """Begin."""

    def poll(self) -> None:
        """Record that the reader is awake, which it should be within a pulse of the previous call."""

    def stop(self) -> Sequence[float]:
        """End, and return the lateness of each waking [s]."""


class HostWatch:
    """Measures the lateness of a thread that wakes every 2 ms, and of the reader."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._late: list[float] = []
        self._looked: float | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin."""
        self._stopping.clear()
        self._late = []
        self._looked = None
        self._thread = threading.Thread(target=self._run, name="punctuality", daemon=True)
        self._thread.start()

    def poll(self) -> None:
        """Record that the reader is awake."""
        now, before = time.monotonic(), self._looked
        self._looked = now
        if before is not None:
            self._late.append(max(0.0, now - before - PULSE))

    def stop(self) -> Sequence[float]:
        """End, and return the lateness of each waking [s]."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        return self._late

    def _run(self) -> None:
        while not self._stopping.is_set():
            wanted = time.monotonic() + PULSE
            time.sleep(PULSE)
            self._late.append(time.monotonic() - wanted)


@dataclass(frozen=True)
class TimingFigures:
    """Timing of a stretch of feedback.

    Attributes:
        records: Number received [-].
        rate: By the module's clock [Hz].
        jitter: Standard deviation of the period, by the module's clock [s].
        longest_gap: Between two records, by the module's clock [s].
        missing: Number of lost records [-].
        way_p99: Transport time beyond the shortest, 99th percentile [s].
        way_worst: The longest [s].
        host_p99: Lateness of this computer's wakings, 99th percentile [s].
        host_worst: The largest [s].
    """

    records: int
    rate: float
    jitter: float
    longest_gap: float
    missing: int
    way_p99: float
    way_worst: float
    host_p99: float
    host_worst: float

    @property
    def lost(self) -> float:
        """Share of lost records [-]."""
        return self.missing / (self.missing + self.records)


def measure(records: Sequence[Feedback], period: float, lateness: Sequence[float]) -> TimingFigures:
    """Return the timing of at least two records; ``lateness`` of wakings [s] is empty in simulated time."""
    measured = np.array([record.hardware_ns for record in records], dtype=np.int64)
    way = np.array([record.stamp_ns for record in records], dtype=np.int64) - measured
    gaps = np.diff(measured) / NANOSECONDS
    way = (way - way.min()) / NANOSECONDS
    missing = int(np.sum(np.maximum(0, np.rint(gaps[gaps > _LOST_GAP * period] / period) - 1)))
    span = float(gaps.sum())
    # Lost records must not count as jitter: use the intervals of neighbours only.
    whole = gaps[gaps <= _LOST_GAP * period]
    regular = whole if whole.size else gaps
    late = np.asarray(lateness if len(lateness) else [0.0])
    return TimingFigures(
        records=len(records),
        rate=(gaps.size + missing) / span if span > 0.0 else float("inf"),
        jitter=float(np.std(regular)),
        longest_gap=float(gaps.max()),
        missing=missing,
        way_p99=float(np.percentile(way, 99.0)),
        way_worst=float(way.max()),
        host_p99=float(np.percentile(late, 99.0)),
        host_worst=float(late.max()),
    )
