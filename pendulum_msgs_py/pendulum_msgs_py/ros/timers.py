"""Timers that keep the wall's time."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

__all__ = ["create_wall_timer"]


def create_wall_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer of steady time, deaf to simulated time and to steps of the system clock; period in [s]."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))
