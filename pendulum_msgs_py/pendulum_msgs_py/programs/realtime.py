"""Real-time priority, for programs that keep a plant's time on a computer that has other work too.

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
    "priority_kept",
    "run_ahead",
    "run_in_real_time",
    "thread_numbers",
]

_TASKS = Path("/proc/self/task")
_AHEAD = 50
"""Real-time priority that is taken without being given: that of a plant in an experiment."""
NO_REALTIME = "PENDULUM_NO_REALTIME"
"""Variable of the environment with which no real-time priority is taken that is not given."""


def run_in_real_time(priority: int) -> None:
    """Give all threads of this process, and those that they will start, real-time priority (``SCHED_FIFO``).

    The calling thread gets one less than the others: equals do not preempt each other, and on a single core an e-stop's
    thread would wait for a busy loop to end.

    The middleware's threads too, since a torque that waits for them is late too. Start child
    processes :func:`as_ordinary`, else they inherit it. (``SCHED_RESET_ON_FORK`` would take it from new threads too.)

    Args:
        priority: 1 to 99, a higher one goes first; 0 changes nothing; -1 is 50 where this user may have it.

    Raises:
        ParameterError: This user may not have it, or this system has no such priority.
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
    """Return the kernel's numbers of this process's threads; empty where it has no list of them."""
    return {int(task.name) for task in _TASKS.iterdir()} if _is_known() else set()


def run_ahead(threads: Iterable[int]) -> None:
    """Run threads that hardly compute before every ordinary one, where this user may; else they stay as they are.

    Args:
        threads: The kernel's numbers of threads of this process.
    """
    for thread in () if os.environ.get(NO_REALTIME) or not _is_known() else threads:
        with contextlib.suppress(ParameterError):
            _promote(thread, _AHEAD)


def may_run_in_real_time(priority: int) -> bool:
    """Return whether this user may have a real-time priority, 1 to 99."""
    allowed: list[bool] = []

    def try_it() -> None:
        # No right, a C library or a kernel without it (musl: ENOSYS), a group of processes that gets no time for it.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            allowed.append(True)

    if _is_known():
        # By a thread that ends with it.
        trial = threading.Thread(target=try_it)
        trial.start()
        trial.join()
    return bool(allowed)


@contextlib.contextmanager
def as_ordinary() -> Iterator[None]:
    """Run this thread, and the processes that it starts, at normal priority meanwhile: for lengthy work.

    A thread that computes in real time for a second blocks all normal programs of its core until the kernel gives them
    50 ms, which a plant on that core then misses.
    """
    with priority_kept():
        if _is_known() and os.sched_getparam(0).sched_priority:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        yield


@contextlib.contextmanager
def priority_kept() -> Iterator[None]:
    """Restore this thread's scheduling on exit: the code that follows has not requested real time."""
    if not _is_known():
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if (os.sched_getscheduler(0), os.sched_getparam(0)) != before:
            # A process that has lost the right meanwhile continues without.
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, *before)


def _is_known() -> bool:
    """Return whether this system has such priorities, and lists a process's threads."""
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
