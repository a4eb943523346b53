"""Every request to end a program raises KeyboardInterrupt, and none is lost."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pendulum_msgs_py.programs.starter import end_with_starter, stops

__all__ = ["defer_interrupts", "keep_interrupts"]

_MOMENT = 0.01
"""Delay after which it is raised again, probably outside the destructor [s]; if not, once more."""


def keep_interrupts() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM, SIGHUP and the end of the starter, again where Python drops it.

    A closed terminal must not leave plants armed and bags open; ``nohup`` still protects a program from it. Without job
    control a shell starts background programs with SIGINT ignored, which Python keeps and its children inherit: their
    experiment could not be stopped.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if in_main:
        _interrupted.add(os.getpid())
        stops.clear()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            ignored = signal.SIG_IGN if number is signal.SIGINT else signal.SIG_DFL
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler, ignored):
                signal.signal(number, _interrupt)
        end_with_starter()
    before = sys.unraisablehook
    if getattr(before, "keeps_interrupts", False):
        return

    def hook(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            before(unraisable)
            return
        # Raised here it would be dropped too.
        again = threading.Timer(_MOMENT, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
        again.daemon = True
        again.start()

    hook.keeps_interrupts = True  # type: ignore[attr-defined]
    sys.unraisablehook = hook


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Handle requests to end after the block, so that what it starts is on record first.

    Signal masks do not do this: another thread would take the signal.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    handled = {number: handler for number, handler in handlers.items() if callable(handler)}
    came: list[tuple[int, FrameType | None]] = []
    for number in handled:
        signal.signal(number, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
    for arrived, frame in came:
        handled[signal.Signals(arrived)](arrived, frame)


_interrupted: set[int] = set()
"""This process; a forked worker dies of these signals as usual."""


def _interrupt(number: int, _frame: FrameType | None) -> None:
    stops.append(number)
    if number == signal.SIGINT or os.getpid() in _interrupted:
        raise KeyboardInterrupt
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
