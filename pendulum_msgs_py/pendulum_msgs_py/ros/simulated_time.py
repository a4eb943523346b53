"""Nodes that live by the stamps of what they answer, and look at ``/clock`` now and then alone.

rclpy has a node in simulated time take each message on ``/clock`` as it comes: one more wake-up for each step of a
plant in lockstep, a fifth of what a controller costs there. None of ours asks what time it is while it answers.
"""

from __future__ import annotations

from collections.abc import Iterator

from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["AnsweringNode"]


class AnsweringNode(Node):
    """A node whose ROS time, where it is simulated, is as old as the last look: half a second of wall time at most.

    Without ``__init__``, since rclpy's lifecycle node, which it may be joined with, calls that of ``Node`` directly.
    """

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor attends to."""
        return (each for each in super().subscriptions if each.msg_type is not Clock)

    def look_at_clock_seldom(self) -> None:
        """Look at ``/clock`` from now on, where time is simulated."""
        if any(True for _ in self._clocks()):
            create_wall_timer(self, DIAGNOSTICS_PERIOD, self._look_at_clock)

    def _look_at_clock(self) -> None:
        for clock in self._clocks():
            taken = clock.handle.take_message(Clock, False)
            if taken is not None:
                clock.callback(taken[0])

    def _clocks(self) -> Iterator[Subscription]:
        return (each for each in super().subscriptions if each.msg_type is Clock)
