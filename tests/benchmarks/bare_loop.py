"""The floor of the node benchmark: the same two processes with nothing in them.

Ready-made bytes, best effort, EventsExecutor, no plant, no law, no checks, no diagnostics: what waking up, publishing
and taking cost on this machine today, whoever writes the nodes. Run as
``python -m tests.benchmarks.bare_loop plant|controller RATE_HZ``.
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract.cdr import encode_joint_state


def _profile(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def main() -> None:
    role, rate = sys.argv[1], float(sys.argv[2])
    rclpy.init()
    node = Node(f"bare_{role}")
    if role == "plant":
        data = encode_joint_state(0, position=1.0, velocity=1.0, effort=1.0)
        states = node.create_publisher(JointState, "joint_states", _profile(10))
        node.create_subscription(JointState, "effort_command", lambda _: None, _profile(10), raw=True)
        node.create_timer(1.0 / rate, lambda: states.publish(data), clock=Clock(clock_type=ClockType.STEADY_TIME))
    else:
        answer = encode_joint_state(0, frame_id="/controller", effort=1.0)
        commands = node.create_publisher(JointState, "effort_command", _profile(10))
        node.create_subscription(JointState, "joint_states", lambda _: commands.publish(answer), _profile(1), raw=True)
    executor = EventsExecutor()
    executor.add_node(node)
    never = Future(executor=None)
    while True:
        executor.spin_until_future_complete(never, 0.5)


if __name__ == "__main__":
    main()
