"""Controller, listener and client of one plant that plays the simulator's part, in this very process."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer

__all__ = ["PlantPeer"]


class PlantPeer(GraphPeer):
    """Hears the plant's states and diagnostics, and answers each state with one torque.

    Attributes:
        states: All that came.
        diagnostics: The newest.
        torque: The answer [N m]; None for no answer.
    """

    def __init__(self, namespace: str = "", torque: float | None = None) -> None:
        super().__init__("peer", namespace=namespace)
        self.states: list[JointState] = []
        self.diagnostics: dict[str, str] = {}
        self.torque = torque
        self._commands = self.node.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        self.node.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.STATE)
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, 10)

    def _on_state(self, message: JointState) -> None:
        self.states.append(message)
        if self.torque is not None:
            answer = JointState(name=[names.JOINT], effort=[self.torque])
            answer.header.stamp, answer.header.frame_id = message.header.stamp, "peer"
            self._commands.publish(answer)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics = {pair.key: pair.value for pair in status.values}

    def known(self) -> str:
        """Return the diagnostics, for the message about something that did not happen."""
        return f"; diagnostics {self.diagnostics}"

    def leave_the_command(self) -> None:
        """Command no more, and be seen to: others ask the graph who does."""
        self.torque = None
        self.node.destroy_publisher(self._commands)

    def ask(self, service: str) -> Trigger.Response:
        """Call one of the plant's services without arguments."""
        return self.call(Trigger, f"simulator/{service}", Trigger.Request())

    def arm(self, on: bool = True) -> SetBool.Response:
        """Arm the plant, or disarm it."""
        return self.call(SetBool, "simulator/arm", SetBool.Request(data=on))
