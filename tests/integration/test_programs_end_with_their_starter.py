"""Programs of the loop end with the process that started them, by whatever signal or death of it."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pendulum_rosbag.reader.bag import read_bag
from pendulum_testing.fixtures import wait_for
from pendulum_testing.processes import ProcessGroup

_PATIENCE = 60.0
"""[s]"""
_ENDS = {"SIGTERM": signal.SIGTERM, "SIGKILL": signal.SIGKILL, "closed terminal": None}
"""A closed terminal is a SIGHUP, and a crash ends a process as SIGKILL does; for Ctrl-C: test_experiment.py."""
_LIFTED = (
    "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
    "sys.argv[1] and os.open(sys.argv[1], os.O_RDWR); os.execv(sys.executable, [sys.executable, *sys.argv[2:]])"
)
"""Opens a terminal, if one is named, which becomes that of the session, then is the program named behind it.

It hears a hangup also under ``nohup``.
"""
_PROGRAM = """
import contextlib, os, subprocess, sys, threading, time
from pathlib import Path
from pendulum_console.console.jobs import Jobs
from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.processes import ProcessSet, start_recorder
from pendulum_bags.recordings.bridge_programs import run_bridge_program
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.executables import run_program
from pendulum_msgs_py.programs.starter import bound_environment

folder = Path(sys.argv[1])

def go_on():
    print("started", flush=True)
    while True:
        time.sleep(1.0)

def start_run(hosts):
    metadata = folder / "metadata.json"
    metadata.write_text("{}")
    with hosts as pool, ProcessSet(folder / "logs", {}, pool) as processes:
        processes.start_node(graph.simulator("/sim", start="top", rate_hz=100.0))
        processes.start_node(graph.controller("/sim", autoactivate=False))
        start_recorder(processes, folder / "bag", "/sim", metadata, "mcap")
        go_on()

def experiment():
    start_run(contextlib.nullcontext())

def program_hosts():
    start_run(HostPool())

def console():
    jobs = Jobs(folder)
    jobs.control("/sim", "lqr", "thesis")
    jobs.record()
    go_on()

def checklist():
    arguments = ("bridge", "--ros-args", "-r", "__ns:=/hw", "-p", "backend:=emulator")
    threading.Thread(target=run_bridge_program, args=arguments, kwargs={"timeout": 600.0}, daemon=True).start()
    go_on()

def start_simulator():
    command = [sys.executable, "-m", "pendulum_sim", "simulator"]
    with (folder / "simulator.log").open("wb") as log:
        subprocess.Popen(command, env=bound_environment(os.environ), stdout=log, stderr=log, start_new_session=True)

def launch_file_and_a_thread_that_ends():
    thread = threading.Thread(target=start_simulator)
    thread.start()
    thread.join()
    go_on()

def main(arguments):
    globals()[arguments[0]]()

sys.modules["starter"] = sys.modules["__main__"]
raise SystemExit(run_program("starter:main", sys.argv[2:]))
"""
_STARTERS = {
    "experiment": 3,
    "program_hosts": 3,
    "console": 2,
    "checklist": 1,
    "launch_file_and_a_thread_that_ends": 1,
}
"""How many programs each starts, by the functions with which the project's programs start theirs."""
_CASES = [*(("experiment", how) for how in _ENDS), *((starter, "SIGKILL") for starter in list(_STARTERS)[1:])]
"""What is started watches a descriptor of its starter: how that one ended is the same for all, tried with one."""


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """Open a terminal; yield the descriptor that keeps it open, and its path."""
    master, slave = pty.openpty()
    os.set_inheritable(slave, False)
    yield master, os.ttyname(slave)
    with contextlib.suppress(OSError):
        os.close(master)
    os.close(slave)


def _ready(folder: Path) -> int:
    logs = [path.read_text(encoding="utf-8", errors="replace") for path in folder.rglob("*.log")]
    return sum("ready" in text or "recording to" in text for text in logs)


@pytest.mark.parametrize(("starter", "how"), _CASES)
def test_what_was_started_ends_with_its_starter_where_it_survived_sigterm_and_a_closed_terminal(
    starter: str, how: str, domain_id: int, processes: ProcessGroup, tmp_path: Path, terminal: tuple[int, str]
) -> None:
    master, path = terminal
    code = tmp_path / "starter.py"
    code.write_text(_PROGRAM, encoding="utf-8")
    number = _ENDS[how]
    # A terminal ends all of its session with the first of them: by a signal it must be the starter's end alone.
    lifted = ["-c", _LIFTED, path if number is None else ""]
    program = processes.start_command([sys.executable, *lifted, str(code), str(tmp_path), starter], name="starter")
    program.wait_for_output("^started", _PATIENCE)
    # What the checklist prints is kept by its starter, but the log of ROS tells it too.
    wait_for(lambda: _ready(tmp_path) >= _STARTERS[starter], _PATIENCE, "the programs to be ready", period=0.1)
    wait_for(lambda: len(processes.leftovers()) >= _STARTERS[starter], _PATIENCE, "the programs", period=0.1)
    if number is None:
        os.close(master)
    else:
        program.send_signal(number)
    program.wait(_PATIENCE)
    wait_for(lambda: not processes.leftovers(), _PATIENCE, "the end of what it started", period=0.1)
    if _STARTERS[starter] == 3:
        # They ended as after Ctrl-C: the recorder has closed its bag.
        assert read_bag(tmp_path / "bag").damage == []
