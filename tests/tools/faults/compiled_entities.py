"""What a compiled loop uses of ROS, destroyed, interrupted and dropped in its middle.

``python -m tests.tools.faults.compiled_entities ROUNDS``

Run with ``MALLOC_PERTURB_``, memory that was freed holds garbage, so that whoever uses it still ends the process.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import psutil
import rclpy
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.sampling import PeriodWatch
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_lqr.nodes.compiled_controller import CompiledController
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.compiled_answers import AnsweredInput
from pendulum_msgs_py.ros.convert import sample_from_bytes
from pendulum_msgs_py.ros.polled import PollingNode

__all__ = ["main"]

_STATE_EVERY = 0.0005
_SLICES = 0.05
"""Time from the first answer until a round is broken off [s]."""
_LONGEST = 20.0
_MOST_GROWTH = 20e6
"""Of the resident set from the first tenth of the rounds to their end [bytes]: less than a node weighs."""
_MOST_FILES = 20
"""The same of open files."""


class _BrokenOffError(Exception):
    """Raised where a message is Python's."""


class _Counted(CompiledController):
    """Counts the slices in which compiled code has answered."""

    slices = 0

    def take_back(self, record: Any) -> None:
        """Count one, and take over what it has changed."""
        _Counted.slices += 1
        super().take_back(record)


class _Answers:
    """A node whose input is answered by the compiled loop of an LQR."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = PollingNode("answers", context=self.context, start_parameter_services=False)
        controller = make_controller("lqr", load_plant("thesis"), 0.002)
        self.loop = ControlLoop(controller, 1.0, send=lambda sample, effort: None)
        self.watch = PeriodWatch()
        self.publisher = self.node.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        source = self.node.create_waited_input(JointState, names.JOINT_STATES, qos.NEWEST_STATE, self._receive)
        self.input = AnsweredInput(source, self._receive, _Counted(controller, self.watch, lambda: self.loop))
        self.input.compile(
            self.publisher, sender="/answers", joint=names.JOINT, ahead_ns=time.time_ns() - time.monotonic_ns()
        )
        assert self.input.loop == "compiled", self.input.loop

    def _receive(self, data: bytes) -> None:
        sample = sample_from_bytes(data, (names.JOINT,))
        if sample is None:
            raise _BrokenOffError
        self.watch.add(sample.stamp_ns)
        self.loop.answer(sample, time.time_ns())

    def run(self, act: Callable[[], object]) -> None:
        """Answer until it is broken off, by what another thread does once states have come for a while."""
        deadline, breaks_off = time.monotonic() + _LONGEST, threading.Timer(_SLICES, act)
        while time.monotonic() < deadline:
            self.input.run_due()
            if self.loop.answered and not breaks_off.ident:
                breaks_off.start()
        raise TimeoutError(f"answered {self.loop.answered} states in {_LONGEST:g} s, and was not broken off")

    def end(self) -> None:
        """Leave the graph."""
        self.node.destroy_node()
        self.context.try_shutdown()


@contextmanager
def _states() -> Iterator[list[bytes]]:
    """Publish states all the while, or what is put into the list that is yielded."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = PollingNode("states", context=context, start_parameter_services=False)
    publisher = node.create_publisher(JointState, names.JOINT_STATES, qos.STATE)
    ended, instead = threading.Event(), list[bytes]()

    def publish() -> None:
        while not ended.wait(_STATE_EVERY):
            state = encode_joint_state(time.time_ns(), position=3.1, velocity=0.0, effort=0.0)
            publisher.publish((*instead, state)[0])

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        yield instead
    finally:
        ended.set()
        thread.join()
        node.destroy_node()
        context.try_shutdown()


def _round(number: int, instead: list[bytes]) -> str:
    """Run one node and break it off in one of four ways; return how it ended."""
    answers = _Answers()
    act, expected = _ways(answers.node, instead)[number % 4]
    try:
        answers.run(act)
    except expected as error:
        ended = type(error).__name__
    instead.clear()
    if number % 3:
        answers.end()
    else:
        # Whoever drops a node without a word leaves it to the collector.
        del answers
        gc.collect()
    return ended


def _ways(
    node: PollingNode, instead: list[bytes]
) -> list[tuple[Callable[[], object], tuple[type[BaseException], ...]]]:
    return [
        # While Python takes messages itself, rcl says it in words of its own.
        (node.destroy_node, (InvalidHandle, RCLError)),
        (lambda: os.kill(os.getpid(), signal.SIGINT), (KeyboardInterrupt,)),
        (lambda: instead.append(b"\x00\x01\x00\x00 no state"), (_BrokenOffError,)),
        (lambda: instead.append(b"\x00\x01\x00\x00" + bytes(9000)), (_BrokenOffError,)),
    ]


def main(rounds: int) -> int:
    """Break off so many nodes; return 0 where the process is as healthy as before."""
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    process = psutil.Process()
    ways: Counter[str] = Counter()
    first = (0, 0)
    with _states() as instead:
        for number in range(rounds):
            ways[_round(number, instead)] += 1
            if number == max(1, rounds // 10):
                first = (process.memory_info().rss, process.num_fds())
    memory, files = process.memory_info().rss - first[0], process.num_fds() - first[1]
    print(f"{rounds} rounds, {_Counted.slices} slices of compiled code: {dict(ways)}")
    print(f"memory grew by {memory / 1e6:.1f} MB, open files by {files}")
    # A slice that Ctrl-C ends is not taken back, and so is not counted.
    return 0 if _Counted.slices >= rounds // 2 and memory < _MOST_GROWTH and files < _MOST_FILES else 1


if __name__ == "__main__":
    raise SystemExit(main(int(sys.argv[1])))
