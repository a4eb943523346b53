"""``make test``: whole systems in real time, then other tests in real time; behind them, all the while, what computes.

Tests of one file stay together, so that what a file prepares is prepared once. Named files or folders run as pytest is
told.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest

from pendulum_bags.experiments.session import NO_REALTIME
from pendulum_testing.fixtures import PROJECT

__all__ = ["Part", "exit_code", "main", "rooms", "run_parts"]

_EXPERIMENTS = (
    # First, in a process that is still small: its probe must not stand still, and collecting garbage takes time.
    "tests/faults/test_live_faults.py",
    "tests/acceptance/test_experiment.py",
    "tests/integration/test_plants_on_the_graph.py",
    "tests/integration/test_stopped_plants.py",
    "tests/integration/test_runs_in_real_time.py",
    "bags/pendulum_bags/test/test_loop_priority.py",
    "pendulum_msgs_py/test/test_realtime.py",
)
"""Whole systems in real time, longest first; each asks for most of a core and judges to milliseconds: of its priority
nothing runs beside it: a dozen programs that start before ordinary ones keep those waiting for seconds."""
_WAITS = (
    "tests/acceptance/test_console.py",
    "tests/integration/test_plant_interface.py",
    "tests/acceptance/test_first_day.py",
    "tests/acceptance/test_small_drives.py",
    "tests/integration/test_programs_end_with_their_starter.py",
    "pendulum_lqr/test/test_lqr_nodes.py",
    "pendulum_lqr/test/test_running_plant.py",
    "tests/faults/test_bridge_faults.py",
    "tests/faults/test_disk_faults.py",
    "tests/faults/test_network_faults.py",
    "tests/faults/test_system_faults.py",
    "tests/faults/test_live_machine.py",
    "tests/faults/test_ways_out.py",
    "tests/faults/test_press_times.py",
    "tests/faults/test_security_policy.py",
    "tests/integration",
)
"""Other tests with processes that keep a plant's time, longest first: they wait for most of it, two at a time."""
_SIMULATED_TIME = (
    "tests/integration/test_experiments.py",
    "tests/integration/test_several_joints.py",
)
"""Whole systems whose processes wait for each other and not for a clock: they compute."""
_COMPUTES = (
    *_SIMULATED_TIME,
    "tests/acceptance/test_readme.py",
    "tests/acceptance/test_docs.py",
    "tests",
    "bags/pendulum_rosbag/test",
    "pendulum_hw_bridge/test",
    "pendulum_sim/test/test_shown_mechanisms.py",
    "pendulum_sim/test/test_simulator_node.py",
    "bags/pendulum_bags/test/test_report_page.py",
    "bags/pendulum_bags/test/test_identification_intervals.py",
    "bags/pendulum_bags/test",
    "bags/pendulum_console/test",
    "bags/pendulum_learning/test",
    "bags/pendulum_course/test",
    "pendulum_lqr/test/test_plants_as_they_run.py",
    "pendulum_sim/test/test_mechanism_batch.py",
    "pendulum_sim/test/test_batch.py",
)
"""What comes first of all others: what waits for its own processes now and then, since the cores have enough to do only
as long as something keeps time beside it; and longest first, since a long file at the end would leave a core idle."""
_NOTHING_SELECTED = int(pytest.ExitCode.NO_TESTS_COLLECTED)
_NICE = 5
"""Priority of what computes: real time goes before it, and beside a busy machine it still gets a quarter of a core."""
_TELLS_EVERY = 20.0
"""Time between two lines of progress [s]."""
_LOOK_EVERY = 0.2
"""Time between two looks at the parts [s]."""
_YOUNG = 5.0
"""Age up to which a process that was started in a session of its own may not have begun it, on a busy machine [s]."""
_ENDED = re.compile(r"\[gw\d+\] \[ *(\d+)%\] ([A-Z]+) (.*\S)")
"""What xdist prints of each test: how far it is [%], the outcome, the name."""
_BAD = ("FAILED", "ERROR")
_PATIENCE = 20.0
"""Time to end after Ctrl-C [s]; then a part is killed."""


