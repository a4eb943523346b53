"""Moving references of the angle: periodic ones, and the way onto them without a jump.

A reference is computed from parameters and stamps, not received on a topic, whose delay and losses would differ between
simulator and machine. Where no way onto it is within the torque, the controller gives none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["SHAPES", "Motion", "Reference", "Way"]

SHAPES = ("sine", "steps")
"""Names of the references."""


class Motion(NamedTuple):
    """Where a reference is: angle from upright, not wrapped [rad], velocity [rad/s] and acceleration [rad/s^2]."""

    angle: float
    velocity: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class Way:
    """A deviation that dies out within a time, and with it its velocity and its acceleration.

    The polynomial of fifth order that has all six; between two rests it is the motion of least jerk.

    Attributes:
        start: When it begins [s].
        duration: When it is over, after its start [s], > 0.
        angle: Deviation at the start [rad].
        velocity: Its velocity there [rad/s].
        acceleration: Its acceleration there [rad/s^2].

    Source: Flash, Hogan, J. Neuroscience 5(7), 1985, equation 3 (least jerk).
    """

    start: float
    duration: float
    angle: float
    velocity: float = 0.0
    acceleration: float = 0.0

    def at(self, t: float) -> Motion:
        """Return the deviation at a time [s]."""
        s = (t - self.start) / self.duration
        if s >= 1.0:
            return Motion(0.0, 0.0, 0.0)
        s = max(s, 0.0)
        c0, c1 = self.angle, self.velocity * self.duration
        c2 = 0.5 * self.acceleration * self.duration**2
        c3 = -10.0 * c0 - 6.0 * c1 - 3.0 * c2
        c4 = 15.0 * c0 + 8.0 * c1 + 3.0 * c2
        c5 = -6.0 * c0 - 3.0 * c1 - c2
        return Motion(
            c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5)))),
            (c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / self.duration,
            (2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))) / self.duration**2,
        )


@dataclass(frozen=True, slots=True)
class Reference:
    """A periodic motion of the angle; its velocity and acceleration are continuous.

    Steps go to and fro between two angles. A step that the plant cannot follow would be an error by design, and one of
    limited acceleration a torque that jumps: each is a motion of least jerk within ``move_time``, followed by rest.

    Attributes:
        shape: ``sine`` or ``steps``.
        centre: Angle about which it moves, from upright [rad].
        amplitude: How far it goes to either side [rad].
        frequency: How often it repeats itself [Hz], > 0.
        move_time: Of steps: duration of each [s], > 0 and at most half a period.
    """

    shape: str
    centre: float
    amplitude: float
    frequency: float
    move_time: float

    @property
    def period(self) -> float:
        """Time after which it repeats itself [s]."""
        return 1.0 / self.frequency

    @property
    def fastest(self) -> float:
        """Largest velocity [rad/s]."""
        if self.shape == "sine":
            return 2.0 * math.pi * self.frequency * self.amplitude
        # Half-way through a motion of least jerk: 15/8 of its mean velocity.
        return 1.875 * 2.0 * self.amplitude / self.move_time

    def at(self, t: float) -> Motion:
        """Return where it is at a time since its start [s]."""
        if self.shape == "sine":
            w = 2.0 * math.pi * self.frequency
            sine, cosine = math.sin(w * t), math.cos(w * t)
            a = self.amplitude
            return Motion(self.centre + a * sine, a * w * cosine, -a * w * w * sine)
        half = 0.5 * self.period
        count = math.floor(t / half)
        # Up in even halves, down in odd ones; what is left of a move dies out at its end.
        end = self.amplitude if count % 2 == 0 else -self.amplitude
        angle, velocity, acceleration = Way(count * half, self.move_time, -2.0 * end).at(t)
        return Motion(self.centre + end + angle, velocity, acceleration)
