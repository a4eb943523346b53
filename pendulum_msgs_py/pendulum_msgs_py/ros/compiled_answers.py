"""Replies by compiled code: one call runs for some milliseconds, and Python handles all other messages.

The loop waits for a message, compares it with the known layout, computes and publishes the reply. The node's logic
lends it its state and takes it back.
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
"""Executor events after each slice, at least 15 a second: a timer of 1 Hz; services are served separately."""


class AnsweredInput:
    """An input whose messages get replies one by one, from compiled code if available.

    ``receive`` handles the messages left to Python; ``called`` returns the event counter that ends a slice, such as
    :attr:`pendulum_msgs_py.ros.polled.PollingNode.request_descriptor`, or -1.
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
        """Load the answerer's loop, if it has one; compiling it the first time takes seconds.

        ``sender`` is the replies' ``frame_id``; ``ahead_ns`` is the lead of the stamps' clock over the monotonic one
        [ns].
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
        """Which code replies, for diagnostics."""
        why = self._why or self._answerer.refusal
        return f"interpreted: {why}" if why else "compiled"

    def run_due(self) -> float | None:
        """Serve the input in its turn, as :class:`pendulum_msgs_py.ros.runner.Paced` does."""
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
                # A pending call may have to wait for its turn.
                left = ends - time.monotonic()
                return (left > 0.0 and self._source.serve(min(left, WHILE_CALLED))) or came
        return came


class _Loop:
    """The loop of one input and one output of one joint; raises a NoMachineCodeError if unavailable."""

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
        """Reply for a time [s], until a call is pending or a message is left to Python; return that message."""
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
        """Expect messages of the layout of this one, if it is a state of the joint alone."""
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
