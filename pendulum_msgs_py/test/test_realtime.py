"""Real-time priority, on real threads of a real process."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import os
import resource
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs import realtime
from pendulum_msgs_py.programs.realtime import (
    as_ordinary,
    may_run_in_real_time,
    preserved_priority,
    run_ahead,
    run_in_real_time,
)

_ASK = """
import json, os, sys, threading
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.realtime import run_in_real_time

done = threading.Event()
before = threading.Thread(target=done.wait)
before.start()
try:
    run_in_real_time(int(sys.argv[1]))
except ParameterError as error:
    done.set()
    sys.exit(str(error))
after = threading.Thread(target=done.wait)
after.start()
threads = [int(name) for name in os.listdir("/proc/self/task")]
print(json.dumps([[os.sched_getscheduler(one), os.sched_getparam(one).sched_priority] for one in threads]))
done.set()
"""
_BUSY = """
import os, threading, time
from pendulum_msgs_py.programs.realtime import run_in_real_time

os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
late = 0.0
begun, done = threading.Event(), threading.Event()

def press():
    global late
    begun.wait()
    while not done.is_set():
        due = time.monotonic() + 0.01
        time.sleep(0.01)
        late = max(late, time.monotonic() - due)

e_stop = threading.Thread(target=press)
e_stop.start()
run_in_real_time(7)
begun.set()
time.sleep(0.05)
end = time.monotonic() + 0.5
while time.monotonic() < end:
    pass
done.set()
e_stop.join()
print(late)
"""
_AS_ORDINARY = """
import json, os, subprocess, sys, threading
from pendulum_msgs_py.programs import realtime
from pendulum_msgs_py.programs.realtime import as_ordinary, run_in_real_time

def tell():
    told = [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority]
    child = "import os; print(os.sched_getscheduler(0))"
    return [*told, int(subprocess.run([sys.executable, "-c", child], capture_output=True, check=True).stdout)]

done = threading.Event()
other = threading.Thread(target=done.wait)
other.start()
run_in_real_time(7)
told = [tell()]
try:
    with as_ordinary():
        told += [tell(), [os.sched_getscheduler(other.native_id)]]
        raise ValueError
except ValueError:
    pass
