"""A button or joystick as e-stop: a press latches, and so does silence, because a cable may be cut."""

from __future__ import annotations

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["EStopInput"]


class EStopInput:
    """Decides whether a periodically published button allows operation. Used from two threads.

    Args:
        timeout: Silence that counts as a press [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        # One tuple, so that the other thread never combines state and time of different messages.
        self._heard: tuple[bool, int] | None = None
        self._publishers = 1

    def count(self, publishers: int) -> None:
        """Store the number of publishers: with two, one would hide the silence of the other."""
        self._publishers = publishers

    def hear(self, *, pressed: bool, now_ns: int) -> None:
        """Store a message and its time by a monotonic clock [ns]."""
        self._heard = pressed, now_ns

    def reason(self, now_ns: int) -> str:
        """Return why the plant must be stopped, or an empty string; same clock [ns]."""
        heard, publishers = self._heard, self._publishers
        if heard is None:
            return "e-stop button was never heard"
        pressed, heard_ns = heard
        if pressed:
            return "e-stop button is pressed"
        if publishers > 1:
            return f"{publishers} publish for the e-stop button; expected one, whose silence is detectable"
        silent = (now_ns - heard_ns) / NANOSECONDS
        return f"e-stop button is silent for {1e3 * silent:.0f} ms" if silent > self.timeout else ""
