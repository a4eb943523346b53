"""Typed values that travel between plant, controller and recorder."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["NANOSECONDS", "JointCommand", "JointSample"]

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second; stamps are integers of nanoseconds so that no time is ever rounded."""


class JointSample(NamedTuple):
    """State of the joint at one instant.

    Attributes:
        stamp_ns: Time of the measurement [ns].
        position: theta, 0 hanging down, pi upright [rad].
        velocity: theta' [rad/s].
        effort: Measured joint torque [N m].
    """

    stamp_ns: int
    position: float
    velocity: float
    effort: float = 0.0

    def is_finite(self) -> bool:
        """Tell whether position, velocity and effort are all finite numbers."""
        return math.isfinite(self.position) and math.isfinite(self.velocity) and math.isfinite(self.effort)


class JointCommand(NamedTuple):
    """Torque asked for, in answer to one state.

    Attributes:
        stamp_ns: Stamp of the state that this command answers [ns].
        effort: Torque [N m].
        source: Who commands (``header.frame_id``).
        joints: Joint names that the message carried; empty means "the only joint".
    """

    stamp_ns: int
    effort: float
    source: str = ""
    joints: tuple[str, ...] = ()
