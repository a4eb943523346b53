"""When a run has to be over: its steps ask before they begin, and while they wait."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

from pendulum_msgs_py.errors import PendulumError

__all__ = ["NEVER", "BudgetSpentError", "Deadline", "slowness"]

_OWN_LOAD = 2.0
"""Programs of a run that want to run at once: this one, and of the machine's one at a time."""


class BudgetSpentError(PendulumError):
    """The budget of a run is spent, or what is left does not suffice for the next step."""


def slowness() -> float:
    """Return how many times longer than alone a computation takes, by the programs that others want to run."""
    return max(1.0, (os.getloadavg()[0] - _OWN_LOAD) / (os.cpu_count() or 1))


class Deadline:
    """A wall time at which something has to be over.

    Args:
        seconds: From now on; infinite for never [s].
        reserve: Processor time that has to be left at the end [s]; at most half of all.
        clock: Monotonic clock [s].
    """

    def __init__(
        self, seconds: float = math.inf, reserve: float = 0.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._seconds, self._reserve, self._clock = seconds, reserve, clock
        self._ends = clock() + seconds

    @property
    def total_left(self) -> float:
        """Time left, the reserve included [s]."""
        return self._ends - self._clock()

    @property
    def left(self) -> float:
        """Time left without the reserve, which is longer on a busy computer [s]."""
        return (
            self.total_left - min(self._reserve * slowness(), 0.5 * self._seconds) if self._reserve else self.total_left
        )

    def share(self, share: float) -> Deadline:
        """Return the deadline of a part that may take a share of what is left now."""
        return Deadline(max(0.0, share * self.left), clock=self._clock)

    def require(self, seconds: float = 0.0) -> None:
        """Refuse a step for which no time is left.

        Args:
            seconds: Processor time that it takes and cannot be ended in [s].

        Raises:
            BudgetSpentError: It would end too late.
        """
        if self.left <= (seconds * slowness() if seconds else 0.0):
            raise BudgetSpentError(f"the budget of {self._seconds:g} s is spent")


NEVER = Deadline()
"""No deadline."""
