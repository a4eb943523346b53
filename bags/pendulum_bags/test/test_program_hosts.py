"""Programs of ours one after the other in one process: each as if it were alone, and nothing left for the next."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pendulum_bags.experiments.host_pool import HostedProgram, HostPool, open_pool, share_pool, shared_pool
from pendulum_bags.experiments.processes import ProcessSet
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.programs.realtime import may_run_in_real_time
from pendulum_testing.fixtures import wait_for

PROGRAMS = """
import ctypes, gc, os, signal, socket, sys, threading, time

def tell(argv):
    print("pid", os.getpid(), "word", os.environ.get("WORD"), *argv)
    print("in", os.getcwd())
    print("to the other stream", file=sys.stderr)
    return 3 if "three" in argv else 0

def fails(argv):
    raise RuntimeError("the plant has gone")

def leaves(argv):
    raise SystemExit({"text": "error: no such plant", "number": 7, "nothing": None}[argv[0]])

def waits(argv):
    try:
        print("waiting", flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        print("asked to end")
        return 0

def kills(argv):
    os.kill(os.getpid(), signal.SIGKILL)

def exits(argv):
    os._exit(int(argv[0]))

class Node:
    def __del__(self):
        print("the node has left the graph", flush=True)

def freezes(argv):
    node = Node()
    node.itself = node
    gc.collect()
    gc.freeze()
    return 0

def handles_signals(argv):
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach())
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    return 0

def leaves_middleware(argv):
    named = threading.Event()
    def receive():
        ctypes.CDLL(None).prctl(15, b"dds.udp.7400", 0, 0, 0)
        named.set()
        time.sleep(60)
    threading.Thread(target=receive, daemon=True).start()
    return 0 if named.wait(20) else 1

def starts_thread(argv):
    # It ends with the process, and no sooner.
    threading.Thread(target=threading.main_thread().join).start()
    return 0

def takes_priority(argv):
    print("found", os.sched_getscheduler(0), flush=True)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(7))
    if argv:
        raise RuntimeError("the plant has gone")
    return 0
