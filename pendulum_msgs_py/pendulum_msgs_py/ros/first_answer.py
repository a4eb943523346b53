"""The first reply of a run in simulated time, delayed until all subscribers would get it."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.publisher import Publisher

__all__ = ["FirstAnswer"]

_TRIES = 5
"""Most unanswered states: a subscriber with incompatible QoS never matches."""


class FirstAnswer:
    """Whether a node may publish its first reply.

    DDS reports a match to one side before the other: a recorder may know a publisher that does not know it yet, and a
    lockstep run is over in a fraction of a second. A waiting plant repeats its state each second.
    """

    def __init__(self, node: Node, publisher: Publisher) -> None:
        self._node = node
        self._publisher = publisher
        self._left = _TRIES

    @property
    def gone(self) -> bool:
        """Whether replies need no further check."""
        return not self._left

    def may_go(self) -> bool:
        """Return whether a reply may go out."""
        if self._left:
            met = self._publisher.get_subscription_count()
            self._left = 0 if met >= self._node.count_subscribers(self._publisher.topic_name) else self._left - 1
        return not self._left
