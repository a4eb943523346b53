"""Subscription of an e-stop button in a thread of its own: neither message floods nor arming delay it."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from pendulum_hw_bridge.nodes.e_stop_input import EStopInput
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros.e_stop import EStopThread
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["EStopInputServer"]

_LOOKS = 4
"""Checks of the silence within its limit [-]."""
_WAITING = 100
"""Queue depth: with 1, a release right after a press would replace it [-]."""


class EStopInputServer:
    """Subscribes to ``e_stop_input`` of a node and triggers its e-stop.

    Args:
        owner: Node of the e-stop.
        timeout: Silence that counts as a press [s].
        press: Latches the e-stop with a reason; called in the server's thread and must not block.
        latched: Returns whether it is latched already.
    """

    def __init__(self, owner: Node, timeout: float, press: Callable[[str], None], latched: Callable[[], bool]) -> None:
        self._input = EStopInput(timeout)
        self._press, self._latched = press, latched
        self._thread = EStopThread(owner, "e_stop_input", press)
        node = self._thread.node
        # Best effort: it matches every publisher, and a late message of a button is worthless.
        qos = QoSProfile(depth=_WAITING, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._topic = owner.resolve_topic_name(names.E_STOP_INPUT)
        node.create_subscription(Bool, self._topic, self._on_message, qos)
        create_wall_timer(node, timeout / _LOOKS, self._look)
        self._thread.start()

    @property
    def reason(self) -> str:
        """Why the plant must be stopped, or an empty string."""
        self._input.count(self._thread.node.count_publishers(self._topic))
        return self._input.reason(time.monotonic_ns())

    def close(self) -> None:
        """Stop listening."""
        self._thread.close()

    def _on_message(self, message: Bool) -> None:
        self._input.hear(pressed=bool(message.data), now_ns=time.monotonic_ns())
        # Latch here: by the next check the button may be released again.
        if message.data and not self._latched():
            self._press("e-stop button is pressed")

    def _look(self) -> None:
        reason = self.reason
        if reason and not self._latched():
            self._press(reason)