"""
NAMES = (
    *("tell", "fails", "leaves", "waits", "kills", "exits"),
    *("freezes", "handles_signals", "leaves_middleware", "starts_thread", "takes_priority"),
)


@pytest.fixture
def pool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HostPool]:
    """Hosts that find a package of ours with programs for this test."""
    package = tmp_path / "path" / "pendulum_probe"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "programs.py").write_text(PROGRAMS)
    table = {name: f"pendulum_probe.programs:{name}" for name in NAMES}
    (package / "executables.py").write_text(f"EXECUTABLES = {table}")
    path = os.pathsep.join(filter(None, [str(package.parent), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("PYTHONPATH", path)
    with HostPool() as hosts:
        yield hosts


def _start(pool: HostPool, log: Path, name: str, *arguments: str, **more: str) -> HostedProgram:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", **more}
    command = [sys.executable, "-m", "pendulum_probe", name, *arguments]
    program = pool.start(command, environment=environment, log=log)
    assert program is not None
    return program


def test_two_programs_share_a_process_and_nothing_else(
    pool: HostPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = _start(pool, tmp_path / "first.log", "tell", "one", WORD="north")
    assert first.wait(30.0) == 0
    monkeypatch.chdir(tmp_path)
    second = _start(pool, tmp_path / "second.log", "tell", "three")
    assert second.wait(30.0) == 3
    assert first.pid == second.pid
    told = (tmp_path / "first.log").read_text()
    assert f"pid {first.pid} word north one\n" in told
    assert "to the other stream\n" in told
    assert f"in {tmp_path}\n" not in told
    # The variable of the first is gone, each has its own log, and runs where its starter is.
    assert f"in {tmp_path}\n" in (tmp_path / "second.log").read_text()
    assert f"pid {first.pid} word None three\n" in (tmp_path / "second.log").read_text()
    assert "to the other stream\n" in (tmp_path / "second.log").read_text()
    assert "three" not in told
    # One of another kind would find what theirs has left.
    other = _start(pool, tmp_path / "other.log", "leaves", "nothing")
    assert other.wait(30.0) == 0
    assert other.pid != first.pid


def test_two_that_run_at_once_have_a_process_each(pool: HostPool, tmp_path: Path) -> None:
    first = _start(pool, tmp_path / "first.log", "waits")
    second = _start(pool, tmp_path / "second.log", "waits")
    assert first.pid != second.pid
    assert first.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        first.wait(0.01)
    for one, log in ((first, "first.log"), (second, "second.log")):
        wait_for(lambda log=log: "waiting" in (tmp_path / log).read_text(), 30.0, "it to wait")  # type: ignore[misc]
        one.send_signal(signal.SIGINT)
        assert one.wait(30.0) == 0
    assert (tmp_path / "second.log").read_text().endswith("asked to end\n")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("fails",), 1, "RuntimeError: the plant has gone"),
        (("leaves", "text"), 1, "error: no such plant"),
        (("leaves", "number"), 7, ""),
        (("leaves", "nothing"), 0, ""),
    ],
)
def test_a_program_ends_with_the_code_and_the_words_that_it_would_have_alone(
    pool: HostPool, tmp_path: Path, arguments: tuple[str, ...], code: int, words: str
) -> None:
    ended = _start(pool, tmp_path / "log", *arguments)
    assert ended.wait(30.0) == code
    assert words in (tmp_path / "log").read_text()
    assert _start(pool, tmp_path / "log", *arguments).pid == ended.pid


@pytest.mark.parametrize(
    ("words", "code"),
    # Without a word, code 0 is no success.
    [(("kills",), -signal.SIGKILL), (("exits", "9"), 9), (("exits", "0"), 1)],
)
def test_a_program_that_takes_its_host_with_it_is_reported_and_the_next_has_another(
    pool: HostPool, tmp_path: Path, words: tuple[str, ...], code: int
) -> None:
    ended = _start(pool, tmp_path / "log", *words)
    assert ended.wait(30.0) == code
    ended.send_signal(signal.SIGINT)
    assert _start(pool, tmp_path / "log", *words).pid != ended.pid


def test_what_only_the_collector_destroys_is_gone_when_its_program_has_ended(pool: HostPool, tmp_path: Path) -> None:
    # A frozen node, as rclpy's lifecycle nodes are, would stay on the graph.
    for _ in range(2):
        assert _start(pool, tmp_path / "log", "freezes").wait(30.0) == 0
    assert (tmp_path / "log").read_text().count("the node has left the graph") == 2


@pytest.mark.skipif(not may_run_in_real_time(7), reason="this user may have no real-time priority")
@pytest.mark.parametrize("arguments", [(), ("fails",)])
def test_the_priority_that_a_program_took_is_not_that_of_the_next(
    pool: HostPool, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    first = _start(pool, tmp_path / "first.log", "takes_priority", *arguments)
    assert first.wait(30.0) == len(arguments)
    second = _start(pool, tmp_path / "second.log", "takes_priority")
    assert second.wait(30.0) == 0
    assert first.pid == second.pid
    assert (tmp_path / "second.log").read_text() == f"found {os.SCHED_OTHER}\n"


def test_a_host_that_waits_ends_by_sigterm_whatever_its_programs_did_with_it(pool: HostPool, tmp_path: Path) -> None:
    program = _start(pool, tmp_path / "log", "handles_signals")
    assert program.wait(30.0) == 0
    os.kill(program.pid, signal.SIGTERM)
    wait_for(lambda: not _runs(program.pid), 20.0, "the host to end")


def test_a_host_makes_place_for_another_after_many_programs(pool: HostPool, tmp_path: Path) -> None:
    hosts = []
    for _ in range(201):
        program = _start(pool, tmp_path / "log", "tell")
        assert program.wait(30.0) == 0
        hosts.append(program.pid)
    assert (len(set(hosts[:200])), len(set(hosts))) == (1, 2)


def test_a_program_asked_to_end_at_once_ends(pool: HostPool, tmp_path: Path) -> None:
    for _ in range(2):
        program = _start(pool, tmp_path / "log", "waits")
        program.send_signal(signal.SIGINT)
        assert program.wait(30.0) in {0, 130}


def test_a_signal_that_comes_when_a_program_has_ended_does_not_reach_the_next(pool: HostPool, tmp_path: Path) -> None:
    first = _start(pool, tmp_path / "log", "tell")
    # As it would be if it ended between a look and the signal that follows.
    assert first.wait(30.0) == 0
    os.kill(first.pid, signal.SIGINT)
    second = _start(pool, tmp_path / "second.log", "tell", "three")
    assert (second.pid, second.wait(30.0)) == (first.pid, 3)


@pytest.mark.parametrize("name", ["starts_thread", "leaves_middleware"])
def test_a_host_with_a_thread_left_behind_is_gone_when_its_program_has_ended(
    pool: HostPool, tmp_path: Path, name: str
) -> None:
    program = _start(pool, tmp_path / "log", name)
    assert program.wait(30.0) == 0
    assert not Path(f"/proc/{program.pid}").exists()
    assert _start(pool, tmp_path / "log", name).pid != program.pid


def test_a_host_that_was_ended_while_it_waited_is_replaced(pool: HostPool, tmp_path: Path) -> None:
    first = _start(pool, tmp_path / "log", "tell")
    assert first.wait(30.0) == 0
    os.kill(first.pid, signal.SIGKILL)
    wait_for(lambda: "Z" in Path(f"/proc/{first.pid}/stat").read_text().split(), 20.0, "the host to die")
    second = _start(pool, tmp_path / "log", "tell", "three")
    assert second.pid != first.pid
    assert second.wait(30.0) == 3


def test_leaving_a_pool_ends_hosts_that_wait_and_programs_that_run(pool: HostPool, tmp_path: Path) -> None:
    idle, busy = _start(pool, tmp_path / "idle.log", "tell"), _start(pool, tmp_path / "busy.log", "waits")
    assert idle.wait(30.0) == 0
    wait_for(lambda: "waiting" in (tmp_path / "busy.log").read_text(), 30.0, "the program to wait")
    pool.close()
    assert not any(Path(f"/proc/{one.pid}").exists() for one in (idle, busy))
    assert "asked to end" in (tmp_path / "busy.log").read_text()


def test_what_is_no_program_of_ours_gets_a_process_of_its_own(pool: HostPool, tmp_path: Path) -> None:
    for command in (["true"], [sys.executable, "-c", "pass"], [sys.executable, "-m", "pip", "list"]):
        assert pool.start(command, environment=os.environ, log=tmp_path / "log") is None
    with ProcessSet(tmp_path / "logs", {}, pool) as processes:
        child = processes.start("foreign", [sys.executable, "-c", "print('mine')"], ends_by_itself=True)
        processes.wait(child, 30.0)
        assert isinstance(child.process, subprocess.Popen)
        alone = processes.start(
            "alone", [sys.executable, "-m", "pendulum_probe.programs", "tell"], ends_by_itself=True, alone=True
        )
        assert isinstance(alone.process, subprocess.Popen)
        hosted = processes.start("hosted", [sys.executable, "-m", "pendulum_probe", "fails"])
        hosted.process.wait(30.0)
        with pytest.raises(FaultError, match=r"hosted ended with code 1; its last output: .*the plant has gone"):
            processes.check()
    assert child.log.read_text() == "mine\n"


def test_a_program_uses_the_hosts_that_outlive_it_or_ends_its_own(pool: HostPool, tmp_path: Path) -> None:
    with share_pool(pool):
        with open_pool() as kept:
            assert kept is pool
        program = _start(pool, tmp_path / "log", "tell")
        assert program.wait(30.0) == 0
        assert _runs(program.pid)
    with open_pool() as own:
        assert own is not pool
        program = _start(own, tmp_path / "log", "tell")
        assert program.wait(30.0) == 0
    assert not _runs(program.pid)


def test_hosts_end_with_the_program_that_started_them(pool: HostPool, tmp_path: Path) -> None:
    script = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from pendulum_bags.experiments.host_pool import HostPool\n"
        "started = []\n"
        "pool = HostPool()\n"
        "for name in ('tell', 'waits'):\n"
        "    command = [sys.executable, '-m', 'pendulum_probe', name]\n"
        f"    log = Path({str(tmp_path)!r}, name)\n"
        "    started.append(pool.start(command, environment={**os.environ, 'PYTHONUNBUFFERED': '1'}, log=log))\n"
        "started[0].wait(30.0)\n"
        "while 'waiting' not in log.read_text():\n"
        "    time.sleep(0.01)\n"
        "print(*(one.pid for one in started), flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        hosts = [int(word) for word in parent.stdout.readline().split()]
        assert len(hosts) == 2
        parent.kill()
    for host in hosts:
        wait_for(lambda host=host: not _runs(host), 20.0, "the host to end")  # type: ignore[misc]
    assert "asked to end" in (tmp_path / "waits").read_text()


def _runs(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False


def test_a_host_is_no_program_for_a_person() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_bags.experiments.program_host"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert "expected the number of a socket" in done.stderr
    assert shared_pool() is None
