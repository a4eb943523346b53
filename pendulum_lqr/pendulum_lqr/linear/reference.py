"""Periodic references of the angle, and smooth transitions onto them.

A reference is computed from parameters and stamps: delay and losses of a topic would differ between simulator and
machine. If no transition is within the torque, the controller gives none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["SHAPES", "Motion", "Reference", "Way"]

SHAPES = ("sine", "steps")
"""Names of the references."""


class Motion(NamedTuple):
    """Reference angle from upright, not wrapped [rad], velocity [rad/s] and acceleration [rad/s^2]."""

    angle: float
    velocity: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class Way:
    """A deviation that decays within ``duration`` [s], with its velocity and acceleration: a fifth-order polynomial.

    Between two rests it is the minimum-jerk motion. Times in [s]; angle [rad], velocity [rad/s] and acceleration
    [rad/s^2] are those at the start. Source: Flash, Hogan, J. Neuroscience 5(7), 1985, equation 3 (minimum jerk).
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
    """A periodic motion of the angle with continuous velocity and acceleration.

    Steps alternate between two angles, each by a minimum-jerk motion within ``move_time`` and then rest: a
    discontinuous step would be an error by design, and one of limited acceleration a discontinuous torque.

    Attributes:
        shape: ``sine`` or ``steps``.
        centre: Centre, from upright [rad].
        amplitude: [rad].
        frequency: [Hz], > 0.
        move_time: Duration of each step [s], > 0 and at most half a period.
    """

    shape: str
    centre: float
    amplitude: float
    frequency: float
    move_time: float

    @property
    def period(self) -> float:
        """Period [s]."""
        return 1.0 / self.frequency

    @property
    def fastest(self) -> float:
        """Largest velocity [rad/s]."""
        if self.shape == "sine":
            return 2.0 * math.pi * self.frequency * self.amplitude
        # The peak velocity of a minimum-jerk motion is 15/8 of its mean.
        return 1.875 * 2.0 * self.amplitude / self.move_time

    def at(self, t: float) -> Motion:
        """Return the motion at a time since the start [s]."""
        if self.shape == "sine":
            w = 2.0 * math.pi * self.frequency
            sine, cosine = math.sin(w * t), math.cos(w * t)
            a = self.amplitude
            return Motion(self.centre + a * sine, a * w * cosine, -a * w * w * sine)
        half = 0.5 * self.period
        count = math.floor(t / half)
        # Up in even halves, down in odd ones.
        end = self.amplitude if count % 2 == 0 else -self.amplitude
        angle, velocity, acceleration = Way(count * half, self.move_time, -2.0 * end).at(t)
        return Motion(self.centre + end + angle, velocity, acceleration)