def main(arguments: Sequence[str]) -> int:
    """Run the suite and return pytest's exit code: the first that is not zero.

    Args:
        arguments: Pytest's own, such as ``-k name``.
    """
    # A shell starts what it puts into the background deaf to Ctrl-C, and so would be all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # A test that calls make must not hand on what this run was asked for; and hundreds of processes start faster from
    # modules that were compiled once.
    for name in ("MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS", "ARGS", "PYTHONDONTWRITEBYTECODE"):
        os.environ.pop(name, None)
    # Where colorama is installed, numba colours each of thousands of messages that a compilation makes for itself.
    os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = "1"
    if any((PROJECT / argument.split("::")[0]).exists() for argument in arguments):
        return subprocess.run([sys.executable, "-m", "pytest", *arguments], cwd=PROJECT, check=False).returncode
    # Who edits a loop would have programs compile it in the middle of tests that keep time.
    subprocess.run([sys.executable, "-m", "pendulum_msgs_py.loops.compile_loop"], cwd=PROJECT, check=False)
    systems, waits, others = rooms()
    return run_parts(
        [
            Part("whole systems", [*systems, *arguments], workers=1, realtime=True),
            Part("in real time", [*waits, *arguments], workers=2),
        ],
        [Part("computing", [*others, *arguments], workers=2, nice=_NICE)],
    )


