"""Simulated time for nodes that live by the stamps of what they answer.

rclpy has a node in simulated time take each message on ``/clock`` as it comes: one more message to send and one more
wake-up for each step of a plant in lockstep, a fifth of what a controller costs there. None of ours asks what time it
is while it answers.
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
    """Let a node in simulated time hear ``/clock`` no more; its time is the newest stamp, twice a second of wall time.

    Args:
        node: The node; one in real time is left as it is.
        newest_ns: Returns the newest stamp that it answered [ns], or None before the first.
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
