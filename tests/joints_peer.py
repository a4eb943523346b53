"""Listener and commander of one plant of several joints, in this very process."""

from __future__ import annotations

import json
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer

__all__ = ["JointsPeer"]


class JointsPeer(GraphPeer):
    """Hears one plant and answers each of its states with what it is told to.

    Args:
        states: Quality of service with which it hears states; by default the newest alone, as controllers do.
    """

    def __init__(self, states: QoSProfile = qos.NEWEST_STATE) -> None:
        super().__init__("peer", namespace="sim")
        self.states: list[JointState] = []
        self.applied: list[JointState] = []
        self.events: list[dict] = []
        self.diagnostics: dict[str, str] = {}
        self.answer: dict[str, Any] | None = None
        self.commands = self.node.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        self.trajectories = self.node.create_publisher(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self.node.create_subscription(JointState, names.JOINT_STATES, self._on_state, states)
        self.node.create_subscription(JointState, names.APPLIED_EFFORT, self.applied.append, qos.STATE)
        self.node.create_subscription(
            String, names.EVENTS, lambda message: self.events.append(json.loads(message.data)), qos.EVENTS
        )
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, 10)

    def _on_state(self, message: JointState) -> None:
        self.states.append(message)
        if self.answer is not None:
            command = JointState(**self.answer)
            command.header.stamp, command.header.frame_id = message.header.stamp, "peer"
            self.commands.publish(command)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": plant"):
                self.diagnostics = {pair.key: pair.value for pair in status.values}

    def known(self) -> str:
        return f"; diagnostics {self.diagnostics}"
