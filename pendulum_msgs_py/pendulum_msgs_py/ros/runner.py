"""Runs a node: signals, executor, errors, and a plant that is safe before the process ends."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import re
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import rclpy
from rclpy.exceptions import InvalidNamespaceException, InvalidNodeNameException, InvalidTopicNameException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from pendulum_msgs_py.contract.plant_specs import REALTIME_PRIORITY
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.programs import completion
from pendulum_msgs_py.programs.executables import (
    print_text,
    report_error,
    report_exhaustion,
    report_missing,
    split_ros_arguments,
)
from pendulum_msgs_py.programs.realtime import run_in_real_time
from pendulum_msgs_py.programs.starter import end_with_starter, stops
from pendulum_msgs_py.programs.typed_commands import as_typed
from pendulum_msgs_py.ros.answers import answer_who_listens
from pendulum_msgs_py.ros.leaving import leaving_graph
from pendulum_msgs_py.ros.middleware import check_closed, set_middleware_defaults
from pendulum_msgs_py.ros.polled import PollingNode

__all__ = ["Closeable", "Paced", "run_node"]

_SPIN_SLICE = 0.5
"""EventsExecutor.spin() hangs in the Jazzy wheels; finite slices work [s]."""
_M_MMAP_THRESHOLD = -3
_LARGEST_HEAP_BLOCK = 128 * 1024
"""[bytes]"""
_ECHO_TIME = 1.0
"""Time within which a repeated stop signal counts as an echo of the first [s]."""
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_OPEN_SOCKETS: list[socket.socket] = []
"""Write ends of the signal sockets: the garbage collector would close them."""


@runtime_checkable
class Paced(Protocol):
    """A node with deadlines."""

    def run_due(self) -> float | None:
        """Run what is due; return the time until the next deadline [s], or None for none."""


@runtime_checkable
class Closeable(Protocol):
    """A node that must be made safe."""

    def close(self) -> None:
        """Stop moving, publish that, release resources. Called once, with a valid context."""


def run_node(
    make_node: Callable[[Callable[[], None]], Node],
    argv: Sequence[str] | None = None,
    *,
    program: str,
    description: str,
    specs: Iterable[ParameterSpec] = (),
    example: str = "",
) -> int:
    """Run one node until it stops, its starter ends, SIGINT, SIGTERM or SIGHUP; return the exit code.

    rclpy's signal handlers would invalidate the context before the last zero torque is sent, so a thread here handles
    signals: the node is closed first, then the context. A second signal ends the process at once.

    ``make_node`` makes the node, given a function that stops the runner. ``program`` (``PACKAGE EXECUTABLE``),
    ``description``, ``specs`` and ``example`` are shown in help.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if completion.asked():
        print_text("\n".join(completion.of_node(specs, arguments)))
        return 0
    if "-h" in arguments or "--help" in arguments:
        print_text(_help(program, description, specs, example))
        return 0
    own, _ = split_ros_arguments(arguments)
    if own:
        return report_error(
            ParameterError(
                f"{program} does not know {own[0]!r}; parameters go after --ros-args, as in "
                f"{example or f'python -m {program} --ros-args -p NAME:=VALUE'}"
            )
        )
    return _run(make_node, arguments)


def _run(make_node: Callable[[Callable[[], None]], Node], arguments: Sequence[str]) -> int:
    if os.environ.get("NO_COLOR"):  # https://no-color.org, which rcutils does not know
        os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", "0")
    signals = _listen_for_stop_signals()
    end_with_starter()
    _wake_punctually()
    _give_memory_back()
    try:
        set_middleware_defaults()
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except PendulumError as error:
        return report_error(error)
    except Exception as error:  # noqa: BLE001  # rcl's errors have no common base
        return report_error(ParameterError(f"ROS arguments are not understood: {_sentence(error)}"))
    executor = EventsExecutor()
    stopped = Future(executor=None)
    node: Node | None = None

    def stop() -> None:
        if not stopped.done():
            stopped.set_result(None)
        executor.wake()
        if isinstance(node, PollingNode):
            node.wake()

    threading.Thread(target=_watch_signals, args=(signals, stop), daemon=True).start()
    exit_code = 0
    try:
        node = _make(make_node, stop)
        answer_who_listens(node)
        pace = node.run_due if isinstance(node, Paced) else None
        attend = None
        if isinstance(node, PollingNode):
            node.poll_services(timer=pace is None)
            attend = None if pace is None else node.attend
        check_closed(node.context.get_domain_id())
        if node.has_parameter(REALTIME_PRIORITY.name):
            priority = int(node.get_parameter(REALTIME_PRIORITY.name).value)
            # Simulated time has no deadlines.
            lockstep = node.has_parameter("clock") and node.get_parameter("clock").value == "lockstep"
            run_in_real_time(max(0, priority) if lockstep else priority)
        # rclpy's first log line takes 30 ms: now, not in the loop.
        node.get_logger().info("ready")
        executor.add_node(node)
        # Long-lived objects need not be collected again in the loop.
        gc.collect()
        gc.freeze()
        while not stopped.done() and rclpy.ok():
            left = pace() if pace is not None else None
            if attend is not None:
                left = min(attend(), _SPIN_SLICE if left is None else left)
            if left is None:
                executor.spin_until_future_complete(stopped, _SPIN_SLICE)
            else:
                # At most one event: a flood must not make the node miss deadlines.
                executor.spin_once(max(0.0, left))
    except PendulumError as error:
        exit_code = report_error(error)
    except Exception as error:  # noqa: BLE001  # printed in full, and the plant is made safe
        exit_code = report_exhaustion(error) or report_missing(error)
        if not exit_code:
            traceback.print_exc()
            exit_code = 1
    finally:
        exit_code = _close(node, executor) or exit_code
        # The thread that handles signals must not keep it alive.
        node = None
        # While the interpreter ends, signals have their defaults, and a launcher repeats the terminal's SIGINT: a node
        # that has ended properly would count as killed.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return exit_code


