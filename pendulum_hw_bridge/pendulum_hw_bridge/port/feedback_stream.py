"""Stream of feedback records that fails as soon as the module stays silent."""

from __future__ import annotations

from collections.abc import Iterator

from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, Feedback
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["LONGEST_SILENCE", "feedback_for"]

LONGEST_SILENCE = 1.0
"""Time without a record after which a procedure considers a module lost [s]."""
_WAIT = 0.05


def feedback_for(port: ActuatorPort, seconds: float) -> Iterator[Feedback]:
    """Yield the records of the next ``seconds``; ActuatorError after :data:`LONGEST_SILENCE` without one."""
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
