"""Feedback as it comes, and a word as soon as it stays away: nobody waits half a minute for a module that has gone."""

from __future__ import annotations

from collections.abc import Iterator

from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["LONGEST_SILENCE", "feedback_for"]

LONGEST_SILENCE = 1.0
"""Time without a record after which a module counts as lost to a procedure [s]."""
_WAIT = 0.05


def feedback_for(port: ActuatorPort, seconds: float) -> Iterator[Feedback]:
    """Yield the records that come within a time.

    Args:
        port: The actuator, connected.
        seconds: For how long to listen, by the port's clock [s].

    Raises:
        ActuatorError: No record came for :data:`LONGEST_SILENCE`.
    """
    heard_ns = port.now_ns()
    end_ns = heard_ns + round(seconds * NANOSECONDS)
    while port.now_ns() < end_ns:
        record = port.read(_WAIT)
        if record is not None:
            heard_ns = port.now_ns()
            yield record
        elif port.now_ns() - heard_ns > LONGEST_SILENCE * NANOSECONDS:
            raise ActuatorError(
                "feedback_lost",
                f"no feedback for {LONGEST_SILENCE:g} s; expected it to flow: is the module still there?",
            )
