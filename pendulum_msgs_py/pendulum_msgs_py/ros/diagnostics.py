"""A node's status on ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import diagnostic_status, stamp_to_message

__all__ = ["DIAGNOSTICS_PERIOD", "Diagnostics"]

DIAGNOSTICS_PERIOD = 0.5
"""Time between two diagnostics [s]."""


class Diagnostics:
    """Diagnostics of one node with one status, such as that of a ``plant``."""

    def __init__(self, node: Node, what: str) -> None:
        self._name = f"{node.get_fully_qualified_name()}: {what}"
        self.publisher = node.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos.DIAGNOSTICS)

    def publish(
        self, stamp_ns: int, level: bytes, text: str, values: Mapping[str, object], *, hardware_id: str = "none"
    ) -> None:
        """Publish the status at the node's time [ns]; ``hardware_id`` is ``none`` for a program."""
        message = DiagnosticArray(status=[diagnostic_status(self._name, level, text, values, hardware_id=hardware_id)])
        message.header.stamp = stamp_to_message(stamp_ns)
        self.publisher.publish(message)
