"""Leaving the ROS graph: last words that are heard, and an end in which the middleware can hang for good."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.duration import Duration
from rclpy.publisher import Publisher

from pendulum_msgs_py.programs.hang_guard import hang_guard

__all__ = ["leaving_graph", "wait_until_heard"]

_LAST_WORDS = 0.2
"""Time that a node gives its last words to be heard before it ends [s]."""
_LOOK = 0.001
"""Time between two looks whether all have heard [s]."""


def wait_until_heard(publisher: Publisher) -> None:
    """Wait until all reliable subscribers have heard the last message, for a time at most.

    Looked at again and again, since rclpy keeps Python's lock while it waits itself, 0.15 s with any subscriber: for as
    long neither an actuator's thread could end its torque nor the e-stop be served.
    """
    ends = time.monotonic() + _LAST_WORDS
    while not publisher.wait_for_all_acked(Duration()) and time.monotonic() < ends:
        time.sleep(_LOOK)


@contextmanager
def leaving_graph() -> Iterator[None]:
    """Destroy nodes and contexts in this context: where the middleware hangs, it ends the process, with exit code 1.

    Fast DDS waits for those whom it just tells of somebody else, while it keeps from them the lock that they need to
    end, wherever it was built with an older standard library, as in the wheels (eProsima/Fast-DDS issue 6513): once in
    thousands of times it does not come back, and holds Python's lock meanwhile. Whatever is to be made safe, or
    written, comes before.
    """
    with hang_guard():
        yield