print(json.dumps([*told, tell()]))
done.set()
"""
_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23


def _ask(priority: int, *, allowed: bool = True) -> subprocess.CompletedProcess[str]:
    def forbid() -> None:
        ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))

    return subprocess.run(
        [sys.executable, "-c", _ASK, str(priority)],
        capture_output=True, text=True, timeout=60, check=False, preexec_fn=None if allowed else forbid,
    )  # fmt: skip


def may_have(priority: int) -> bool:
    """Tell whether this user may have a real-time priority."""
    with contextlib.suppress(OSError):
        probe = subprocess.run(["chrt", "-f", str(priority), "true"], capture_output=True, check=False)
        return probe.returncode == 0
    return False


@pytest.mark.skipif(not may_have(7), reason="this user may have no real-time priority")
def test_all_threads_of_the_process_have_it_and_those_that_come_later() -> None:
    done = _ask(7)
    # The loop, the thread that was there, and the one that the loop has begun since.
    assert json.loads(done.stdout) == [[os.SCHED_FIFO, priority] for priority in (6, 7, 6)], done.stderr


@pytest.mark.skipif(not may_have(7), reason="this user may have no real-time priority")
def test_the_lowest_priority_is_that_of_all_threads() -> None:
    done = _ask(1)
    assert json.loads(done.stdout) == [[os.SCHED_FIFO, 1]] * 3, done.stderr


@pytest.mark.skipif(not may_have(7), reason="this user may have no real-time priority")
def test_a_busy_loop_keeps_no_other_thread_of_its_process_waiting_on_a_single_core() -> None:
    done = subprocess.run([sys.executable, "-c", _BUSY], capture_output=True, text=True, timeout=60, check=True)
    # It computes for half a second.
    assert float(done.stdout) < 0.25


def test_zero_leaves_everything_as_it_is() -> None:
    done = _ask(0, allowed=False)
    assert json.loads(done.stdout) == [[os.SCHED_OTHER, 0]] * 3, done.stderr


def test_who_may_not_have_it_is_shown_how_to_get_it() -> None:
    done = _ask(60, allowed=False)
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "realtime_priority is 60; this user may have at most 0: expected 0, or a line such as "
        "'@realtime - rtprio 98' in /etc/security/limits.conf, and a new login of a member of that group"
    )


@pytest.mark.skipif(not may_have(7), reason="this user may have no real-time priority")
def test_work_that_takes_its_time_is_ordinary_meanwhile_and_so_is_what_it_starts() -> None:
    done = subprocess.run([sys.executable, "-c", _AS_ORDINARY], capture_output=True, text=True, timeout=60, check=True)
    before, meanwhile, other_thread, after = json.loads(done.stdout)
    assert before == after == [os.SCHED_FIFO, 6, os.SCHED_FIFO]
    assert meanwhile == [os.SCHED_OTHER, 0, os.SCHED_OTHER]
    # The middleware still takes and sends what it has to.
    assert other_thread == [os.SCHED_FIFO]


def _refuse(number: int) -> object:
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EINVAL, errno.EPERM])
def test_a_system_that_refuses_it_to_all_is_distinguished_from_a_right_that_is_missing(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """As musl does (ENOSYS), a sandbox (EINVAL), or a group of processes without time for it (EPERM)."""
    failed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", failed.append)
    monkeypatch.setattr(os, "sched_setscheduler", _refuse(number))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (98, 98))
    assert not may_run_in_real_time(50)
    assert not failed
    with pytest.raises(ParameterError, match=r"this system refuses it \(.+\): expected 0, or a group of processes"):
        run_in_real_time(50)


@pytest.mark.parametrize(
    ("limit", "sentence"),
    [(49, "may have at most 49: expected 49, or a line"), (50, "system refuses it"), (-1, "system refuses it")],
)
def test_the_limit_of_a_user_is_named_where_it_is_the_reason(
    monkeypatch: pytest.MonkeyPatch, limit: int, sentence: str
) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", _refuse(errno.EPERM))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    with pytest.raises(ParameterError, match=sentence):
        run_in_real_time(50)


def test_a_system_without_such_priorities_says_so_and_does_without(monkeypatch: pytest.MonkeyPatch) -> None:
    """As macOS does."""
    for name in ("sched_setscheduler", "sched_getscheduler", "sched_getparam"):
        monkeypatch.delattr(os, name)
    assert not may_run_in_real_time(50)
    with pytest.raises(ParameterError, match="realtime_priority is 50; this system has none: expected 0"):
        run_in_real_time(50)
    with as_ordinary(), preserved_priority():
        pass


@pytest.mark.skipif(not may_have(7), reason="this user may have no real-time priority")
def test_who_has_lost_the_right_meanwhile_goes_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    def work() -> None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))
        with as_ordinary():
            monkeypatch.setattr(os, "sched_setscheduler", _refuse(errno.EPERM))
        told.append(os.sched_getscheduler(0))

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert told == [os.SCHED_OTHER]


def test_threads_that_begin_or_end_meanwhile_are_no_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    promoted: list[int] = []
    done = threading.Event()
    late = threading.Thread(target=done.wait, daemon=True)

    def promote(thread: int, *_: object) -> None:
        if not promoted:
            late.start()
        promoted.append(thread)
        if thread == late.native_id:
            raise ProcessLookupError

    monkeypatch.setattr(os, "sched_setscheduler", promote)
    run_in_real_time(7)
    done.set()
    late.join()
    assert late.native_id in promoted


def test_a_system_that_does_not_tell_its_threads_has_no_real_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As FreeBSD does, or a container without /proc."""
    monkeypatch.setattr(realtime, "_TASKS", tmp_path / "task")
    assert not may_run_in_real_time(50)
    with pytest.raises(ParameterError, match="this system has none"):
        run_in_real_time(50)


def test_who_asks_whether_it_may_and_who_is_ordinary_stay_as_they_are() -> None:
    told: list[int] = []

    def work() -> None:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        may_run_in_real_time(7)
        told.append(os.sched_getscheduler(0))
        with as_ordinary():
            told.append(os.sched_getscheduler(0))

    worker = threading.Thread(target=work)
    worker.start()
    worker.join()
    assert told == [os.SCHED_BATCH] * 2


def test_threads_run_ahead_where_this_user_may_and_the_others_of_them_do_not_wait_for_one_that_may_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    promoted: list[tuple[int, int, int]] = []

    def promote(thread: int, policy: int, param: os.sched_param) -> None:
        if thread == 2:
            raise OSError(errno.EPERM, os.strerror(errno.EPERM))
        promoted.append((thread, policy, param.sched_priority))

    monkeypatch.delenv(realtime.NO_REALTIME, raising=False)
    monkeypatch.setattr(os, "sched_setscheduler", promote)
    run_ahead([1, 2, 3])
    assert promoted == [(1, os.SCHED_FIFO, 50), (3, os.SCHED_FIFO, 50)]
    promoted.clear()
    monkeypatch.setenv(realtime.NO_REALTIME, "1")
    run_ahead([1, 2, 3])
    assert promoted == []


def test_no_thread_runs_ahead_on_a_system_without_such_priorities(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(realtime.NO_REALTIME, raising=False)
    monkeypatch.delattr(os, "sched_setscheduler")
    run_ahead([threading.get_native_id()])
