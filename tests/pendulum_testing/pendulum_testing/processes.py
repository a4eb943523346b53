"""Processes of a test: started like a user would, watched through their output, and never left behind."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping
from pathlib import Path

import psutil

from pendulum_bags.experiments.host_pool import HostedProgram, HostPool

__all__ = ["ProcessGroup", "RunningProgram"]

_MARK = "PENDULUM_TEST_PROCESSES"
"""Environment variable that every descendant inherits, also one that left its parent and its session."""


class RunningProgram:
    """One started program.

    Attributes:
        name: What it was started as.
        pid: Process id.
    """

    def __init__(self, name: str, popen: subprocess.Popen[bytes] | HostedProgram, log: Path) -> None:
        self.name = name
        self.pid = popen.pid
        self._popen = popen
        self._log = log

    @property
    def returncode(self) -> int | None:
        """Exit code, or None while it runs; minus the number of the signal that ended it."""
        return self._popen.poll()

    @property
    def output(self) -> str:
        """Everything printed so far, standard output and errors in the order they came."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def send_signal(self, number: int) -> None:
        """Send a signal to the program alone (not to what it started); nothing happens when it has ended."""
        self._popen.send_signal(number)

    def type(self, text: str) -> None:
        """Type into a program that was started with ``typed=True``."""
        assert isinstance(self._popen, subprocess.Popen)
        assert self._popen.stdin is not None, f"{self.name} was not started with typed=True"
        self._popen.stdin.write(text.encode())
        self._popen.stdin.flush()

    def interrupt(self) -> None:
        """Send what Ctrl-C in a terminal sends: SIGINT to all that runs in the program's process group."""
        _signal_group(self._popen, signal.SIGINT)

    def wait(self, timeout: float) -> int:
        """Wait for the end and return the exit code.

        Args:
            timeout: Longest time to wait [s].

        Raises:
            AssertionError: When it still runs after that; the message has the end of its output.
        """
        try:
            return self._popen.wait(timeout)
        except subprocess.TimeoutExpired:
            msg = f"{self.name} still runs after {timeout:g} s; it printed:\n{_tail(self.output)}"
            raise AssertionError(msg) from None

    def wait_for_output(self, pattern: str, timeout: float) -> re.Match[str]:
        """Wait until the output matches a regular expression, and return the first match.

        Args:
            pattern: Searched in the whole output, ``^`` and ``$`` at each line.
            timeout: Longest time to wait [s].

        Raises:
            AssertionError: When the time is over or the program ends first; the message has the end of its
                output.
        """
        deadline = time.monotonic() + timeout
        while True:
            ended = self.returncode is not None
            # Read after asking for the end, so that its last words count.
            if match := re.search(pattern, self.output, re.MULTILINE):
                return match
            if ended or time.monotonic() > deadline:
                why = f"ended with code {self.returncode}" if ended else f"ran for {timeout:g} s"
                msg = f"{self.name} {why} without printing {pattern!r}; it printed:\n{_tail(self.output)}"
                raise AssertionError(msg)
            time.sleep(0.02)


