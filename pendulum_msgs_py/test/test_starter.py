"""The end of a starter interrupts what it started, once, and not what ends already."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from pendulum_msgs_py.programs import starter

_ENDED_BY_ITS_STARTER = """
import os, subprocess, sys
from pendulum_msgs_py.programs.starter import bound_environment
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], env=bound_environment(os.environ))
sys.stdin.readline()
"""
_STOPPING = """
import os, select, sys, time
from pendulum_msgs_py.programs.executables import keep_interrupts

def clean_up(starter):
    # Longer than the echo of a signal is forgiven.
    time.sleep(1.1)
    print("cleans up", flush=True)
    select.select([starter], [], [])
    time.sleep(0.3)
    print("cleaned up", flush=True)
"""
_COMMAND = (
    _STOPPING
    + """
starter = os.pidfd_open(os.getppid())
keep_interrupts()
try:
    print(os.getpid(), flush=True)
    time.sleep(60.0)
except KeyboardInterrupt:
    clean_up(starter)
"""
)
_NODE = (
    _STOPPING
    + """
import rclpy.node
from pendulum_msgs_py.ros.runner import run_node

class Node(rclpy.node.Node):
    def __init__(self, stop):
        super().__init__("slow")
        self.starter = os.pidfd_open(os.getppid())
        print(os.getpid(), flush=True)
    def close(self):
        clean_up(self.starter)

sys.exit(run_node(Node, [], program="slow node", description="Takes its time to end."))
"""
)


@pytest.fixture
def ended() -> Iterator[int]:
    """Return the process id of a starter that has ended and is not forgotten yet."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    yield process.pid
    process.wait()


@pytest.fixture
def kills(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return the signals that this process would have sent, a starter that ends waited for no longer than that."""
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "kill", lambda *each: sent.append(each))
    monkeypatch.setattr(starter, "_PATIENCE", 0.2)
    monkeypatch.setattr(starter, "stops", [])
    return sent


def test_the_end_of_a_starter_interrupts_and_kills_what_goes_on(ended: int, kills: list[tuple[int, int]]) -> None:
    began = time.monotonic()
    starter._watch(ended)
    # Time in which it may end by itself.
    assert time.monotonic() - began >= 0.2
    assert kills == [(os.getpid(), signal.SIGINT), (os.getpid(), signal.SIGKILL)]


def test_a_starter_that_had_ended_before_is_noticed_too(kills: list[tuple[int, int]]) -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    starter._watch(process.pid)
    assert kills == [(os.getpid(), signal.SIGINT), (os.getpid(), signal.SIGKILL)]


def test_what_ends_already_is_not_interrupted_again_and_killed_if_it_does_not_come_to_its_end(
    ended: int, kills: list[tuple[int, int]]
) -> None:
    starter.stops.append(signal.SIGTERM)
    starter._watch(ended)
    assert kills == [(os.getpid(), signal.SIGKILL)]


def test_nothing_is_sent_while_the_starter_lives(kills: list[tuple[int, int]]) -> None:
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    watch = threading.Thread(target=starter._watch, args=(process.pid,))
    watch.start()
    watch.join(0.2)
    assert watch.is_alive()
    assert kills == []
    process.communicate(b"\n")
    watch.join(30.0)
    assert [number for _, number in kills] == [signal.SIGINT, signal.SIGKILL]


def test_a_program_is_bound_to_the_process_that_started_it_and_not_to_that_ones_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watched: queue.Queue[int] = queue.Queue()
    monkeypatch.setattr(starter, "_watch", watched.put)
    bound = starter.bound_environment({"HOME": "/", "PENDULUM_STARTER": "1"})
    assert bound == {"HOME": "/", "PENDULUM_STARTER": str(os.getpid())}
    monkeypatch.setenv("PENDULUM_STARTER", bound["PENDULUM_STARTER"])
    starter.end_with_starter()
    assert watched.get(timeout=30.0) == os.getpid()
    assert "PENDULUM_STARTER" not in os.environ
    before = threading.active_count()
    starter.end_with_starter()
    assert threading.active_count() <= before
    assert watched.empty()


@pytest.mark.parametrize("program", [_COMMAND, _NODE], ids=["command", "node"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_program_that_cleans_up_is_not_cut_short_by_the_end_of_its_starter(program: str, number: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", _ENDED_BY_ITS_STARTER, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    child = int(process.stdout.readline())
    # A node takes signals once it is made.
    os.kill(child, number)
    assert process.stdout.readline() == "cleans up\n"
    process.stdin.close()
    assert process.wait(30.0) == 0
    assert process.stdout.read() == "cleaned up\n"
