"""Ctrl-C is not lost where Python drops what is raised: in destructors, callbacks of weak references and of C."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any

__all__ = ["keep_interrupts"]

_MOMENT = 0.01
"""Time after which it is raised again [s]: by then the destructor has most probably returned; if not, once more."""


def keep_interrupts() -> None:
    """Raise a KeyboardInterrupt again that Python would print as ignored, and go on."""
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
