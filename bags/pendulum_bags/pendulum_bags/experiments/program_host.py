"""A process that runs programs one after the other, so that a hundred runs load Python's modules once.

Loading numpy, scipy and rclpy costs half a second of processor time per node. ``python -m
pendulum_bags.experiments.program_host DESCRIPTOR`` reads orders (JSON lines) from that socket and writes a line when a
program ends. A program has its own variables, folder, output, signals, ROS context and exit code. The host ends with
its socket; :mod:`pendulum_bags.experiments.host_pool` is the other side.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.host_pool import AGAIN, BEGUN, LAST, HostPool, share_pool
from pendulum_msgs_py.programs.executables import EXIT_USAGE, run_package
from pendulum_msgs_py.programs.realtime import preserved_priority
from pendulum_msgs_py.programs.starter import end_with_starter

__all__ = ["main"]

_TASKS = Path("/proc/self/task")
_MOST_PROGRAMS = 200
"""Programs after which a host is replaced: the middleware leaks some memory for each."""


def main() -> int:
    """Run orders until the socket ends."""
    if len(sys.argv) != 2 or not sys.argv[1].isdigit():
        print("error: a program host is started by the experiments; expected the number of a socket", file=sys.stderr)
        return EXIT_USAGE
    # Between two programs the socket ends the host, not a signal.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_starter()
    with (
        socket.socket(fileno=int(sys.argv[1])) as connection,
        HostPool() as pool,
        share_pool(pool),
        connection.makefile("r", encoding="utf-8") as orders,
    ):
        for number, line in enumerate(orders, 1):
            code = _run(json.loads(line), lambda: connection.sendall(f"{BEGUN}\n".encode()))
            again = number < _MOST_PROGRAMS and not _left_behind()
            connection.sendall(f"{code} {AGAIN if again else LAST}\n".encode())
            if not again:
                break
    return 0


def _run(order: Mapping[str, Any], on_begin: Callable[[], None]) -> int:
    os.environ.clear()
    os.environ.update(order["environment"])
    os.chdir(order["folder"])
    _write_to(Path(order["log"]))
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        on_begin()
        with preserved_priority():
            code = run_package(order["package"], order["arguments"])
    except KeyboardInterrupt:
        code = 128 + signal.SIGINT
    except SystemExit as end:
        code = _exit_code(end)
    except BaseException:  # noqa: BLE001  # printed, as an interpreter that ends by it would
        traceback.print_exc()
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    sys.stdout.flush()
    sys.stderr.flush()
    # Nodes freeze existing objects at their start. What is left of this program must go now: a node that only the
    # collector would destroy stays on the graph, and the next run in that domain would count it.
    gc.unfreeze()
    gc.collect()
    return code


def _exit_code(end: SystemExit) -> int:
    if end.code is None or isinstance(end.code, int):
        return end.code or 0
    print(end.code, file=sys.stderr)
    return 1


def _write_to(log: Path) -> None:
    descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.close(descriptor)


def _left_behind() -> bool:
    """Return whether a program left a thread of its own or of the middleware, which names them."""
    if any(not thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        return True
    names = set()
    for name in _TASKS.glob("*/comm"):
        with contextlib.suppress(OSError):  # it has just ended
            names.add(name.read_text(encoding="utf-8"))
    return len(names) > 1


if __name__ == "__main__":
    raise SystemExit(main())
