"""A program ends with the process that started it, whatever ends that one."""

from __future__ import annotations

import os
import select
import signal
import threading
from collections.abc import Mapping

__all__ = ["bound_environment", "end_with_starter", "stops"]

stops: list[int] = []
"""Signals by which this process was asked to end; the end of its starter asks nothing more of one that ends already."""

_STARTER = "PENDULUM_STARTER"
"""Environment variable with the process id of the starter."""
_PATIENCE = 30.0
"""Time from the end of the starter until a program that still runs is killed [s].

Longer than an experiment takes to end its own programs, in two waves.
"""


def bound_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment in which a program of ours ends when this process does."""
    return {**environment, _STARTER: str(os.getpid())}


def end_with_starter() -> None:
    """Interrupt this process, as Ctrl-C does, once the process that started it has ended; kill it if that is no use.

    A descriptor of the starter is watched, not a pipe, which forked workers would keep open, nor the kernel's signal to
    children, which comes at the end of the starting thread and is lost before there is a handler.
    """
    # Removed, so that what this process starts in turn is bound to this process alone.
    if starter := os.environ.pop(_STARTER, ""):
        threading.Thread(target=_watch, args=(int(starter),), daemon=True).start()


def _watch(starter: int) -> None:
    try:
        descriptor = os.pidfd_open(starter)
    except ProcessLookupError:
        pass  # ended while this program was loading
    else:
        select.select([descriptor], [], [])
    # A second one would be a wish to leave at once, a recorder's last messages or an experiment's plants left behind.
    if not stops:
        os.kill(os.getpid(), signal.SIGINT)
    # Nothing arrives here: a pause that needs no clock.
    threading.Event().wait(_PATIENCE)
    os.kill(os.getpid(), signal.SIGKILL)
