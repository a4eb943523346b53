"""Sign of a joint: a hand turns the link a little counter-clockwise, and the joint angle must grow.

Only this reveals the sign: a pendulum with mirrored angle and torque obeys the same equation. No torque is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pendulum_hw_bridge.port.actuator import ActuatorPort
from pendulum_hw_bridge.port.feedback_stream import feedback_for

__all__ = ["EMULATED_NUDGE", "NUDGE_ANGLE", "EmulatedHand", "Hand", "Person", "hand_of", "watch_nudge"]

NUDGE_ANGLE = 0.1
"""Rotation that counts as a nudge [rad]: six degrees, far more than a touch."""
EMULATED_NUDGE = 6.0
"""Torque of the emulated hand [N m]: half a rad/s against the shorted winding."""
_PATIENCE = 30.0


class Hand(Protocol):
    """Turns the link."""

    def begin(self) -> None:
        """Start turning."""

    def end(self, *, seen: bool = True) -> None:
        """Release; ``seen`` if the rotation was detected."""


@dataclass
class Person:
    """A person, prompted through ``say`` to turn the link in direction ``way``."""

    say: Callable[[str], None]
    way: str = "COUNTER-CLOCKWISE"

    def begin(self) -> None:
        """Show the prompt."""
        self.say(
            f"The motor gets no torque. Turn the link by hand, slowly, a little {self.way} as you look at it "
            f"(about 10 degrees), then let go. Waiting for {_PATIENCE:g} s."
        )

    def end(self, *, seen: bool = True) -> None:
        """Report whether the rotation was detected."""
        self.say("Seen; let go." if seen else "Nothing was seen; let go.")


@dataclass
class EmulatedHand:
    """A torque on an emulator's link by ``push`` [N m]; ``direction`` 1 is counter-clockwise, -1 clockwise."""

    push: Callable[[float], None]
    direction: int = 1

    def begin(self) -> None:
        """Push."""
        self.push(self.direction * EMULATED_NUDGE)

    def end(self, *, seen: bool = True) -> None:
        """Release."""
        self.push(0.0)


def hand_of(port: ActuatorPort, say: Callable[[str], None], *, clockwise: bool = False) -> Hand:
    """Return the emulated hand of an emulator, or a person elsewhere, for either direction."""
    push = getattr(port, "push", None)
    if push is not None:
        return EmulatedHand(push, -1 if clockwise else 1)
    return Person(say, "CLOCKWISE" if clockwise else "COUNTER-CLOCKWISE")


def watch_nudge(port: ActuatorPort, hand: Hand, *, patience: float = _PATIENCE) -> float:
    """Return the rotation by the hand [rad], in the actuator's own sign; 0 without one within ``patience`` [s].

    Raises:
        ActuatorError: Feedback stops.
    """
    start: float | None = None
    seen = False
    hand.begin()
    try:
        for record in feedback_for(port, patience):
            start = record.position if start is None else start
            seen = abs(record.position - start) > NUDGE_ANGLE
            if seen:
                return record.position - start
        return 0.0
    finally:
        hand.end(seen=seen)
