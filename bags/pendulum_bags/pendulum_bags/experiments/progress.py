"""Progress of a run in the terminal: a bar over all phases, and the present one."""

from __future__ import annotations

import threading
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["PhaseProgress"]

_SILENCE = 4.0
"""Time between two lines of a phase if the output is no terminal [s]."""
_TICK = 0.25
"""Time between two moves of the bar [s]."""


class PhaseProgress:
    """A bar that moves with time through phases of ``total`` length [s], or lines if the output is no terminal."""

    def __init__(self, total: float, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("{task.description:<22}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total)
        self._done = 0.0
        self._length = 0.0
        self._name = ""
        self._started = self._printed = time.monotonic()
        self._ended = threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self) -> PhaseProgress:
        """Show the bar."""
        self._bar.start()
        self._ticker.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the bar."""
        self._ended.set()
        self._ticker.join()
        self._bar.stop()

    def phase(self, name: str, expected: float) -> None:
        """Begin a phase of an expected length [s]; the one before counts as done."""
        self._done += self._length
        self._name, self._length = name, expected
        self._started = self._printed = time.monotonic()
        self._bar.update(self._task, description=name, completed=self._done)
        if not self._console.is_terminal:
            self._console.print(f"{name} ({expected:.0f} s)", highlight=False)

    def _tick(self) -> None:
        while not self._ended.wait(_TICK):
            elapsed = time.monotonic() - self._started
            self._bar.update(self._task, completed=self._done + min(elapsed, self._length))
            if self._name and not self._console.is_terminal and time.monotonic() - self._printed > _SILENCE:
                self._console.print(f"  {self._name}: {elapsed:.0f} of {self._length:.0f} s", highlight=False)
                self._printed = time.monotonic()

    def start_again(self, why: str) -> None:
        """Restart, and print the reason."""
        self._console.print(why, style="yellow", highlight=False, markup=False, soft_wrap=True)
        self._done = self._length = 0.0
        self._bar.reset(self._task)
