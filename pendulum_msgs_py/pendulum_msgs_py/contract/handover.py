"""Change of control without a jump: the previous effort fades out.

A command takes over from position control only within ``handover_effort_limit`` of the holding torque: a controller for
upright would command 100 N m at a pendulum that hangs after a ramp down.
"""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_msgs_py.contract.values import NANOSECONDS, Vector

__all__ = ["Handover"]


@dataclass
class Handover:
    """Fade from the efforts before a change of control to those after it, and of the set point likewise."""

    start_ns: int
    effort: Vector
    offset: float = 0.0
    offset_time: float = 0.0

    def remaining(self, now_ns: int, duration: float) -> float:
        """Return the remaining share of a fade of this duration [s], 1 to 0."""
        if duration <= 0.0:
            return 0.0
        return min(1.0, max(0.0, 1.0 - (now_ns - self.start_ns) / (duration * NANOSECONDS)))

    def remaining_offset(self, now_ns: int) -> float:
        """Return the remaining offset of the set point [rad]."""
        return self.offset * self.remaining(now_ns, self.offset_time)
