"""Real-time priority, for programs that run at a plant's rate on a computer with other work.

Memory is not locked: Python with its libraries maps 290 MB and uses 78.
"""

from __future__ import annotations

import contextlib
import os
import resource
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "NO_REALTIME",
    "as_ordinary",
    "may_run_in_real_time",
    "preserved_priority",
    "run_ahead",
    "run_in_real_time",
    "thread_numbers",
]

_TASKS = Path("/proc/self/task")
_AHEAD = 50
"""Default real-time priority: that of a plant in an experiment."""
NO_REALTIME = "PENDULUM_NO_REALTIME"
"""Environment variable that forbids a default real-time priority."""


def run_in_real_time(priority: int) -> None:
    """Give all threads of this process, present and future, real-time priority (``SCHED_FIFO``).

    The middleware's threads too, since a torque waits for them. The calling thread gets one less: equals do not preempt
    each other, and on a single core an e-stop's thread would wait for a busy loop. Start children :func:`as_ordinary`,
    else they inherit it (``SCHED_RESET_ON_FORK`` would take it from new threads too).

    Args:
        priority: 1 to 99, higher first; 0 changes nothing; -1 is 50 if this user may have it.

    Raises:
        ParameterError: The user or the system may not have it.
    """
    if priority < 0:
        priority = 0 if os.environ.get(NO_REALTIME) or not may_run_in_real_time(_AHEAD) else _AHEAD
    if not priority:
        return
    if not _is_known():
        raise ParameterError(f"realtime_priority is {priority}; this system has none: expected 0")
    promoted: set[int] = set()
    # A thread started meanwhile by one not yet promoted has normal priority.
    while waiting := thread_numbers() - promoted:
        for thread in waiting:
            _promote(thread, priority)
        promoted |= waiting
    _promote(threading.get_native_id(), max(1, priority - 1))


def thread_numbers() -> set[int]:
    """Return the kernel's numbers of this process's threads, empty if unknown."""
    return {int(task.name) for task in _TASKS.iterdir()} if _is_known() else set()


def run_ahead(threads: Iterable[int]) -> None:
    """Run threads (kernel numbers) that hardly compute before all ordinary ones, if this user may."""
    for thread in () if os.environ.get(NO_REALTIME) or not _is_known() else threads:
        with contextlib.suppress(ParameterError):
            _promote(thread, _AHEAD)


def may_run_in_real_time(priority: int) -> bool:
    """Return whether this user may have a real-time priority, 1 to 99."""
    allowed: list[bool] = []

    def try_it() -> None:
        # No permission, no support (musl: ENOSYS), or a cgroup without real-time budget.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            allowed.append(True)

    if _is_known():
        trial = threading.Thread(target=try_it)
        trial.start()
        trial.join()
    return bool(allowed)


@contextlib.contextmanager
def as_ordinary() -> Iterator[None]:
    """Run this thread and processes started by it at normal priority meanwhile, for lengthy work.

    A thread that computes in real time for a second blocks its core, and the kernel's 50 ms break then delays a plant
    there.
    """
    with preserved_priority():
        if _is_known() and os.sched_getparam(0).sched_priority:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        yield


@contextlib.contextmanager
def preserved_priority() -> Iterator[None]:
    """Restore this thread's scheduling on exit."""
    if not _is_known():
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if (os.sched_getscheduler(0), os.sched_getparam(0)) != before:
            # The permission may have been lost meanwhile.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, *before)


def _is_known() -> bool:
    return hasattr(os, "sched_setscheduler") and _TASKS.is_dir()


def _promote(thread: int, priority: int) -> None:
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
    except ProcessLookupError:  # it has ended
        pass
    except OSError as error:
        most, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        if not isinstance(error, PermissionError) or most == resource.RLIM_INFINITY or most >= priority:
            raise ParameterError(
                f"realtime_priority is {priority}; this system refuses it ({error.strerror}): expected 0, or a group "
                "of processes that gets time for it (cpu.rt_runtime_us of its cgroup)"
            ) from error
        raise ParameterError(
            f"realtime_priority is {priority}; this user may have at most {most}: expected {most}, or a line such as "
            f"'@realtime - rtprio {max(priority, 98)}' in /etc/security/limits.conf, and a new login of a member of "
            "that group"
        ) from error
