"""When a run has to be over: its steps check before they begin, and while they wait."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

from pendulum_msgs_py.errors import PendulumError

__all__ = ["NEVER", "BudgetSpentError", "Deadline", "slowness"]

_OWN_LOAD = 2.0
"""Programs of a run that run at once: this one, and one at a time of the machine's."""


class BudgetSpentError(PendulumError):
    """The budget of a run is spent, or does not suffice for the next step."""


def slowness() -> float:
    """Return the slowdown of a computation by other runnable programs, 1 when alone."""
    return max(1.0, (os.getloadavg()[0] - _OWN_LOAD) / (os.cpu_count() or 1))


class Deadline:
    """A wall time limit, ``seconds`` from now or infinite, by a monotonic ``clock`` [s].

    ``reserve`` is processor time that must be left at the end [s], at most half of all.
    """

    def __init__(
        self, seconds: float = math.inf, reserve: float = 0.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._seconds, self._reserve, self._clock = seconds, reserve, clock
        self._ends = clock() + seconds

    @property
    def total_left(self) -> float:
        """Time left, including the reserve [s]."""
        return self._ends - self._clock()

    @property
    def left(self) -> float:
        """Time left without the reserve, which is longer on a busy computer [s]."""
        return (
            self.total_left - min(self._reserve * slowness(), 0.5 * self._seconds) if self._reserve else self.total_left
        )

    def share(self, share: float) -> Deadline:
        """Return the deadline of a part that may take a share of the time left."""
        return Deadline(max(0.0, share * self.left), clock=self._clock)

    def require(self, seconds: float = 0.0) -> None:
        """Raise BudgetSpentError if a step of ``seconds`` of uninterruptible processor time would end too late."""
        if self.left <= (seconds * slowness() if seconds else 0.0):
            raise BudgetSpentError(f"the budget of {self._seconds:g} s is spent")


NEVER = Deadline()
"""No deadline."""
