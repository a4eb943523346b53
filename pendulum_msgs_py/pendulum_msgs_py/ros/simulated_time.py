"""Simulated time for nodes that use the stamps of the states they answer.

rclpy would take each message on ``/clock``: one more message and wake-up for each lockstep step, a fifth of a
controller's time. No node here reads the clock while it replies.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["live_by_stamps"]


def live_by_stamps(node: Node, newest_ns: Callable[[], int | None]) -> None:
    """Unsubscribe a node from ``/clock``, if subscribed; its time follows the newest stamp, twice a second.

    ``newest_ns`` returns the newest answered stamp [ns], or None.
    """
    clocks = [each for each in node.subscriptions if each.msg_type is Clock]
    for clock in clocks:
        node.destroy_subscription(clock)

    def look() -> None:
        stamp_ns = newest_ns()
        if stamp_ns is not None:
            node.get_clock().set_ros_time_override(Time(nanoseconds=stamp_ns, clock_type=ClockType.ROS_TIME))

    if clocks:
        create_wall_timer(node, DIAGNOSTICS_PERIOD, look)
