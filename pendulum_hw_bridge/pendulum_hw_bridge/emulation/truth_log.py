"""True motion and torque of the emulated actuator, written to a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pendulum_hw_bridge.emulation.x5 import LinkState
from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import PendulumError

__all__ = ["COLUMNS", "truth_log"]

COLUMNS = ("time_ns", "position", "velocity", "motor_torque", "pwm")
"""Logged fields of :class:`LinkState` [ns, rad, rad/s, N m, -]."""


@contextmanager
def truth_log(path: Path) -> Iterator[Callable[[LinkState], None]]:
    """Open a new CSV file with a row per millisecond; yields a function for the actuator's ``trace``.

    Each row is flushed before the next, so that it survives any end of the process.

    Raises:
        PendulumError: The file cannot be written.
    """
    with writing(f"truth of the emulator {path}", PendulumError):
        file = path.open("w", buffering=1, encoding="ascii")
        file.write(",".join(COLUMNS) + "\n")

    def note(link: LinkState) -> None:
        file.write(f"{link.time_ns},{link.position:.6g},{link.velocity:.5g},{link.motor_torque:.5g},{link.pwm:.5g}\n")

    with file:
        yield note
