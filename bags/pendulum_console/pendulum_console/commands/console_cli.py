"""``console``: serve a web page to watch, tune, arm and stop the plants of a ROS domain.

Loads what it needs at low priority, because the loops that it is to show may be running.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
from collections.abc import Sequence

from pendulum_msgs_py.programs.executables import report_missing

__all__ = ["main"]

_NICENESS = 10
_CONSOLE = "pendulum_console.console.console_node"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the console."""
    # Two seconds of imports delayed a loop at 500 Hz by 9 ms. The thread is niced, not the process: a later stop
    # must not wait behind other processes.
    loading = threading.Thread(target=_load)
    loading.start()
    loading.join()
    try:
        console = importlib.import_module(_CONSOLE)
    except ImportError as error:
        if code := report_missing(error):
            return code
        raise
    return int(console.main(list(argv) if argv is not None else None))


def _load() -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
    # What fails here fails again in the main thread, which reports it.
    with contextlib.suppress(Exception):
        importlib.import_module(_CONSOLE)
