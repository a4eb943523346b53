"""A pendulum as anybody writes a ROS node: no stamps, no limits, no watchdog; the last effort acts for ever."""

import math
import sys

import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray


def main() -> None:
    rclpy.init(args=sys.argv)
    node = rclpy.create_node("robot")
    states = node.create_publisher(JointState, "/robot/joint_states", 10)
    x = {"q": -math.pi / 2.0, "w": 0.0, "u": 0.0}

    def command(message: Float64MultiArray) -> None:
        x["u"] = message.data[1]

    def step() -> None:
        # q = -pi / 2 hangs, clockwise is positive.
        for _ in range(10):
            acceleration = (x["u"] - 11.77 * x["w"] - 1.678 * math.cos(x["q"])) / 0.055
            x["w"] += 0.001 * acceleration
            x["q"] += 0.001 * x["w"]
        wrapped = (x["q"] + math.pi) % (2.0 * math.pi) - math.pi
        states.publish(JointState(name=["wheel", "shoulder"], position=[0.0, wrapped], velocity=[0.0, x["w"]]))

    node.create_subscription(Float64MultiArray, "/robot/effort_controller/commands", command, 10)
    node.create_timer(0.01, step)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
