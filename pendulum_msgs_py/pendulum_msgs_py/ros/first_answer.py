"""The first reply of a run in simulated time, delayed until all subscribers would get it."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.publisher import Publisher

from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["LOCKSTEP_SUBSCRIBERS", "FirstAnswer"]

LOCKSTEP_SUBSCRIBERS = ParameterSpec(
    "lockstep_subscribers", 0, "-",
    "Subscriptions to its torque that must be matched before the first reply, in simulated time; 0 for those on the "
    "graph.", minimum=0, read_only=True,
)  # fmt: skip
_TRIES = 5
"""Most unanswered states: a subscriber with incompatible QoS never matches."""
_PATIENT_TRIES = 60
"""The same where the number of subscribers is given."""


class FirstAnswer:
    """Whether a node may publish its first reply.

    DDS reports a match to one side before the other: a recorder may know a publisher that does not know it yet, neither
    by its matches nor on its graph, and a lockstep run is over in a fraction of a second. On a busy machine only the
    given number of ``subscribers`` excludes that. A waiting plant repeats its state each second.
    """

    def __init__(self, node: Node, publisher: Publisher, subscribers: int) -> None:
        self._node = node
        self._publisher = publisher
        self._subscribers = subscribers
        self._left = _PATIENT_TRIES if subscribers else _TRIES

    @property
    def gone(self) -> bool:
        """Whether replies need no further check."""
        return not self._left

    def may_go(self) -> bool:
        """Return whether a reply may go out."""
        if self._left:
            met = self._publisher.get_subscription_count()
            expected = max(self._subscribers, self._node.count_subscribers(self._publisher.topic_name))
            self._left = 0 if met >= expected else self._left - 1
        return not self._left
