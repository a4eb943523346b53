"""The peer of the node benchmark: the same loop as rclpy's tutorials would write it.

Typed JointState messages, a timer, ``rclpy.spin`` (SingleThreadedExecutor); same plant, same control law, same QoS.
Run as ``python -m tests.benchmarks.plain_loop plant|controller RATE_HZ``.
"""

from __future__ import annotations

import contextlib
import math
import sys

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.stepping.plant import RigidPlant


class Plant(Node):
    """Publishes a state each period and applies the newest command."""

    def __init__(self, rate: float) -> None:
        super().__init__("plain_plant")
        self.plant = RigidPlant(load_plant("thesis"), 1.0 / rate)
        self.plant.reset(math.pi - 0.1)
        self.effort = 0.0
        self.publisher = self.create_publisher(JointState, "joint_states", QoSProfile(depth=10))
        self.create_subscription(JointState, "effort_command", self.on_command, QoSProfile(depth=10))
        self.create_timer(1.0 / rate, self.on_timer)

    def on_command(self, message: JointState) -> None:
        self.effort = message.effort[0]

    def on_timer(self) -> None:
        state = self.plant.step(self.effort)
        message = JointState(name=[JOINT], position=[state.theta], velocity=[state.theta_dot], effort=[state.effort])
        message.header.stamp = self.get_clock().now().to_msg()
        self.publisher.publish(message)


class Controller(Node):
    """Answers each state with u = -K x."""

    def __init__(self) -> None:
        super().__init__("plain_controller")
        self.publisher = self.create_publisher(JointState, "effort_command", QoSProfile(depth=10))
        self.create_subscription(JointState, "joint_states", self.on_state, QoSProfile(depth=1))

    def on_state(self, message: JointState) -> None:
        effort = -(33.345265 * from_upright(message.position[0]) + 0.158993 * message.velocity[0])
        answer = JointState(name=[JOINT], effort=[effort])
        answer.header.stamp = message.header.stamp
        self.publisher.publish(answer)


def main() -> None:
    rclpy.init()
    node = Plant(float(sys.argv[2])) if sys.argv[1] == "plant" else Controller()
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
