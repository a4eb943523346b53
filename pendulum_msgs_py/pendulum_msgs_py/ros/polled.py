"""Inputs that a node looks at when it needs them, instead of being woken for each message.

A plant that acts at deadlines has no use for a torque before the next one. Emptying its inputs there saves it one
wake-up a period, a third of its time at 1 kHz, and bounds what a flood of messages can cost. A recorder empties its
inputs every few milliseconds, a page when a picture is due.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

__all__ = ["PolledInput", "PollingNode"]


class PolledInput:
    """A subscription to raw messages that its owner empties.

    Args:
        subscription: Of a :class:`PollingNode`, raw.
        depth: Messages that it keeps; also the most that one look takes, however fast others publish.
    """

    def __init__(self, subscription: Subscription, depth: int) -> None:
        self.subscription = subscription
        self._take = subscription.handle.take_message
        self._type = subscription.msg_type
        self._looks = range(depth)

    def take(self, receive: Callable[[bytes, int], object]) -> None:
        """Hand over what has come since the last look, to the thread that owns the node.

        Args:
            receive: Gets each message, serialised, and the system time at which it reached this process [ns].
        """
        for _ in self._looks:
            taken = self._take(self._type, True)
            if taken is None:
                return
            receive(taken[0], taken[1]["received_timestamp"])

    def messages(self) -> Iterator[tuple[bytes, Mapping[str, int]]]:
        """Yield what has come since the last look, serialised, with what the middleware knows of it; in any thread."""
        with self.subscription.handle:
            while (taken := self._take(self._type, True)) is not None:
                yield taken


class PollingNode(Node):
    """A node that can have polled inputs besides the subscriptions that an executor attends to.

    Without ``__init__``, since rclpy's lifecycle node, which it may be joined with, calls that of ``Node`` directly.
    """

    _polled: frozenset[Subscription] = frozenset()

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor attends to."""
        return (each for each in super().subscriptions if each not in self._polled)

    def create_polled_input(self, message_type: type, topic: str, profile: QoSProfile) -> PolledInput:
        """Return an input that no executor is woken for."""
        subscription = self.create_subscription(message_type, topic, _never_called, profile, raw=True)
        self._polled |= {subscription}
        return PolledInput(subscription, profile.depth)

    def destroy_polled_input(self, polled: PolledInput) -> None:
        """Let go of an input."""
        self.destroy_subscription(polled.subscription)
        self._polled -= {polled.subscription}


def _never_called(_data: bytes) -> None:
    raise AssertionError("a polled input was handed to an executor")
