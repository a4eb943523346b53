"""A pole on a cart as anybody writes a ROS node: no stamps, no limits; a hand holds it until an effort comes."""

import math
import sys

import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

CART, POLE, CENTRE, INERTIA, WEIGHT = 1.0, 0.1, 0.5, 1.0 / 30.0, 0.1 * 9.81 * 0.5


def main() -> None:
    rclpy.init(args=sys.argv)
    node = rclpy.create_node("robot")
    states = node.create_publisher(JointState, "/robot/joint_states", 10)
    # Clockwise from upright, and the slide counts to the left.
    x = {"slide": 0.0, "tilt": 0.0, "slide_dot": 0.0, "tilt_dot": 0.0, "force": 0.0}
    held = [True]

    def command(message: Float64MultiArray) -> None:
        x["force"] = message.data[0]
        held[0] = held[0] and not x["force"]

    def step() -> None:
        for _ in range(0 if held[0] else 10):
            s, c, rate = math.sin(x["tilt"]), math.cos(x["tilt"]), x["tilt_dot"]
            # The pole leans to the right for a positive tilt, the slide goes to the left.
            push = x["force"] - 0.1 * x["slide_dot"] - POLE * CENTRE * s * rate * rate
            turn = WEIGHT * s - 0.002 * rate
            coupling = -POLE * CENTRE * c
            determinant = (CART + POLE) * INERTIA - coupling * coupling
            x["slide_dot"] += 1e-3 * (INERTIA * push - coupling * turn) / determinant
            x["tilt_dot"] += 1e-3 * ((CART + POLE) * turn - coupling * push) / determinant
            x["slide"] += 1e-3 * x["slide_dot"]
            x["tilt"] += 1e-3 * x["tilt_dot"]
        wrapped = (x["tilt"] + math.pi) % (2.0 * math.pi) - math.pi
        states.publish(
            JointState(
                name=["tilt", "wheel", "slide"],
                position=[wrapped, 0.0, x["slide"]],
                velocity=[x["tilt_dot"], 0.0, x["slide_dot"]],
            )
        )

    node.create_subscription(Float64MultiArray, "/robot/effort_controller/commands", command, 10)
    node.create_timer(0.01, step)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
