"""The rig with the whole of ``BridgeNode``: its parameters, callbacks, services and loop, in simulated time.

Messages and requests are handed to the node's own callbacks, as rclpy does when they have come over DDS.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import rclpy
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.nodes.bridge_node import BridgeNode
from pendulum_hw_bridge.port.clocks import Clock, SteppedClock
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.contract.supervisor import Input
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.commander_watch import CHECK_PERIOD_NS
from tests.tools.faults.bridge_rig import Rig, SteppedLoop

__all__ = ["NodeRig", "ros_of_its_own"]


class _SteppedBridgeNode(BridgeNode):
    """The bridge's node on a clock that moves when somebody waits for it."""

    loop_type = SteppedLoop

    def __init__(self, clock: SteppedClock, **options: Any) -> None:
        self.stepped = clock
        super().__init__(lambda: None, **options)

    def _make_clock(self) -> Clock:
        return self.stepped


@contextmanager
def ros_of_its_own(domain: int) -> Iterator[None]:
    """Let nodes be made in this process while the context lasts.

    Args:
        domain: ROS domain that nobody else uses.
    """
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    # Every fault is told on the log, thousands of times here.
    set_logger_level("bridge", LoggingSeverity.FATAL)
    try:
        yield
    finally:
        rclpy.try_shutdown()


class NodeRig(Rig):
    """A :class:`Rig` whose bridge is a ``BridgeNode``; needs :func:`ros_of_its_own`, and :meth:`end` or ``with``."""

    def __enter__(self) -> NodeRig:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _build(self, kind: EffortStrategy, seed: int, start: float, voltage: float | None) -> None:
        if voltage is not None:
            raise NotImplementedError("the node takes the supply of its plant file")
        values = {
            "backend": "emulator",
            "effort_strategy": kind.value,
            "initial_position": start,
            "seed": seed,
            "feedback_rate": 1.0 / self.period,
            "effort_limit": self.effort_limit,
        }
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        self.node = node = _SteppedBridgeNode(self.clock, parameter_overrides=overrides, enable_rosout=False)
        assert node._bridge is not None
        self.bridge = node._bridge
        self.supervisor = node._supervisor
        self.loop = cast("SteppedLoop", node._loop)
        (self.module,) = self.bridge.drives
        self.port = cast("EmulatorBackend", self.module.port)
        self.actuator = self.port.actuator
        self.twins: list[Node] = []
        self._hear = node._interface._receivers

    def arm(self) -> str:
        return self._ask_to_arm(True)

    def disarm(self) -> None:
        self._ask_to_arm(False)

    def e_stop(self) -> None:
        self.node._interface._e_stop._on_e_stop(Trigger.Request(), Trigger.Response())

    def close(self) -> None:
        self.node.close()
        self.alive, self.closed = False, True

    def end(self) -> None:
        """Let go of everything."""
        if not self.closed:
            self.node.close()
        for node in (self.node, *self.twins):
            node.destroy_node()

    def follow(self, goal: float) -> str:
        sample = self.bridge.sample
        assert sample is not None
        return self.supervisor.accept_trajectory(thesis_ramp(sample.position[0], goal), self.port.now_ns(), sample)

    def add_twin(self) -> None:
        """Let two nodes of one name stand behind the commands, as the graph tells."""
        for _ in range(2):
            twin = rclpy.create_node("controller", enable_rosout=False, start_parameter_services=False)
            twin.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
            self.twins.append(twin)
        # The graph keeps wall time, and tells of a publisher before it tells of whom it is.
        deadline = time.monotonic() + 10.0
        topic = self.node.resolve_topic_name(names.EFFORT_COMMAND)
        while [info.node_name for info in self.node.get_publishers_info_by_topic(topic)] != ["controller"] * 2:
            assert time.monotonic() < deadline, "the twins were not discovered"
            time.sleep(0.001)
        # So does the pause between two looks at it, which is over for a plant that has run for as long as this one has.
        time.sleep(1e-9 * CHECK_PERIOD_NS)

    def _ask_to_arm(self, wanted: bool) -> str:
        answer = self.node._interface._on_arm(SetBool.Request(data=wanted), SetBool.Response())
        return "" if answer.success else str(answer.message)

    def _send(self, command: JointCommand) -> None:
        self._tell(Input.EFFORT_COMMAND, command)

    def disturb(self, command: JointCommand) -> None:
        self._tell(Input.DISTURBANCE, command)

    def _tell(self, kind: Input, command: JointCommand) -> None:
        self._hear[kind](encode_joint_state(command.stamp_ns, frame_id=command.source, effort=command.effort[0]))
