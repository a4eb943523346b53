"""Program hosts that wait for their next program, and a hosted program as its starter sees it."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from pendulum_bags.experiments.bound_process import start_bound_process

__all__ = ["AGAIN", "BEGUN", "LAST", "HostPool", "HostedProgram", "open_pool", "share_pool", "shared_pool"]

BEGUN = "begun"
"""Line that a host sends when its program accepts signals."""
AGAIN, LAST = "again", "last"
"""Follows the exit code in its line: whether the host takes another order."""
_HOST = "pendulum_bags.experiments.program_host"
_PATIENCE = 8.0
"""Time for an idle host to end [s]."""


@dataclass
class _Host:
    kind: tuple[str, str, int]
    process: subprocess.Popen[bytes]
    connection: socket.socket


class HostedProgram:
    """A program in a host, like ``subprocess.Popen``; ``release`` is called when the host is free."""

    def __init__(self, host: _Host, release: Callable[[_Host], None]) -> None:
        self.pid = host.process.pid
        self.returncode: int | None = None
        self._host = host
        self._release = release
        self._begun = False
        self._heard = b""

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal that ended the host with it; None while it runs."""
        self._listen(lambda: self.returncode is not None, 0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code; raises subprocess.TimeoutExpired after ``timeout`` [s] (None waits for ever)."""
        self._listen(lambda: self.returncode is not None, timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self._host.process.args, timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal to the program, if it still runs."""
        # The host listens only while this program runs.
        self._listen(lambda: self._begun or self.returncode is not None, _PATIENCE)
        if self.poll() is None:
            self._host.process.send_signal(number)

    def _listen(self, enough: Callable[[], bool], timeout: float | None) -> None:
        deadline = None if timeout is None else time.monotonic() + timeout
        while not enough():
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not select.select([self._host.connection], [], [], left)[0]:
                return
            try:
                heard = self._host.connection.recv(64)
            except OSError:  # reset: the host ended with an order unread
                heard = b""
            if not heard:
                self._host.connection.close()
                # The program has not reported success.
                self.returncode = self._host.process.wait() or 1
                return
            *lines, self._heard = (self._heard + heard).split(b"\n")
            for line in lines:
                self._take(line.decode())

    def _take(self, line: str) -> None:
        if line == BEGUN:
            self._begun = True
            return
        code, _, rest = line.partition(" ")
        self.returncode = int(code)
        if rest == AGAIN:
            self._release(self._host)
        else:
            # The process ends with all that its program left, on the graph too.
            _end([self._host])


@dataclass
class HostPool:
    """Hosts of programs, reused from run to run; leaving the context ends them all."""

    _idle: list[_Host] = field(default_factory=list)
    _all: list[_Host] = field(default_factory=list)

    def __enter__(self) -> HostPool:
        """Enter without starting anything."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End every host."""
        self.close()

    def start(
        self, command: Sequence[str], *, environment: Mapping[str, str], log: Path, niceness: int = 0
    ) -> HostedProgram | None:
        """Start ``[sys.executable, "-m", PACKAGE, EXECUTABLE, ...]`` in an idle or new host, or return None."""
        interpreter, flag, package, executable = [*command[:4], *[""] * (4 - len(command))]
        if interpreter != sys.executable or flag != "-m" or not package.startswith("pendulum_") or not executable:
            return None
        order = {
            "package": package,
            "arguments": list(command[3:]),
            "environment": dict(environment),
            "folder": str(Path.cwd()),
            "log": str(log.resolve()),
        }
        text = json.dumps(order).encode() + b"\n"
        kind = (package, executable, niceness)
        while True:
            host = next((host for host in self._idle if host.kind == kind), None)
            if host is None:
                host = self._new_host(kind, environment, log)
            else:
                self._idle.remove(host)
            try:
                host.connection.sendall(text)
            except OSError:  # it ended while it waited: try the next one
                _end([host])
                continue
            return HostedProgram(host, self._idle.append)

    def close(self) -> None:
        """End all hosts; those that still run a program end it as after Ctrl-C."""
        hosts, self._idle, self._all = self._all, [], []
        for host in hosts:
            if host.process.poll() is None:
                host.process.send_signal(signal.SIGINT)
            host.connection.close()
        _end(hosts)

    def _new_host(self, kind: tuple[str, str, int], environment: Mapping[str, str], log: Path) -> _Host:
        ours, theirs = socket.socketpair()
        with theirs, log.open("ab") as sink:
            process = start_bound_process(
                [sys.executable, "-m", _HOST, str(theirs.fileno())],
                environment=environment,
                output=sink,
                niceness=kind[2],
                pass_fds=[theirs.fileno()],
            )
        host = _Host(kind, process, ours)
        self._all = [one for one in self._all if one.process.poll() is None] + [host]
        return host


def _end(hosts: Sequence[_Host]) -> None:
    deadline = time.monotonic() + _PATIENCE
    for host in hosts:
        host.connection.close()
        try:
            host.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(host.process.pid, signal.SIGKILL)
            host.process.wait()


_shared: list[HostPool] = []


@contextlib.contextmanager
def share_pool(pool: HostPool) -> Iterator[None]:
    """Let successive programs in this process share their hosts."""
    _shared.append(pool)
    try:
        yield
    finally:
        _shared.remove(pool)


def shared_pool() -> HostPool | None:
    """Return the hosts that outlive the running program, for another one in this process; else None."""
    return _shared[-1] if _shared else None


@contextlib.contextmanager
def open_pool() -> Iterator[HostPool]:
    """Provide the hosts that outlive the running program, or new ones that end with it."""
    if (shared := shared_pool()) is not None:
        yield shared
        return
    with HostPool() as pool:
        yield pool
