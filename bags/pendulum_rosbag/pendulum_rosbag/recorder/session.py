"""A recording as a bounded queue and writing threads, so that message delivery never waits for the disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pendulum_msgs_py.errors import BagError
from pendulum_msgs_py.programs.executables import is_exhaustion
from pendulum_rosbag.storage import BagWriter, QosProfile
from pendulum_rosbag.storage.message_types import MessageType

__all__ = ["RecordingSession", "SessionReport", "TopicCount"]

MAX_QUEUE_BYTES = 256 << 20
SEAL_INTERVAL = 0.05
"""Time between two seals [s]: including polling and load, a kill costs about 0.1 s of messages."""
SYNC_INTERVAL = 5.0
"""Time between two syncs to disk [s]: what a power failure may cost."""

_COUNTS = "pendulum.recorder.counts"


@dataclass(slots=True)
class TopicCount:
    """Message counts of one topic.

    Attributes:
        received: Arrived at the recorder.
        refused: Rejected because the queue was full.
        missing: Lost before the recorder.
        written: Safe on disk.
        early: Published before the subscription was complete: a gap at the start, not a loss.
        before: Published before the recording of the topic began.
        repeated: Byte-identical repetitions in a recording by header times; the bag holds each once.
    """

    received: int = 0
    refused: int = 0
    missing: int = 0
    written: int = 0
    early: int = 0
    before: int = 0
    repeated: int = 0

    @property
    def lost(self) -> int:
        """Messages that were published to the recorder and are not in the bag."""
        return self.missing + self.received - self.written


@dataclass(slots=True)
class SessionReport:
    """Result of a recording."""

    path: Path
    topics: dict[str, TopicCount] = field(default_factory=dict)
    error: str = ""
    unrecorded: dict[str, str] = field(default_factory=dict)
    """What was requested and is not in the bag (topic or pattern), with the reason."""

    @property
    def failed(self) -> bool:
        """Whether the bag holds less than what was requested."""
        return bool(self.lost or self.error or self.unrecorded)

    @property
    def received(self) -> int:
        """Messages that arrived, over all topics."""
        return sum(count.received for count in self.topics.values())

    @property
    def written(self) -> int:
        """Messages in the bag, over all topics."""
        return sum(count.written for count in self.topics.values())

    @property
    def lost(self) -> int:
        """Messages that were published and are not in the bag, over all topics."""
        return sum(count.lost for count in self.topics.values())

    def sentence(self) -> str:
        """Return the report in one sentence."""
        text = f"{self.written} messages of {len(self.topics)} topics in {self.path}"
        if self.lost:
            worst = [f"{name} {count.lost}" for name, count in sorted(self.topics.items()) if count.lost]
            text += f"; LOST {self.lost} of {self.received + sum(c.missing for c in self.topics.values())}"
            text += f" ({', '.join(worst)})"
        elif not self.failed:
            text += ", nothing lost"
        if self.unrecorded:
            reasons = [f"{name} ({reason})" for name, reason in sorted(self.unrecorded.items())]
            text += f"; NOT recorded: {', '.join(reasons)}"
        if early := [f"{name} {count.early}" for name, count in sorted(self.topics.items()) if count.early]:
            text += f"; published before the subscription was complete, and not recorded: {', '.join(early)}"
        return text + (f"; stopped because {self.error}" if self.error else "")


class RecordingSession:
    """Writes offered messages to a bag in threads of its own.

    Args:
        writer: The bag; the session closes it.
        max_queue_bytes: Memory for waiting messages [bytes]; messages beyond it are refused and counted.
        seal_interval: Time between two seals [s].
        sync_interval: Time between two syncs to disk [s]; 0 for never.
        on_failure: Called once, from the writing thread, when the disk fails.
    """

    def __init__(
        self,
        writer: BagWriter,
        *,
        max_queue_bytes: int = MAX_QUEUE_BYTES,
        seal_interval: float = SEAL_INTERVAL,
        sync_interval: float = SYNC_INTERVAL,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        self.writer = writer
        self.failure = ""
        self._max_queue_bytes = max_queue_bytes
        self._seal_interval = seal_interval
        self._sync_interval = sync_interval
        self._on_failure = on_failure
        self._counts: dict[str, TopicCount] = {}
        self._reported_gaps: dict[str, dict[str, int]] = {}
        self._queue: list[tuple[str, int, bytes]] = []
        self._queued_bytes = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._syncer = threading.Thread(target=self._run_sync, name="bag sync", daemon=True)
        self._thread.start()
        self._syncer.start()

    def add_topic(self, name: str, type: MessageType, qos: Sequence[QosProfile]) -> None:
        """Announce a topic before its first message; a BagError if the bag holds it with another type."""
        if not self.failure:
            try:
                self.writer.add_topic(name, type, qos)
            except BagError:
                if not self.failure:  # else the writing thread closed the writer after a failure
                    raise
            except OSError as error:
                self.fail(error)
        # Also after a disk failure: lost messages are counted.
        self._counts.setdefault(name, TopicCount())

    def offer(self, topic: str, items: Sequence[tuple[int, bytes]]) -> int:
        """Queue (log time [ns], CDR bytes) of a topic; return how many were refused (queue full, or disk failed)."""
        count = self._counts[topic]
        count.received += len(items)
        if self.failure or self._closed:
            count.refused += len(items)
            return len(items)
        refused = 0
        with self._lock:
            for time_ns, data in items:
                if self._queued_bytes + len(data) > self._max_queue_bytes:
                    refused += 1
                    continue
                self._queued_bytes += len(data)
                self._queue.append((topic, time_ns, data))
        count.refused += refused
        return refused

    def update_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Add or replace entries of the bag's metadata, unless the disk has failed."""
        if self.failure:
            return
        try:
            self.writer.update_metadata(metadata)
        except OSError as error:
            self.fail(error)

    def note(self, topic: str, **numbers: int) -> None:
        """Count messages that are not in the bag, or are there already: ``missing``, ``early`` and so on."""
        count = self._counts[topic]
        for kind, number in numbers.items():
            setattr(count, kind, getattr(count, kind) + number)

    def counts(self) -> dict[str, TopicCount]:
        """Return the counts so far; ``written`` are safe on disk."""
        sealed = self.writer.sealed
        for name, count in self._counts.items():
            count.written = sealed.get(name, 0)
        return dict(self._counts)

    def close(self) -> SessionReport:
        """Write the queue, close the bag and report; repeated calls only report."""
        if not self._closed:
            self._closed = True
            self._stop.set()
            self._thread.join()
            self._syncer.join()
            if not self.failure:
                try:
                    self._write_queue()
                    self._store_counts()
                    self.writer.close()
                except Exception as error:  # noqa: BLE001  # the report must have any error
                    self.fail(error)
        return SessionReport(self.writer.path, self.counts(), self.failure)

    def _run(self) -> None:
        due = time.monotonic() + self._seal_interval
        while not self._stop.wait(max(due - time.monotonic(), 0.0)):
            due = max(due + self._seal_interval, time.monotonic())
            try:
                self._write_queue()
            except Exception as error:  # noqa: BLE001  # a silently dead thread would record nothing more
                self.fail(error)
                return

    def _run_sync(self) -> None:
        """Sync in a thread of its own: a slow disk must not delay the seals."""
        if not self._sync_interval:
            return
        while not self._stop.wait(self._sync_interval):
            try:
                self.writer.sync()
            except Exception as error:  # noqa: BLE001  # as above
                self.fail(error)
                return

    def _write_queue(self) -> None:
        with self._lock:
            items, self._queue = self._queue, []
            self._queued_bytes = 0
        if items:
            self.writer.write_many(items)
        self.writer.seal()
        gaps = {
            name: {"lost": count.missing + count.refused, "early": count.early, "before": count.before}
            for name, count in self._counts.copy().items()
            if count.missing or count.refused or count.early or count.before
        }
        if gaps != self._reported_gaps:
            self.writer.update_metadata({_COUNTS: gaps})
            self._reported_gaps = gaps

    def _store_counts(self) -> None:
        self.writer.seal()
        kinds = ("received", "written", "lost", "early", "before", "repeated")
        counts = {name: {kind: getattr(count, kind) for kind in kinds} for name, count in self.counts().items()}
        self.writer.update_metadata({_COUNTS: counts})

    def fail(self, error: Exception) -> None:
        """Close the bag, which frees unused disk space, and store the first failure's reason."""
        if self.failure:
            return
        self.failure = _reason(error)
        try:
            self.writer.close()
        except Exception:  # noqa: BLE001  # out of disk or memory: the file is complete as last sealed
            self.writer.abandon()
        if self._on_failure is not None:
            self._on_failure(self.failure)


def _reason(error: Exception) -> str:
    if is_exhaustion(error):
        return "memory is exhausted"
    if isinstance(error, OSError):
        return str(error.strerror or error).lower()
    return f"{type(error).__name__}: {error}"
