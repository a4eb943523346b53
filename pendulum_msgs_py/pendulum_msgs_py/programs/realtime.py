"""Real-time priority, for programs that keep a plant's time on a computer that has other work too."""

from __future__ import annotations

import contextlib
import os
import resource
import threading
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError

__all__ = ["may_run_in_real_time", "run_in_real_time"]


def run_in_real_time(priority: int) -> None:
    """Run this process before every ordinary one: all its threads, and those that they will start (``SCHED_FIFO``).

    The middleware's threads too, since a torque that waits for them is as late as one that waits for Python.

    Args:
        priority: 1 to 99, a higher one goes first; 0 leaves everything as it is.

    Raises:
        ParameterError: This user may not have it, or this system knows no such priority.
    """
    if not priority:
        return
    if not hasattr(os, "sched_setscheduler"):
        raise ParameterError(f"realtime_priority is {priority}; this system has none: expected 0")
    promoted: set[int] = set()
    # A thread that was begun meanwhile by one whose turn had not come is an ordinary one.
    while waiting := {int(task.name) for task in Path("/proc/self/task").iterdir()} - promoted:
        for thread in waiting:
            _promote(thread, priority)
        promoted |= waiting


def may_run_in_real_time(priority: int) -> bool:
    """Return whether this user may have a real-time priority, 1 to 99."""
    allowed: list[bool] = []

    def try_it() -> None:
        with contextlib.suppress(PermissionError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            allowed.append(True)

    # By a thread that ends with it.
    trial = threading.Thread(target=try_it)
    trial.start()
    trial.join()
    return bool(allowed)


def _promote(thread: int, priority: int) -> None:
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except ProcessLookupError:  # it has ended
        pass
    except PermissionError as error:
        most, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        raise ParameterError(
            f"realtime_priority is {priority}; this user may have at most {most}: expected 0, or a line such as "
            f"'@realtime - rtprio {max(priority, 98)}' in /etc/security/limits.conf, and a new login of a member of "
            "that group"
        ) from error
