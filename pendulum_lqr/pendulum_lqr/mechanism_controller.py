"""What every controller of a plant of several joints offers."""

from __future__ import annotations

from typing import Protocol

from pendulum_msgs_py.joints import Vector

__all__ = ["MechanismController"]


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
