"""Child processes that never outlive the experiment."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from pendulum_bags.experiments.bound_process import start_bound_process
from pendulum_bags.experiments.host_pool import HostedProgram, HostPool
from pendulum_msgs_py.contract.plant_specs import REALTIME_PRIORITY
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.programs.interrupts import defer_interrupts

__all__ = ["Child", "ProcessSet", "ros_environment", "start_recorder"]

_RECORDER_NICENESS = -5
"""Priority of a recorder, if permitted: below the nodes with deadlines, above everything else.  After a wait of seconds
publishers have overwritten messages that it had not taken."""
_PATIENCE = 8.0
"""Time for a child to end after SIGINT before it is killed [s]."""


_PREFIX = re.compile(r"^(?:\[[A-Z]+\] \[[\d.]+\] \[[^\]]+\]: |error: )")
"""Prefix of a sentence in rclpy's log, or at the end of a program."""


_TOO_LATE = re.compile(r"\bwithin \d|did not (?:answer|run)")
"""Pattern of the last output of a program that other programs blocked."""


def _busy_note(words: str) -> str:
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load <= 2.0 * cores or not _TOO_LATE.search(words):
        return ""
    return (
        f". This computer is busy (load {load:.0f} on {cores} cores), and that alone can cause this: "
        "end other programs, then run it again"
    )


@dataclass
class Child:
    """One running program."""

    name: str
    process: subprocess.Popen[bytes] | HostedProgram
    log: Path
    ends_last: bool = False
    ends_by_itself: bool = False

    def last_words(self, lines: int = 3) -> str:
        """Return the end of its output, for messages; a line that is logged and raised is returned once."""
        with contextlib.suppress(OSError):
            text: list[str] = []
            for line in self.log.read_text(errors="replace").splitlines():
                if text and _PREFIX.sub("", line) == _PREFIX.sub("", text[-1]):
                    text[-1] = line
                elif line.strip():
                    text.append(line)
            return " / ".join(text[-lines:])
        return ""


@dataclass
class ProcessSet:
    """The programs of one run; leaving the context ends them all. ``hosts`` run them; by default each has a process."""

    log_folder: Path
    environment: Mapping[str, str]
    hosts: HostPool | None = None
    children: list[Child] = field(default_factory=list)

    def __enter__(self) -> ProcessSet:
        """Make the folder of the logs; a FaultError if that fails."""
        try:
            self.log_folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FaultError(f"log folder {self.log_folder} cannot be created: {error.strerror}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End every program."""
        self.stop()

    def start_node(self, program: NodeProgram, *, niceness: int = 0) -> Child:
        """Start a node."""
        return self.start(program.full_name.strip("/").replace("/", "_"), program.command(), niceness=niceness)

    def start(
        self,
        name: str,
        command: Sequence[str],
        *,
        ends_last: bool = False,
        ends_by_itself: bool = False,
        niceness: int = 0,
        environment: Mapping[str, str] | None = None,
        alone: bool = False,
    ) -> Child:
        """Start a command in a process group of its own, or in a host, and pass Ctrl-C to it in order.

        Args:
            ends_last: End it after all others: a recorder records their last messages.
            ends_by_itself: It is expected to end with code 0.
            niceness: Scheduling priority to give away, or to take if negative and permitted.
        """
        log = self.log_folder / f"{name}.log"
        everything = {**os.environ, **self.environment, **(environment or {})}
        process: subprocess.Popen[bytes] | HostedProgram | None = None
        # An interrupt before the program is registered would leave it unawaited.
        with log.open("wb") as sink, defer_interrupts():
            if self.hosts is not None and not alone:
                process = self.hosts.start(command, environment=everything, log=log, niceness=niceness)
            if process is None:
                process = start_bound_process(command, environment=everything, output=sink, niceness=niceness)
            child = Child(name, process, log, ends_last, ends_by_itself)
            self.children.append(child)
        return child

    def check(self) -> None:
        """Raise a FaultError that names the first program that has ended by itself."""
        for child in self.children:
            code = child.process.poll()
            if code is not None and not (child.ends_by_itself and code == 0):
                ending = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
                words = child.last_words() or "none"
                raise FaultError(f"{child.name} {ending}; its last output: {words}{_busy_note(words)}")

    def finish(self, child: Child, patience: float = _PATIENCE) -> int:
        """End one program by SIGINT, then by SIGKILL; return its exit code."""
        self._interrupt(child)
        code = self._wait(child, patience)
        if child in self.children:
            self.children.remove(child)
        return code

    def wait(self, child: Child, timeout: float) -> None:
        """Wait for a program that ends by itself, at most ``timeout`` [s]; a FaultError if it fails."""
        deadline = time.monotonic() + timeout
        while child.process.poll() is None:
            if time.monotonic() > deadline:
                words = child.last_words() or "none"
                raise FaultError(f"{child.name} still runs after {timeout:g} s; its last output: {words}")
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(0.1)
        self.check()

    def stop(self, keep: Collection[Child] = ()) -> None:
        """End all programs but ``keep``, recorders last: plants publish a last zero torque that should be recorded."""
        for wave in (False, True):
            children = [child for child in self.children if child.ends_last is wave and child not in keep]
            for child in children:
                self._interrupt(child)
            for child in children:
                self._wait(child, _PATIENCE)
        self.children = [child for child in self.children if child in keep]

    @staticmethod
    def _interrupt(child: Child) -> None:
        with contextlib.suppress(ProcessLookupError):
            if child.process.poll() is None:
                child.process.send_signal(signal.SIGINT)
                # A stopped process gets the signal only after it is continued.
                child.process.send_signal(signal.SIGCONT)

    @staticmethod
    def _wait(child: Child, patience: float) -> int:
        deadline = time.monotonic() + patience
        while child.process.poll() is None:
            if time.monotonic() > deadline:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child.process.pid, signal.SIGKILL)
                child.process.wait()
                break
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(0.05)
        return int(child.process.wait())


def ros_environment(domain: int, log_folder: Path) -> dict[str, str]:
    """Return the environment of a run's programs: its domain; they open or close the network themselves."""
    return {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(log_folder / "ros"), "PYTHONUNBUFFERED": "1"}


def start_recorder(
    processes: ProcessSet,
    bag: Path,
    namespace: str,
    metadata: Path,
    storage: str,
    *,
    simulated: bool = False,
    priority: int = 0,
) -> Child:
    """Start the recorder of one plant's topics in its namespace, with ``metadata``, a JSON file about the run."""
    command = [sys.executable, "-m", "pendulum_bags", "record", "-o", str(bag)]
    command += ["--regex", f"^({namespace}/.*|/diagnostics|/clock)$", "--storage", storage]
    command += ["--metadata", str(metadata), "--log-time", "header" if simulated else "receive"]
    if simulated:
        # No stamps of wall time in a bag of simulated time.
        command += ["--exclude", "^/diagnostics$|/transition_event$"]
    command += ["--ros-args", "-r", f"__ns:={namespace}"]
    if priority:
        command += ["-p", f"{REALTIME_PRIORITY.name}:={priority}"]
    return processes.start(f"recorder_{bag.name}", command, ends_last=True, niceness=_RECORDER_NICENESS)
