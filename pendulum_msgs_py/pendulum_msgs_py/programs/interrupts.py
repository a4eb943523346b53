"""Every request to end a program interrupts it as Ctrl-C does, and none is lost."""

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
"""Time after which it is raised again [s]: by then the destructor has most probably returned; if not, once more."""


def keep_interrupts() -> None:
    """Raise KeyboardInterrupt on SIGINT, SIGTERM, SIGHUP and the end of the starter, again where Python drops it.

    A program that dies of a closed terminal leaves plants armed and bags open; one that ``nohup`` started ignores it.

    Without job control, as in a script, a shell starts what it puts into the background with SIGINT ignored. Python
    leaves that as it is, and passes it on to its children. An experiment would then run on, plants armed, whatever
    requests its end, and so would a child that is interrupted before it has a handler of its own.
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
        # Raised here it would be dropped, too: this runs within what drops it.
        again = threading.Timer(_MOMENT, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
        again.daemon = True
        again.start()

    hook.keeps_interrupts = True  # type: ignore[attr-defined]
    sys.unraisablehook = hook


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Handle requests to end after the block: what it starts is on record before anything is raised.

    Masks of signals do not do this, since another thread takes the signal then.
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
"""This process; a forked worker, which is another one, dies of these signals as usual."""


def _interrupt(number: int, _frame: FrameType | None) -> None:
    stops.append(number)
    if number == signal.SIGINT or os.getpid() in _interrupted:
        raise KeyboardInterrupt
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
