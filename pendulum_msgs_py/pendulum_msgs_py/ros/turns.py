"""Turns of a node that waits for an input itself, and of the executor that has its timers."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["INTERPRETED_SLICE", "LONGEST_SLICE", "WHILE_CALLED", "Turns"]

LONGEST_SLICE = 0.2
"""Longest time in which nobody but the input is attended to [s]; a request ends it, where it is looked for."""
INTERPRETED_SLICE = 0.02
"""The same where Python waits for the input, and looks for nothing else [s]."""
WHILE_CALLED = 0.005
"""The same while somebody calls, who may have to wait for their turn: compiled code ends at once then [s]."""


class Turns:
    """Lets an input and an executor take turns, for :class:`pendulum_msgs_py.ros.runner.Paced`.

    Args:
        serve: Attends to the input for a time at most [s]; returns whether anything came.
        events: Events that the executor may attend to after each slice, one at least. It must not fall behind what its
            node makes of them, and each look for one keeps the input waiting for 50 us.
    """

    def __init__(self, serve: Callable[[float], bool], events: int) -> None:
        self._serve = serve
        self._events = events
        self._left = 0

    def run_due(self) -> float:
        """Attend to the input, or leave the turn to the executor; return the time until this wants another turn [s]."""
        if self._left:
            self._left -= 1
        else:
            # Where nothing comes nothing is in a hurry, and each look at the executor costs.
            self._left = self._events - 1 if self._serve(LONGEST_SLICE) else 0
        return 0.0
