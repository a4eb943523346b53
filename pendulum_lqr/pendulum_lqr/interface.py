"""What every controller offers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

__all__ = ["Controller"]


class Controller(Protocol):
    """What turns states into torques."""

    effort_limit: float

    def reset(self) -> None:
        """Forget everything: integrals, filters, phases."""

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m] that answers a state.

        Args:
            t: Time of the state since the controller was started [s]; it increases from call to call.
            x: [wrap(theta - pi) [rad], theta_dot [rad/s]].
        """

    def describe(self) -> str:
        """Return gains and figures in one line, for the log."""

    def carry_over(self, previous: Controller) -> None:
        """Take over integrals and filters from the controller that this one replaces, so that torque does not jump."""