def _wake_punctually() -> None:
    """Wake this thread and its children on time, not up to 50 us later."""
    with contextlib.suppress(OSError):
        Path("/proc/self/timerslack_ns").write_text("1000", encoding="ascii")


def _give_memory_back() -> None:
    """Keep large blocks out of the heap, where freed memory below a used block stays with the process.

    glibc does so above 128 KiB, but raises that bound to any freed size: after one stall of the disk a recorder kept
    its longest queue for good. An explicit bound stays (mallopt(3)).
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGEST_HEAP_BLOCK)


def _make(make_node: Callable[[Callable[[], None]], Node], stop: Callable[[], None]) -> Node:
    try:
        return make_node(stop)
    except (InvalidNodeNameException, InvalidNamespaceException, InvalidTopicNameException) as error:
        raise ParameterError(f"ROS arguments are not understood: {_sentence(error)}") from error


def _sentence(error: Exception) -> str:
    """Return the first sentence of an error of rcl, without its C line numbers."""
    text = str(error)
    quoted = re.search(r"Couldn't parse .*?(?=, at )", text)
    return " ".join((quoted.group(0) if quoted else text).split())


def _close(node: Node | None, executor: rclpy.executors.Executor) -> int:
    exit_code = 0
    if node is not None:
        try:
            if isinstance(node, Closeable):
                node.close()
        except PendulumError as error:
            exit_code = report_error(error)
        except Exception as error:  # noqa: BLE001  # printed in full, and the plant is made safe
            if not report_exhaustion(error):
                traceback.print_exc()
            exit_code = 1
        exit_code = exit_code or int(getattr(node, "exit_code", 0))
    with leaving_graph():
        if node is not None:
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
        rclpy.try_shutdown()
    return exit_code


def _listen_for_stop_signals() -> socket.socket:
    """Return a socket that receives the number of each stop signal as one byte.

    The C handler writes it in any thread, so neither a busy callback nor an idle executor delays it. A handler is set
    even if a shell started the process in the background with SIGINT ignored.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    # Those of an earlier node in this process: ends its thread.
    while _OPEN_SOCKETS:
        _OPEN_SOCKETS.pop().close()
    _OPEN_SOCKETS.append(writer)
    for stop_signal in _STOP_SIGNALS:
        # nohup ignores a closed terminal.
        if stop_signal is not signal.SIGHUP or signal.getsignal(stop_signal) is not signal.SIG_IGN:
            signal.signal(stop_signal, lambda _number, _frame: None)
    return reader


def _watch_signals(signals: socket.socket, stop: Callable[[], None]) -> None:
    first = _next_stop_signal(signals)
    if not first:
        return
    stops.append(first)
    stop()
    # A launcher repeats the terminal's Ctrl-C: only a later one counts as a second.
    patience_ends = time.monotonic() + _ECHO_TIME
    second = _next_stop_signal(signals)
    while second and time.monotonic() < patience_ends:
        second = _next_stop_signal(signals)
    if not second:
        return
    print(f"second {signal.Signals(second).name}: leaving at once", file=sys.stderr, flush=True)
    os._exit(128 + first)


def _next_stop_signal(signals: socket.socket) -> int:
    while number := signals.recv(1):
        if number[0] in _STOP_SIGNALS:
            return number[0]
    return 0


def _help(program: str, description: str, specs: Iterable[ParameterSpec], example: str) -> str:
    lines = [f"usage: python -m {program} [--ros-args -p NAME:=VALUE ...]", "", description]
    rows = [
        (
            spec.name,
            str(spec.default).lower() if isinstance(spec.default, bool) else str(spec.default),
            spec.unit if spec.unit != "-" else "",
            spec.description + (f" ({spec.domain})" if spec.domain else ""),
        )
        for spec in specs
    ]
    if rows:
        lines += ["", "parameters (name, default, meaning):"]
        name_width = max(len(row[0]) for row in rows)
        value_width = max(len(f"{row[1]} {row[2]}".strip()) for row in rows)
        lines += [
            f"  {name:<{name_width}}  {f'{default} {unit}'.strip():<{value_width}}  {text}"
            for name, default, unit, text in rows
        ]
    if example:
        lines += ["", f"example: {example}"]
    return as_typed("\n".join(lines))
