"""Values exchanged by plant, controller and recorder: tuples in the order of the joints, also for one joint."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["NANOSECONDS", "JointCommand", "JointSample", "Vector", "written"]

NANOSECONDS = 1_000_000_000
"""Nanoseconds in a second; stamps are integers, so that no time is rounded."""

Vector = tuple[float, ...]
"""One number per joint, in the order of the model."""


class JointSample(NamedTuple):
    """State of n joints at one instant.

    Attributes:
        stamp_ns: Time of the measurement [ns].
        position: n positions; theta is 0 hanging down, pi upright [rad or m].
        velocity: n velocities [rad/s or m/s].
        effort: n measured efforts, NaN if not measured [N m or N].
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
        """Return whether positions and velocities are finite, and efforts finite or NaN."""
        finite = math.isfinite
        for value in self.position + self.velocity:  # twice as fast as all()
            if not finite(value):
                return False
        for value in self.effort:  # noqa: SIM110
            if math.isinf(value):
                return False
        return True


class JointCommand(NamedTuple):
    """Commanded efforts in reply to one state.

    Attributes:
        stamp_ns: Stamp of that state [ns].
        effort: One effort for each named joint [N m or N].
        source: The commander (``header.frame_id``).
        joints: Joint names in the message; empty for the only joint.
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
    """Return numbers as text: one alone, several in brackets, in a format such as ``.3f``."""
    texts = [format(value, digits) if digits else str(value) for value in values]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"
