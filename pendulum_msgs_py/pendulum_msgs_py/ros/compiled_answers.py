"""Answers by compiled code: a slice of some milliseconds is one call, and what is not ordinary is left to Python.

The loop waits for a message, compares it with the layout that is known, computes the answer and publishes it, without
the interpreter. Who answers lends it what the answers depend on, and takes back what they have changed.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.publisher import Publisher

from pendulum_msgs_py.contract.cdr import JointStateFields, MessageTemplate, decode_joint_state, template_of
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.loops.answer_record import ENDED, FAILED, LEFT, Answerer, LoopKind, answer_record
from pendulum_msgs_py.loops.machine_code import NoMachineCodeError, load_loop
from pendulum_msgs_py.loops.records import expect_template, set_template
from pendulum_msgs_py.ros.direct import DirectTopics, rcl_symbols
from pendulum_msgs_py.ros.polled import WaitedInput
from pendulum_msgs_py.ros.turns import INTERPRETED_SLICE, WHILE_CALLED, Turns

__all__ = ["AnsweredInput"]

_EVENTS_AFTER_SLICE = 3
"""Events that the executor may attend to after each slice: 15 a second at least. Who answers has a timer of 1 Hz; its
services are attended to apart."""


class AnsweredInput:
    """An input whose messages are answered one by one, by compiled code where it can be had.

    Args:
        source: The input; who receives its messages answers those that are Python's.
        receive: Receives them.
        answerer: Who answers.
        called: Returns the event counter of what ends a slice of compiled code, such as
            :attr:`pendulum_msgs_py.ros.polled.PollingNode.request_descriptor`; -1 for none.
    """

    def __init__(
        self,
        source: WaitedInput,
        receive: Callable[[bytes], object],
        answerer: Answerer,
        called: Callable[[], int] = lambda: -1,
    ) -> None:
        self._called = called
        self._source = source
        self._receive = receive
        self._answerer = answerer
        self._loop: _Loop | None = None
        self._why = ""
        self._turns = Turns(self._serve, _EVENTS_AFTER_SLICE)

    def compile(self, publisher: Publisher, *, sender: str, joint: str, ahead_ns: int) -> None:
        """Have the loop that the answerer wants, if any; where it was never needed before, that takes seconds.

        Args:
            publisher: Publishes the answers.
            sender: ``frame_id`` of the answers.
            joint: The joint of states and answers.
            ahead_ns: How far the clock of the stamps is ahead of the monotonic one, in real time [ns].
        """
        kind = self._answerer.kind
        if kind is None:
            return
        try:
            self._loop = _Loop(self._source, kind, publisher, sender, joint, ahead_ns)
        except NoMachineCodeError as error:
            self._why = str(error)

    @property
    def loop(self) -> str:
        """What answers, for diagnostics."""
        why = self._why or self._answerer.refusal
        return f"interpreted: {why}" if why else "compiled"

    def run_due(self) -> float | None:
        """Attend to the input in its turn, as :class:`pendulum_msgs_py.ros.runner.Paced` does."""
        return self._turns.run_due() if self._source.works else None

    def _serve(self, longest: float) -> bool:
        ends, came = time.monotonic() + longest, False
        while (left := ends - time.monotonic()) > 0.0:
            loop = self._loop
            if loop is None or not self._answerer.lend(loop.own):
                return self._source.serve(min(left, INTERPRETED_SLICE)) or came
            data = loop.run(left, self._called())
            if loop.record["answers"]:
                came = True
                self._answerer.take_back(loop.record)
            if data is not None:
                came = True
                self._receive(data)
                loop.expect(data)
            if loop.failed:
                self._loop, self._why = None, loop.failed
            if loop.ended:
                # Where somebody calls, it may be some time before they have their turn.
                left = ends - time.monotonic()
                return (left > 0.0 and self._source.serve(min(left, WHILE_CALLED))) or came
        return came


class _Loop:
    """The loop of one input and one output, each of one joint.

    Raises:
        NoMachineCodeError: It cannot be had here.
    """

    def __init__(
        self, source: WaitedInput, kind: LoopKind, publisher: Publisher, sender: str, joint: str, ahead_ns: int
    ) -> None:
        if not source.works:
            raise NoMachineCodeError("the middleware does not say when a message comes")
        self.failed = ""
        self.ended = False
        self._run = load_loop(kind.builder, *kind.choice, symbols=rcl_symbols())
        self._memory = np.zeros(1, dtype=answer_record(kind.own))
        self.record: Any = self._memory[0]
        self.own: Any = self.record["own"]
        self._joint = joint
        self._expected: MessageTemplate | None = None
        self._topics = DirectTopics()
        self._topics.add_input(self.record["state"], source.subscription, source.depth)
        self._topics.add_output(self.record["answer"], publisher)
        set_template(self.record["answer"], template_of(JointStateFields(0, sender, (joint,), (), (), (0.0,))))
        self.record["counter"] = source.descriptor
        self.record["wall_ahead_ns"] = ahead_ns

    def run(self, longest: float, called: int) -> bytes | None:
        """Answer what comes within a time [s], or until somebody calls or a message is Python's, and return that."""
        self.record["answers"] = 0
        self.record["calls"] = called, -1
        self.record["end_ns"] = time.monotonic_ns() + round(longest * NANOSECONDS)
        with self._topics.held():
            why = self._run(self._memory)
        self.ended = why == ENDED
        if why == FAILED:
            self.failed = "rcl could not take a message"
        return DirectTopics.message(self.record["state"]) if why == LEFT else None

    def expect(self, data: bytes) -> None:
        """Expect messages of the layout of one that was Python's, where it tells the state of the one joint alone."""
        fields = decode_joint_state(data)
        if fields is None or fields.joints != (self._joint,):
            return
        if (len(fields.position), len(fields.velocity)) == (1, 1):
            template = _template(fields.frame_id, self._joint, len(fields.effort), len(data))
            if template != self._expected:
                self._expected = template
                expect_template(self.record["state"], template)


@functools.lru_cache(maxsize=16)
def _template(sender: str, joint: str, efforts: int, size: int) -> MessageTemplate:
    return template_of(JointStateFields(0, sender, (joint,), (0.0,), (0.0,), (0.0,) * efforts), size)
