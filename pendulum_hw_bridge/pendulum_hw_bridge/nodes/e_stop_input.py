"""A button or a joystick as e-stop: what was pressed latches, and so does silence, for a cable may be cut."""

from __future__ import annotations

import threading

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["EStopInput"]


class EStopInput:
    """Says whether a button that has to be heard all the time lets the plant go on. Used from two threads.

    Args:
        timeout: Silence that counts as a press [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._lock = threading.Lock()
        self._pressed = False
        self._heard_ns: int | None = None
        self._publishers = 1

    def count(self, publishers: int) -> None:
        """Take note of how many publish on the topic: of two, one would hide that the other is silent."""
        with self._lock:
            self._publishers = publishers

    def hear(self, *, pressed: bool, now_ns: int) -> None:
        """Take note of a message.

        Args:
            pressed: What it says.
            now_ns: When it came, by a clock that does not jump [ns].
        """
        with self._lock:
            self._pressed, self._heard_ns = pressed, now_ns

    def reason(self, now_ns: int) -> str:
        """Return why the plant must be stopped, or an empty string.

        Args:
            now_ns: The same clock [ns].
        """
        with self._lock:
            if self._heard_ns is None:
                return "e-stop button was never heard"
            if self._pressed:
                return "e-stop button is pressed"
            if self._publishers > 1:
                return f"{self._publishers} publish for the e-stop button; expected one, whose silence can be told"
            silent = (now_ns - self._heard_ns) / NANOSECONDS
            return f"e-stop button is silent for {1e3 * silent:.0f} ms" if silent > self.timeout else ""