def rooms() -> tuple[list[str], list[str], list[str]]:
    """Return the files of each part in the order to start them in: whole systems, what waits, and all others."""
    systems = _files(_EXPERIMENTS)
    waits = [name for name in _files(_WAITS) if name not in {*systems, *_SIMULATED_TIME}]
    packages = sorted(str(path) for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*/test"))
    others = [name for name in _files((*_COMPUTES, *packages)) if name not in {*systems, *waits}]
    return systems, waits, others


class Part:
    """Some files of tests, which one pytest runs with its workers.

    Args:
        name: Stands in the progress and above the part's output.
        arguments: Pytest's own.
        workers: How many files run at a time, but not more than there are cores.
        nice: Priority as of ``nice``; 0 is the usual one, more is less.
        realtime: Experiments may take real-time priority: whatever else keeps time meanwhile is kept from it.
    """

    def __init__(
        self, name: str, arguments: Sequence[str], *, workers: int, nice: int = 0, realtime: bool = False
    ) -> None:
        self._realtime = realtime
        self.name = name
        self.share = "0"
        self.outcomes = Counter[str]()
        self._arguments = arguments
        self._workers = min(workers, os.cpu_count() or 1)
        self._nice = nice
        self._looked_at: set[int] = set()
        self._begun: dict[int, float] = {}
        self._popen: subprocess.Popen[bytes] | None = None
        self._output = tempfile.NamedTemporaryFile()  # noqa: SIM115  (lives as long as the part)
        self._reader = Path(self._output.name).open(errors="replace", encoding="utf-8")  # noqa: SIM115
        self._rest = ""

    def start(self) -> None:
        """Start pytest, once, in a session of its own: Linux shares the cores among sessions first."""
        if self._popen is not None:
            return
        # Within a worker's test this is no worker.
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
        if not self._realtime:
            environment[NO_REALTIME] = "1"
        # One worker too has a process that waits for it, and tells if it crashes.
        command = [sys.executable, "-m", "pytest", "-v", "--color=no", "--durations=10", "-n", str(self._workers)]
        self._popen = subprocess.Popen(
            [*command, "--dist", "loadfile", "--no-loadscope-reorder", *self._arguments],
            cwd=PROJECT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        if self._nice:
            os.setpriority(os.PRIO_PGRP, self._popen.pid, self._nice)
            self.hold_back()

    @property
    def code(self) -> int | None:
        """Return pytest's exit code, None while it runs."""
        return None if self._popen is None else self._popen.poll()

    def hold_back(self) -> None:
        """Give the sessions of what its tests have started its own priority.

        Linux shares the cores among sessions first, whatever the priority of the processes in them is; and a program
        that is started in a session of its own has a whole share. Four of them beside a plant in real time let each
        fiftieth of its periods come a millisecond late.
        """
        if not self._nice or self._popen is None or self.code is not None:
            return
        every = set(psutil.pids())
        # A number that is free again may come back as another process.
        self._looked_at &= every
        self._begun = {pid: begun for pid, begun in self._begun.items() if pid in every}
        for pid in every - self._looked_at:
            # Refused to who asks often without being root: the next look asks again.
            with contextlib.suppress(OSError, psutil.Error):
                if pid not in self._begun and self._popen.pid != pid:
                    process = psutil.Process(pid)
                    if self._popen.pid not in {parent.pid for parent in process.parents()}:
                        self._looked_at.add(pid)
                        continue
                    self._begun[pid] = process.create_time()
                if os.getsid(pid) == pid:
                    group = Path(f"/proc/{pid}/autogroup")
                    # Who stepped further back by itself stays there; and whoever holds it further back may write at the
                    # same moment, and must not be the one who is overwritten for good.
                    if int(group.read_text(encoding="ascii").split()[-1]) < self._nice:
                        group.write_text(str(self._nice), encoding="ascii")
                        continue
                elif time.time() - self._begun[pid] < _YOUNG:
                    continue  # it may be about to begin a session
                self._looked_at.add(pid)

    def send(self, number: int) -> None:
        """Send a signal to all of its processes, as a terminal does on Ctrl-C; what tests started ends with them."""
        if self._popen is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._popen.pid, number)

    def wait(self, timeout: float) -> None:
        """Wait for its end, but no longer than a time [s]."""
        if self._popen is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._popen.wait(timeout)

    def follow(self) -> None:
        """Count what has ended, and name what has failed."""
        *lines, self._rest = (self._rest + self._reader.read()).split("\n")
        for self.share, outcome, test in (found.groups() for found in map(_ENDED.match, lines) if found):
            self.outcomes[outcome] += 1
            if outcome in _BAD:
                print(f"{outcome} {test} ({self.name}; why stands below at the end)", flush=True)

    def output(self) -> str:
        """Return what pytest has printed behind the last test."""
        text = Path(self._output.name).read_text(encoding="utf-8", errors="replace")
        return text[max((found.end() for found in _ENDED.finditer(text)), default=0) :].strip()


def run_parts(*lanes: Sequence[Part]) -> int:
    """Run the parts of a lane one after the other, and all lanes at once; return the first code that is not 0.

    How far they are is printed on the way, and at the end what each has printed.
    """
    begin = told = time.monotonic()
    parts = [part for lane in lanes for part in lane]
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    try:
        while any(part.code is None for part in parts):
            for lane in lanes:
                unfinished = [part for part in lane if part.code is None]
                if unfinished:
                    unfinished[0].start()
            for part in parts:
                part.hold_back()
                part.follow()
            time.sleep(_LOOK_EVERY)
            if time.monotonic() - told >= _TELLS_EVERY:
                told += _TELLS_EVERY
                print(f"{_clock(told - begin)}  {'; '.join(map(_progress, parts))}", flush=True)
    except KeyboardInterrupt:
        print("interrupted: ending what runs", flush=True)
        _end(parts)
        for part in parts:
            if part.outcomes.keys() & set(_BAD):
                print(part.output())
        return int(pytest.ExitCode.INTERRUPTED)
    for part in parts:
        part.follow()
        print(f"\n{f' {part.name} ':=^100}\n{part.output()}")
    print(f"{'; '.join(map(_progress, parts))}; took {_clock(time.monotonic() - begin)} min")
    return exit_code([part.code or 0 for part in parts])


def _end(parts: Sequence[Part]) -> None:
    for number in (signal.SIGINT, signal.SIGKILL):
        for part in parts:
            part.send(number)
        # Who asks again wants it at once.
        with contextlib.suppress(KeyboardInterrupt):
            for part in parts:
                part.wait(_PATIENCE)


def exit_code(codes: Sequence[int]) -> int:
    """Return the first code of the parts that is not 0; a name may be in one part only."""
    counted = [code for code in codes if code != _NOTHING_SELECTED] or [_NOTHING_SELECTED]
    return next((code for code in counted if code), 0)


def _progress(part: Part) -> str:
    told = [f"{part.outcomes[outcome]} {outcome}" for outcome in ("SKIPPED", *_BAD) if part.outcomes[outcome]]
    return ", ".join((f"{part.name} {part.share} %", *told))


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02}"


def _files(names: Sequence[str]) -> list[str]:
    """Return files of tests, each once, in this order; pytest would sort a folder's among those that it is told."""
    found = [path for name in names for path in (sorted((PROJECT / name).rglob("test_*.py")) or [PROJECT / name])]
    return list(dict.fromkeys(str(path.relative_to(PROJECT)) for path in found))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
