"""Real-time priority, on real threads of a real process."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import subprocess
import sys

import pytest

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
    assert json.loads(done.stdout) == [[os.SCHED_FIFO, 7]] * 3, done.stderr


def test_zero_leaves_everything_as_it_is() -> None:
    done = _ask(0, allowed=False)
    assert json.loads(done.stdout) == [[os.SCHED_OTHER, 0]] * 3, done.stderr


def test_who_may_not_have_it_is_told_how_to_get_it() -> None:
    done = _ask(60, allowed=False)
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "realtime_priority is 60; this user may have at most 0: expected 0, or a line such as "
        "'@realtime - rtprio 98' in /etc/security/limits.conf, and a new login of a member of that group"
    )
