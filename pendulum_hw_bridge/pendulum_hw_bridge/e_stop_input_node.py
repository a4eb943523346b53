"""The topic of an e-stop button, heard in a thread of its own: neither a flood nor an arming actuator delays it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool

from pendulum_hw_bridge.e_stop_input import EStopInput

__all__ = ["TOPIC", "EStopInputServer"]

TOPIC = "e_stop_input"
"""``std_msgs/Bool``, relative to the plant: true is pressed, false says "not pressed" and has to come all the time."""
_LOOKS = 4
"""Looks at the silence within its limit [-]."""
_JOIN = 2.0


class EStopInputServer:
    """Listens to ``e_stop_input`` of a node and presses its e-stop.

    Args:
        owner: The node whose e-stop it is.
        timeout: Silence that counts as a press [s].
        press: Latches the e-stop, with the reason; called in the server's thread, must be quick and wait for nobody.
        latched: Tells whether it is latched already.
    """

    def __init__(
        self, owner: Node, timeout: float, press: Callable[[str], None], latched: Callable[[], bool]
    ) -> None:
        self._input = EStopInput(timeout)
        self._press, self._latched = press, latched
        # Without the process's remaps: they were for the owner, whose names are resolved here already.
        self._node = Node(
            f"{owner.get_name()}_e_stop_input",
            context=owner.context,
            namespace=owner.get_namespace(),
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        # Best effort: it hears every publisher, and a late message of a button is worth nothing.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(Bool, owner.resolve_topic_name(TOPIC), self._on_message, qos)
        self._node.create_timer(timeout / _LOOKS, self._look)
        self._executor = SingleThreadedExecutor(context=owner.context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="e_stop_input", daemon=True)
        self._thread.start()

    @property
    def reason(self) -> str:
        """Why the plant must be stopped, or an empty string."""
        return self._input.reason(time.monotonic_ns())

    def close(self) -> None:
        """Stop to listen."""
        self._executor.shutdown()
        self._thread.join(_JOIN)
        self._node.destroy_node()

    def _on_message(self, message: Bool) -> None:
        self._input.hear(pressed=bool(message.data), now_ns=time.monotonic_ns())
        if message.data:
            self._look()

    def _look(self) -> None:
        reason = self.reason
        if reason and not self._latched():
            self._press(reason)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return
