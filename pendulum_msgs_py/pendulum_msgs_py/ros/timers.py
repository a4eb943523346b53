"""Timers of wall time."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

__all__ = ["create_wall_timer"]


def create_wall_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer of steady time, independent of simulated time and clock steps; period in [s]."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
