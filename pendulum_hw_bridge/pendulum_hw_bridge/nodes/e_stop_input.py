"""A button or a joystick as e-stop: what was pressed latches, and so does silence, for a cable may be cut."""

from __future__ import annotations

from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["EStopInput"]


class EStopInput:
    """Says whether a button that has to be heard all the time lets the plant go on. Used from two threads.

    Args:
        timeout: Silence that counts as a press [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        # One value, so that the other thread never reads what was pressed with the time of another message.
        self._heard: tuple[bool, int] | None = None
        self._publishers = 1

    def count(self, publishers: int) -> None:
        """Take note of how many publish on the topic: of two, one would hide that the other is silent."""
        self._publishers = publishers

    def hear(self, *, pressed: bool, now_ns: int) -> None:
        """Take note of a message.

        Args:
            pressed: What it says.
            now_ns: When it came, by a clock that does not jump [ns].
        """
        self._heard = pressed, now_ns

    def reason(self, now_ns: int) -> str:
        """Return why the plant must be stopped, or an empty string.

        Args:
            now_ns: The same clock [ns].
        """
        heard, publishers = self._heard, self._publishers
        if heard is None:
            return "e-stop button was never heard"
        pressed, heard_ns = heard
        if pressed:
            return "e-stop button is pressed"
        if publishers > 1:
            return f"{publishers} publish for the e-stop button; expected one, whose silence can be told"
        silent = (now_ns - heard_ns) / NANOSECONDS
        return f"e-stop button is silent for {1e3 * silent:.0f} ms" if silent > self.timeout else ""
