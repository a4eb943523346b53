"""``effort_adapter``: let ros2_control, or clients of its effort controllers, drive a plant."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from pendulum_lqr.nodes.effort_adapter import EffortAdapter, effort_of_array, effort_of_joint
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import sample_from_bytes
from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD, Diagnostics
from pendulum_msgs_py.ros.leaving import wait_until_heard
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.simulated_time import live_by_stamps
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["NODE_SPECS", "EffortAdapterNode", "main"]

NODE_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("command_type", "multi_array", "",
        "multi_array: std_msgs/Float64MultiArray on ~/commands, as to effort_controllers/JointGroupEffortController; "
        "joint_state: sensor_msgs/JointState on joint_commands, as from topic_based_ros2_control/TopicBasedSystem.",
        choices=("multi_array", "joint_state"), read_only=True),
    ParameterSpec("command_timeout", 0.05, "s", "Age at which a command that waits for a state is dropped.",
        minimum=0.0, exclusive_minimum=True, read_only=True),
)  # fmt: skip

_ARRAY_TOPIC = "~/commands"
_JOINT_TOPIC = "joint_commands"
_COUNTS = ("commands", "answers", "replaced", "too_old", "refused")


class EffortAdapterNode(Node):
    """Publishes each command of ros2_control's kind as the reply to the newest state.

    While there are several publishers of commands none is passed on, because commands do not name their source.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("effort_controller")
        self._settings = NodeParameters(self, NODE_SPECS)
        self._adapter = EffortAdapter(self._settings["command_timeout"])
        self._now = SteadyWallClock()
        self._full_name = self.get_fully_qualified_name()
        self._commanders = 1
        self._reason = ""
        self._publisher = self.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        self._diagnostics = Diagnostics(self, "effort adapter")
        self.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.NEWEST_STATE, raw=True)
        if self._settings["command_type"] == "multi_array":
            self._topic = _ARRAY_TOPIC
            self.create_subscription(Float64MultiArray, self._topic, self._on_array, qos.COMMAND_INPUT)
        else:
            self._topic = _JOINT_TOPIC
            self.create_subscription(JointState, self._topic, self._on_joints, qos.COMMAND_INPUT)
        create_wall_timer(self, DIAGNOSTICS_PERIOD, self._look)
        live_by_stamps(self, lambda: self._adapter.newest_stamp_ns)

    def close(self) -> None:
        """End with zero torque while the context is still valid, and wait for its arrival."""
        # After a newer state it would be a command of its own, which enables the torque loop of a plant at rest.
        if (answered := self._adapter.answered_ns) is not None:
            self._publisher.publish(encode_joint_state(answered + 1, frame_id=self._full_name, effort=0.0))
            wait_until_heard(self._publisher)
        self._publish_diagnostics()

    def _on_state(self, data: bytes) -> None:
        sample = sample_from_bytes(data)
        if sample is not None:
            self._say(self._adapter.state(sample.stamp_ns, time.monotonic_ns()))

    def _on_array(self, message: Float64MultiArray) -> None:
        self._take(lambda: effort_of_array(message.data))

    def _on_joints(self, message: JointState) -> None:
        self._take(lambda: effort_of_joint(message.name, message.effort))

    def _take(self, read: Callable[[], float]) -> None:
        try:
            effort = read()
        except DataError as error:
            self._refuse(str(error))
            return
        if self._commanders > 1:
            self._refuse(f"{self._commanders} publishers on {self.resolve_topic_name(self._topic)}; expected one")
            return
        self._reason = ""
        self._say(self._adapter.command(effort, time.monotonic_ns()))

    def _say(self, answer: tuple[int, float] | None) -> None:
        if answer is not None:
            stamp_ns, effort = answer
            self._publisher.publish(encode_joint_state(stamp_ns, frame_id=self._full_name, effort=effort))

    def _refuse(self, reason: str) -> None:
        self._adapter.counts["refused"] += 1
        if reason != self._reason:
            self.get_logger().warning(f"refused: {reason}")
        self._reason = reason

    def _look(self) -> None:
        self._commanders = self.count_publishers(self._topic)
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        counts = {name: self._adapter.counts[name] for name in _COUNTS}
        level = DiagnosticStatus.WARN if self._reason else DiagnosticStatus.OK
        text = self._reason or ("passing commands on" if counts["answers"] else "no command yet")
        self._diagnostics.publish(self._now(), level, text, counts)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the adapter and return the exit code."""
    return run_node(
        EffortAdapterNode,
        argv,
        program="pendulum_lqr effort_adapter",
        description="Lets ros2_control, or who commands its effort controllers, drive our plants by torque.",
        specs=NODE_SPECS,
        example="python -m pendulum_lqr effort_adapter --ros-args -r __ns:=/sim",
    )
