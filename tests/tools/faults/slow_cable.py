"""A cable that delays and loses frames, between two network namespaces.

Kernels with ``sch_netem`` do it themselves (``tc qdisc ... netem``). Many have none (this is a module, and containers
and small virtual machines leave it out); there a program is the cable: it takes each Ethernet frame off a TAP device at
the one end, holds it for the delay, and puts it on the TAP device at the other end. ROS sees a network card either way.

The program: ``python -m tests.tools.faults.slow_cable NAMESPACE NAMESPACE``; it reads ``DELAY_S LOSS`` lines.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from pendulum_msgs_py.errors import FaultError

__all__ = ["DEVICE", "SlowCable", "has_netem"]

DEVICE = "cable"

_TUN = Path("/dev/net/tun")
_TUNSETIFF = 0x400454CA
_IFF_TAP, _IFF_NO_PI = 0x0002, 0x1000
_CLONE_NEWNET = 0x40000000
_LONGEST_FRAME = 65536
_START_TIMEOUT = 20.0


def has_netem(namespace: str) -> bool:
    """Return whether the kernel delays frames itself."""
    attempt = ["tc", "-n", namespace, "qdisc", "add", "dev", "lo", "root", "netem", "delay", "1ms"]
    try:
        done = subprocess.run(attempt, capture_output=True, check=False)
    except FileNotFoundError:
        return False
    if done.returncode == 0:
        subprocess.run(["tc", "-n", namespace, "qdisc", "del", "dev", "lo", "root"], capture_output=True, check=False)
    return done.returncode == 0


class SlowCable:
    """Joins two namespaces by a cable whose delay and loss can be set; a context manager.

    Args:
        namespaces: Names of the two network namespaces; both get a device named ``cable``.
        netem: Let the kernel do it; by default where it can.

    Raises:
        FaultError: The cable cannot be made.
    """

    def __init__(self, namespaces: tuple[str, str], *, netem: bool | None = None) -> None:
        self._namespaces = namespaces
        self.netem = has_netem(namespaces[0]) if netem is None else netem
        self._program: subprocess.Popen[str] | None = None

    @property
    def means(self) -> str:
        """How frames are delayed, for reports."""
        return "tc netem" if self.netem else "a program between two TAP devices (this kernel has no netem)"

    def __enter__(self) -> SlowCable:
        """Make the cable, without delay."""
        first, second = self._namespaces
        if self.netem:
            peer = ("peer", "name", DEVICE, "netns", second)
            _run("ip", "link", "add", DEVICE, "netns", first, "type", "veth", *peer)
            return self
        if not _TUN.exists():
            raise FaultError(f"the kernel has neither netem nor {_TUN}; expected one of them, to delay frames with")
        for name in self._namespaces:
            _run("ip", "-n", name, "tuntap", "add", DEVICE, "mode", "tap")
        command = [sys.executable, "-m", "tests.tools.faults.slow_cable", first, second]
        self._program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._program.stdout is not None
        if not select.select([self._program.stdout], [], [], _START_TIMEOUT)[0] or not self._program.stdout.readline():
            self.__exit__()
            raise FaultError("the cable's program did not start; its reason stands above")
        return self

    def __exit__(self, *_: object) -> None:
        """Take the cable away; its devices go with their namespaces."""
        if self._program is not None:
            self._program.terminate()
            self._program.wait(10.0)
            self._program = None

    def set(self, delay: float, loss: float = 0.0) -> None:
        """Set what each frame meets on its way, either way.

        Args:
            delay: One-way delay [s].
            loss: Share of frames that are lost.
        """
        if self.netem:
            netem = ("netem", "delay", f"{delay * 1e6:.0f}us", "loss", f"{100.0 * loss:g}%", "limit", "100000")
            for name in self._namespaces:
                _run("tc", "-n", name, "qdisc", "replace", "dev", DEVICE, "root", *netem)
            return
        assert self._program is not None
        assert self._program.stdin is not None
        try:
            self._program.stdin.write(f"{delay!r} {loss!r}\n")
            self._program.stdin.flush()
        except OSError as error:
            raise FaultError(f"the cable's program has ended: {error}") from error


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FaultError(f"{' '.join(command)} failed: {done.stderr.strip()}")


def _open_tap(namespace: str) -> int:
    """Return a descriptor of the namespace's device; the caller's thread is in that namespace afterwards."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path("/run/netns", namespace).open("rb") as entry:
        if libc.setns(entry.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"network namespace {namespace} cannot be entered")
    descriptor = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _IFF_TAP | _IFF_NO_PI))
    return descriptor


def _carry(ends: tuple[int, int]) -> None:
    """Carry frames until standard input is closed."""
    delay, loss = 0.0, 0.0
    lottery = random.Random(1)
    # One queue each way: with one delay for all, frames leave in the order in which they came.
    waiting: dict[int, deque[tuple[float, bytes]]] = {end: deque() for end in ends}
    other = {ends[0]: ends[1], ends[1]: ends[0]}
    commands = sys.stdin.fileno()
    text = b""
    while True:
        due = min((queue[0][0] for queue in waiting.values() if queue), default=None)
        patience = None if due is None else max(0.0, due - time.monotonic())
        readable, _, _ = select.select([*ends, commands], [], [], patience)
        now = time.monotonic()
        for end in ends:
            if end not in readable:
                continue
            try:
                while True:
                    frame = os.read(end, _LONGEST_FRAME)
                    if lottery.random() >= loss:
                        waiting[other[end]].append((now + delay, frame))
            except BlockingIOError:
                pass
        if commands in readable:
            piece = os.read(commands, 4096)
            if not piece:
                return
            text += piece
            *lines, text = text.split(b"\n")
            for line in lines:
                delay, loss = (float(word) for word in line.split())
        now = time.monotonic()
        for end, queue in waiting.items():
            while queue and queue[0][0] <= now:
                # Where the device is down or its queue full, a frame is lost: a cable does not try again.
                with contextlib.suppress(OSError):
                    os.write(end, queue.popleft()[1])


def main(argv: Sequence[str] | None = None) -> int:
    """Be the cable between two namespaces that have a TAP device named ``cable`` each."""
    first, second = sys.argv[1:] if argv is None else argv
    ends = (_open_tap(first), _open_tap(second))
    # Late frames are what this is about: before anybody else, where that is permitted.
    with contextlib.suppress(OSError):
        os.nice(-10)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    _carry(ends)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
