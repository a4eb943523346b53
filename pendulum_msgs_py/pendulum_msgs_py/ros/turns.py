"""Turns between an input that a node waits for itself, and the executor with its timers."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["INTERPRETED_SLICE", "LONGEST_SLICE", "WHILE_CALLED", "Turns"]

LONGEST_SLICE = 0.2
"""Longest time for the input alone [s]; a request ends it, where polled."""
INTERPRETED_SLICE = 0.02
"""The same if Python waits for the input, without polling requests [s]."""
WHILE_CALLED = 0.005
"""The same while a request is pending, at which compiled code ends [s]."""


class Turns:
    """Lets an input and an executor take turns, for :class:`pendulum_msgs_py.ros.runner.Paced`.

    ``serve`` serves the input at most a time [s] and returns whether anything came. After each slice the executor
    handles ``events`` >= 1, enough for the node's own; each poll for one delays the input by 50 us.
    """

    def __init__(self, serve: Callable[[float], bool], events: int) -> None:
        self._serve = serve
        self._events = events
        self._left = 0

    def run_due(self) -> float:
        """Serve the input, or leave the turn to the executor; return the time until the next turn [s]."""
        if self._left:
            self._left -= 1
        else:
            # An idle input leaves one event only: each poll of the executor costs.
            self._left = self._events - 1 if self._serve(LONGEST_SLICE) else 0
        return 0.0
