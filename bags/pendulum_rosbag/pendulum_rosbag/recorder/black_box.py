"""The last messages in bounded memory, written when a plant faults or is stopped."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Sequence
from typing import Generic, TypeVar

from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["MAX_BYTES", "BlackBox"]

MAX_BYTES = 128 << 20
"""Memory for messages [bytes]; the oldest are dropped."""
_AFTER_NS = NANOSECONDS
"""Time to wait after a fault for the stop that it causes [ns]."""
_OLDEST_NS = 2 * NANOSECONDS
"""Age above which an event is a latched one from the past [ns]."""
_STOPS = {Mode.FAULT.value, Mode.E_STOP.value}

_Source = TypeVar("_Source")


class BlackBox(Generic[_Source]):
    """Messages of the last ``seconds`` from any sources, in at most ``max_bytes`` of memory."""

    def __init__(self, seconds: float, max_bytes: int = MAX_BYTES) -> None:
        self._length_ns = round(seconds * NANOSECONDS)
        self._max_bytes = max_bytes
        self._messages: deque[tuple[_Source, int, bytes]] = deque()
        self._bytes = 0
        self._due_ns: int | None = None
        self.reason = ""

    def keep(self, source: _Source, items: Sequence[tuple[int, bytes]]) -> None:
        """Store messages of a source: time of arrival [ns] and bytes."""
        for time_ns, data in items:
            self._messages.append((source, time_ns, data))
            self._bytes += len(data)
        while self._messages and self._bytes > self._max_bytes:
            self._bytes -= len(self._messages.popleft()[2])

    def poll(self, event: bytes, now_ns: int) -> None:
        """Record whether an event (CDR bytes of a ``std_msgs/String``) reports a fault or an e-stop."""
        try:
            said = json.loads(event[8:].rstrip(b"\0"))
            stops = said["name"] == Event.PLANT_MODE and said["mode"] in _STOPS
            recent = abs(now_ns - int(said["stamp_ns"])) <= _OLDEST_NS
        except (ValueError, KeyError, TypeError):
            return
        if stops and recent and self._due_ns is None:
            self._due_ns, self.reason = now_ns + _AFTER_NS, f"{said['mode']}: {said.get('reason', '')}"

    def is_due(self, now_ns: int) -> bool:
        """Drop messages that are too old; return whether the rest is to be written now."""
        oldest_ns = now_ns - self._length_ns
        while self._messages and self._messages[0][1] < oldest_ns:
            self._bytes -= len(self._messages.popleft()[2])
        return self._due_ns is not None and now_ns >= self._due_ns

    def empty(self) -> list[tuple[_Source, int, bytes]]:
        """Return the stored messages, in the order of their arrival, and clear them."""
        messages = sorted(self._messages, key=lambda message: message[1])
        self._messages.clear()
        self._bytes, self._due_ns = 0, None
        return messages
