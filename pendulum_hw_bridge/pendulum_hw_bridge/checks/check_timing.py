"""How regularly an actuator's feedback comes, and whom to blame where it does not: the actuator or this computer.

Each record bears two times: the module's own, when it was measured, and ours, when it arrived. The module's times say
whether the module is regular and what was lost; ours, less theirs, how long the way took; and a pulse of our own, which
asks to be woken every 2 ms, whether this computer could have noticed at all. So does whoever reads: a thread that has
worked waits longer for its turn than one that slept, and what it misses looks like a module's gap.
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
"""Time for which a pulse sleeps, and a reader waits for a record, at most [s]."""
_LOST_GAP = 1.5
"""Distance of two records from which on one is missing between them, in periods [-]."""


class Punctuality(Protocol):
    """Measures how late this computer wakes who asked for it."""

    def start(self) -> None:
        """Begin."""

    def poll(self) -> None:
        """Note that whoever reads is awake, which asked to be by the end of a pulse after it was last."""

    def stop(self) -> Sequence[float]:
        """End, and return how late each waking was [s]."""


class HostWatch:
    """A thread that asks to be woken every 2 ms, and notes how late it was; so it does for whoever reads."""

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
        """Note that whoever reads is awake."""
        now, before = time.monotonic(), self._looked
        self._looked = now
        if before is not None:
            self._late.append(max(0.0, now - before - PULSE))

    def stop(self) -> Sequence[float]:
        """End, and return how late each waking was [s]."""
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
    """Figures of one stretch of feedback.

    Attributes:
        records: How many came [-].
        rate: By the module's clock [Hz].
        jitter: Standard deviation of the period, by the module's clock [s].
        longest_gap: Between two records, by the module's clock [s].
        missing: How many never came [-].
        way_p99: Time on the way beyond that of the fastest, 99th percentile [s].
        way_worst: The longest [s].
        host_p99: How late this computer wakes, 99th percentile [s].
        host_worst: The latest [s].
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
        """Share of records that never came [-]."""
        return self.missing / (self.missing + self.records)


def measure(records: Sequence[Feedback], period: float, lateness: Sequence[float]) -> TimingFigures:
    """Return the figures of a stretch of feedback.

    Args:
        records: At least two, in their order.
        period: Nominal period [s].
        lateness: How late this computer woke in the meantime [s]; empty where time is simulated.
    """
    measured = np.array([record.hardware_ns for record in records], dtype=np.int64)
    way = np.array([record.stamp_ns for record in records], dtype=np.int64) - measured
    gaps = np.diff(measured) / NANOSECONDS
    way = (way - way.min()) / NANOSECONDS
    missing = int(np.sum(np.maximum(0, np.rint(gaps[gaps > _LOST_GAP * period] / period) - 1)))
    span = float(gaps.sum())
    # What got lost does not make the module slow: its period is that of the neighbours that both came.
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
