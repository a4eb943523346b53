"""A watchdog that ends a process whose libraries hang, without the interpreter or its lock."""

from __future__ import annotations

import atexit
import faulthandler
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

__all__ = ["guard_exit", "hang_guard"]

_LONGEST = 15.0
"""Timeout, also on a busy computer [s]."""
_STANDARD_ERROR = 2
"""Its descriptor: ``sys.stderr`` may have none, as in a notebook."""
_lock = threading.Lock()
_under_way = 0


@contextmanager
def hang_guard() -> Iterator[None]:
    """End the process with exit code 1 and print its stacks if this context takes more than 15 s.

    No signal does that while a library holds the GIL. Make the plant safe and write files first.
    """
    global _under_way  # noqa: PLW0603  # the watchdog is one for the process
    _watch()
    try:
        yield
    finally:
        with _lock:
            _under_way -= 1
            if not _under_way:
                faulthandler.cancel_dump_traceback_later()


@cache
def guard_exit() -> None:
    """Guard the interpreter's exit against the libraries imported so far."""
    # Registered last, called first.
    atexit.register(_watch)


def _watch() -> None:
    global _under_way  # noqa: PLW0603
    with _lock:
        _under_way += 1
        faulthandler.dump_traceback_later(_LONGEST, exit=True, file=_STANDARD_ERROR)
