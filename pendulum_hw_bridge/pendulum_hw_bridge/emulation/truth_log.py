"""The truth behind the feedback on file: what the motor did, whoever was told what."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from pendulum_hw_bridge.emulation.x5 import LinkState
from pendulum_msgs_py.errors import PendulumError

__all__ = ["COLUMNS", "TruthLog"]

COLUMNS = ("time_ns", "position", "velocity", "motor_torque", "pwm")
"""Fields of :class:`LinkState` that are kept [ns, rad, rad/s, N m, -]."""


class TruthLog:
    """A CSV file with a row for each millisecond of an emulated actuator; give :meth:`note` to its ``trace``.

    Each row is on the file system before the next, so that it is kept whatever ends the process.

    Args:
        path: File to write anew.

    Raises:
        PendulumError: It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("w", buffering=1, encoding="ascii")
            self._file.write(",".join(COLUMNS) + "\n")
        except OSError as error:
            raise PendulumError(f"truth of the emulator cannot be written to {path}: {error.strerror}") from error

    def __enter__(self) -> TruthLog:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self._file.close()

    def note(self, link: LinkState) -> None:
        """Write a row."""
        self._file.write(
            f"{link.time_ns},{link.position:.6g},{link.velocity:.5g},{link.motor_torque:.5g},{link.pwm:.5g}\n"
        )
