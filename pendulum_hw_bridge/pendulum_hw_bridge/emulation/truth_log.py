"""The truth behind the feedback on file: what the motor did, whoever was told what."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pendulum_hw_bridge.emulation.x5 import LinkState
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.whole_file import writing

__all__ = ["COLUMNS", "truth_log"]

COLUMNS = ("time_ns", "position", "velocity", "motor_torque", "pwm")
"""Fields of :class:`LinkState` that are kept [ns, rad, rad/s, N m, -]."""


@contextmanager
def truth_log(path: Path) -> Iterator[Callable[[LinkState], None]]:
    """Open a CSV file with a row for each millisecond of an emulated actuator; what it gives is for its ``trace``.

    Each row is on the file system before the next, so that it is kept whatever ends the process.

    Args:
        path: File to write anew.

    Raises:
        PendulumError: It cannot be written.
    """
    with writing(f"truth of the emulator {path}", PendulumError):
        file = path.open("w", buffering=1, encoding="ascii")
        file.write(",".join(COLUMNS) + "\n")

    def note(link: LinkState) -> None:
        file.write(f"{link.time_ns},{link.position:.6g},{link.velocity:.5g},{link.motor_torque:.5g},{link.pwm:.5g}\n")

    with file:
        yield note
