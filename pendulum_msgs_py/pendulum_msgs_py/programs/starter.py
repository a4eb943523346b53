"""A program ends with the process that started it, even if that is killed."""

from __future__ import annotations

import os
import select
import signal
import threading
from collections.abc import Mapping

__all__ = ["bound_environment", "end_with_starter", "stops"]

stops: list[int] = []
"""Signals that asked this process to end; the end of its starter then adds none."""

_STARTER = "PENDULUM_STARTER"
"""Environment variable with the starter's process id."""
_PATIENCE = 30.0
"""Time from the starter's end until this program is killed [s]; an experiment ends its programs in two waves."""


def bound_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment for programs that end with this process."""
    return {**environment, _STARTER: str(os.getpid())}


def end_with_starter() -> None:
    """Interrupt this process once its starter has ended; kill it if it continues.

    A descriptor of the starter is watched: a pipe would be kept open by forked workers, and the kernel's signal to
    children comes at the end of the starting thread and may precede the handler.
    """
    # Removed, so that children are bound to this process alone.
    if starter := os.environ.pop(_STARTER, ""):
        threading.Thread(target=_watch, args=(int(starter),), daemon=True).start()


def _watch(starter: int) -> None:
    try:
        descriptor = os.pidfd_open(starter)
    except ProcessLookupError:
        pass  # ended while this program was loading
    else:
        select.select([descriptor], [], [])
    # A second signal would end the process at once, with a recorder's last messages or armed plants left behind.
    if not stops:
        os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait(_PATIENCE)
    os.kill(os.getpid(), signal.SIGKILL)
