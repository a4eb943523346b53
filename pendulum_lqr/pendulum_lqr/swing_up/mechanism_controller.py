"""What every controller of a plant of several joints offers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from pendulum_msgs_py.contract.joints import Vector

__all__ = ["MechanismController", "within_limits"]


class MechanismController(Protocol):
    """What turns states into efforts."""

    def reset(self) -> None:
        """Forget everything: plans, phases, estimates."""

    def command(self, t: float, x: Vector) -> Vector:
        """Return m efforts, one per driven joint [N m or N].

        Args:
            t: Time since the controller was started [s]; it increases from call to call.
            x: n positions, hanging at 0 and not wrapped, then n velocities.
        """


def within_limits(wanted: Iterable[float], limits: Vector) -> Vector:
    """Return efforts within limits either way; NaN stays NaN, which the sender refuses."""
    return tuple(top if u > top else max(float(u), -top) for u, top in zip(wanted, limits, strict=True))
