"""Leaving the ROS graph: last messages that are received, and a shutdown in which the middleware can hang."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.duration import Duration
from rclpy.publisher import Publisher

from pendulum_msgs_py.programs.hang_guard import hang_guard

__all__ = ["leaving_graph", "wait_until_heard"]

_LAST_WORDS = 0.2
"""Longest wait for acknowledgements at the end of a node [s]."""
_LOOK = 0.001
"""Poll period [s]."""


def wait_until_heard(publisher: Publisher) -> None:
    """Wait, for a limited time, until all reliable subscribers have acknowledged the last message.

    By polling: rclpy holds the GIL for its own wait, 0.15 s, which would block the threads of actuator and e-stop.
    """
    ends = time.monotonic() + _LAST_WORDS
    while not publisher.wait_for_all_acked(Duration()) and time.monotonic() < ends:
        time.sleep(_LOOK)


@contextmanager
def leaving_graph() -> Iterator[None]:
    """Destroy nodes and contexts inside this context: if the middleware hangs, the process ends with exit code 1.

    Built with an older standard library, as in the wheels, Fast DDS deadlocks once in thousands of shutdowns while it
    holds the GIL (eProsima/Fast-DDS issue 6513). Make plants safe and write files first.
    """
    with hang_guard():
        yield
