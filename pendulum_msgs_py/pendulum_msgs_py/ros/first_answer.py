"""The first answer of a run in simulated time: held back until everybody who listens would get it."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.publisher import Publisher

__all__ = ["FirstAnswer"]

_TRIES = 5
"""States that are left unanswered at most: a listener whose QoS does not match is never met."""


class FirstAnswer:
    """Tells whether an answer may go out.

    DDS tells one side of a match before the other: a recorder that knows of a publisher may not be known to it yet, and
    a run in lockstep is over within a fraction of a second. A plant that waits repeats its state each second.

    Args:
        node: Who answers.
        publisher: What it answers on.
    """

    def __init__(self, node: Node, publisher: Publisher) -> None:
        self._node = node
        self._publisher = publisher
        self._left = _TRIES

    @property
    def gone(self) -> bool:
        """Whether answers may go out without being asked about."""
        return not self._left

    def may_go(self) -> bool:
        """Ask before an answer; costs nothing once it was true."""
        if self._left:
            met = self._publisher.get_subscription_count()
            self._left = 0 if met >= self._node.count_subscribers(self._publisher.topic_name) else self._left - 1
        return not self._left