class ProcessGroup:
    """All programs of one test.

    Args:
        folder: Where their output is kept.
        cwd: Folder to start them in.
        hosts: Run programs in one of these processes where they can.

    Attributes:
        folder: The first argument.
    """

    def __init__(self, folder: Path, cwd: Path, hosts: HostPool | None = None) -> None:
        self.folder = folder
        self._cwd = cwd
        self._hosts = hosts
        self._mark = uuid.uuid4().hex
        self._programs: list[RunningProgram] = []
        self._popens: list[subprocess.Popen[bytes] | HostedProgram] = []

    def start(
        self,
        package: str,
        executable: str,
        *arguments: str | Path,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        typed: bool = False,
        niceness: int = 0,
        alone: bool = False,
    ) -> RunningProgram:
        """Start ``python -m package executable arguments``.

        It runs in a host where the group has some, unless it is to be alone or differs in more than its arguments.

        Args:
            package: Package, such as ``pendulum_sim``.
            executable: Its program, such as ``simulator``.
            arguments: What follows.
            env: Variables to add to the environment of this process.
            cwd: Folder to start in instead of the repository.
            typed: Whether the test types into it.
            niceness: Priority to give away, or to take where it is negative and permitted.
            alone: Start it as its user does: its start or its end is what is looked at.
        """
        command = [sys.executable, "-m", package, executable, *map(str, arguments)]
        name = f"{package} {executable}"
        if self._hosts is not None and not (alone or env or cwd or typed):
            log, environment = self._prepare(name, {})
            # A host takes what its output goes to when it begins.
            log.touch()
            hosted = self._hosts.start(command, environment=environment, log=log, niceness=niceness)
            if hosted is not None:
                return self._add(name, hosted, log)
        return self.start_command(command, name=name, env=env, cwd=cwd, typed=typed, niceness=niceness)

    def start_command(
        self,
        command: list[str],
        *,
        name: str | None = None,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        typed: bool = False,
        niceness: int = 0,
    ) -> RunningProgram:
        """Start any command in a process group of its own."""
        name = name or Path(command[0]).name
        log, environment = self._prepare(name, env or {})
        with log.open("wb") as sink:
            popen = subprocess.Popen(
                command,
                cwd=cwd or self._cwd,
                env=environment,
                stdin=subprocess.PIPE if typed else subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        # What runs behind others (the suite's computing part) stays there: among sessions it is theirs that counts.
        own = os.getpriority(os.PRIO_PROCESS, 0)
        if own or niceness:
            nice = own + niceness
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, popen.pid, nice)
                Path(f"/proc/{popen.pid}/autogroup").write_text(str(nice), encoding="ascii")
        return self._add(name, popen, log)

    def _prepare(self, name: str, env: Mapping[str, str]) -> tuple[Path, dict[str, str]]:
        """Return the file for a program's output, in its folder, and all of the program's variables."""
        self.folder.mkdir(parents=True, exist_ok=True)
        log = self.folder / f"{len(self._programs):02}_{re.sub(r'[^A-Za-z0-9]+', '_', name)}.log"
        return log, {**os.environ, "PYTHONUNBUFFERED": "1", **env, _MARK: self._mark}

    def _add(self, name: str, popen: subprocess.Popen[bytes] | HostedProgram, log: Path) -> RunningProgram:
        program = RunningProgram(name, popen, log)
        self._popens.append(popen)
        self._programs.append(program)
        return program

    def leftovers(self) -> list[psutil.Process]:
        """Return every living process that one of our programs started and that is not one of them."""
        ours = {program.pid for program in self._programs}
        return [other for other in psutil.process_iter() if other.pid not in ours and self._is_marked(other)]

    def close(self, patience: float = 30.0) -> list[str]:
        """End everything: SIGINT as a user would, then SIGKILL.

        Args:
            patience: Time that programs have to end by themselves after SIGINT [s].

        Returns:
            A sentence for each process that had to be killed, empty when all went well.
        """
        for popen in self._popens:
            if popen.poll() is None:
                _signal_group(popen, signal.SIGINT)
        deadline = time.monotonic() + patience
        complaints = []
        for program, popen in zip(self._programs, self._popens, strict=True):
            try:
                popen.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                complaints.append(f"{program.name} (pid {popen.pid}) ran {patience:g} s after SIGINT")
                _signal_group(popen, signal.SIGKILL)
                popen.wait()
        # What a program leaves behind may be about to end, and on a busy machine that takes a while.
        _, alive = psutil.wait_procs(self.leftovers(), timeout=5.0)
        for process in alive:
            complaints.append(f"pid {process.pid} outlived its starter: {_command_line(process)}")
            process.kill()
        return complaints

    def _is_marked(self, process: psutil.Process) -> bool:
        try:
            return process.status() != psutil.STATUS_ZOMBIE and process.environ().get(_MARK) == self._mark
        except psutil.Error:
            return False


def _signal_group(popen: subprocess.Popen[bytes] | HostedProgram, number: int) -> None:
    if isinstance(popen, HostedProgram):
        popen.send_signal(number)
        return
    try:
        os.killpg(popen.pid, number)
    except ProcessLookupError:
        return


def _command_line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return "(gone)"


def _tail(text: str, lines: int = 40) -> str:
    return "\n".join(text.splitlines()[-lines:]) or "(nothing)"
