"""Ctrl-C is not lost: where a shell says so, and in destructors and callbacks, where Python drops what is raised."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any

__all__ = ["keep_interrupts"]

_MOMENT = 0.01
"""Time after which it is raised again [s]: by then the destructor has most probably returned; if not, once more."""


def keep_interrupts() -> None:
    """Raise KeyboardInterrupt where this process was started deaf to it, and again where Python would drop it.

    Without job control, as in a script, a shell starts what it puts into the background with SIGINT ignored. Python
    leaves that as it is, and hands it on to all that it starts. An experiment would then go on, plants armed, whoever
    asks it to stop, and a child that is asked to end before it has a handler of its own would run on.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
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
