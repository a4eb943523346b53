"""Typed values that travel between plant, controller and recorder: tuples in the order of the joints, also for one."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["NANOSECONDS", "JointCommand", "JointSample", "Vector", "written"]

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second; stamps are integers of nanoseconds so that no time is ever rounded."""

Vector = tuple[float, ...]
"""One number per joint, in the order of the model."""


class JointSample(NamedTuple):
    """State of all n joints at one instant.

    Attributes:
        stamp_ns: Time of the measurement [ns].
        position: n positions; of the pendulum theta, 0 hanging down, pi upright [rad or m].
        velocity: n velocities [rad/s or m/s].
        effort: n measured efforts; NaN where none is measured [N m or N].
    """

    stamp_ns: int
    position: Vector
    velocity: Vector
    effort: Vector

    @classmethod
    def of_one(cls, stamp_ns: int, position: float, velocity: float, effort: float = 0.0) -> JointSample:
        """Return the state of a plant of one joint."""
        return cls(stamp_ns, (position,), (velocity,), (effort,))

    def is_finite(self) -> bool:
        """Return whether positions and velocities are finite numbers, and efforts too where they are measured."""
        finite = math.isfinite
        for value in self.position + self.velocity:  # twice as fast as all()
            if not finite(value):
                return False
        for value in self.effort:  # noqa: SIM110
            if math.isinf(value):
                return False
        return True


class JointCommand(NamedTuple):
    """Commanded efforts, in reply to one state.

    Attributes:
        stamp_ns: Stamp of the state that this command replies to [ns].
        effort: One effort for each joint that it names [N m or N].
        source: The commander (``header.frame_id``).
        joints: Joint names that the message carried; empty means "the only joint".
    """

    stamp_ns: int
    effort: Vector
    source: str = ""
    joints: tuple[str, ...] = ()

    @classmethod
    def of_one(cls, stamp_ns: int, effort: float, source: str = "", joints: tuple[str, ...] = ()) -> JointCommand:
        """Return a command for one joint."""
        return cls(stamp_ns, (effort,), source, joints)


def written(values: Vector, digits: str = "") -> str:
    """Return numbers as a message has them: one alone, several in brackets.

    Args:
        values: The numbers.
        digits: Format of each, such as ``.3f``; empty for all digits.
    """
    texts = [format(value, digits) if digits else str(value) for value in values]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"
