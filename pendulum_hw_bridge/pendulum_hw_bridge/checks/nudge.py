"""Which way is counter-clockwise: a hand turns the link a little, and the joint angle has to grow.

No torque is needed, and nothing else tells: a pendulum with mirrored angle and torque obeys the same equation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pendulum_hw_bridge.port.actuator import ActuatorPort
from pendulum_hw_bridge.port.feedback_stream import feedback_for

__all__ = ["EMULATED_NUDGE", "NUDGE_ANGLE", "EmulatedHand", "Hand", "Person", "hand_of", "watch_nudge"]

NUDGE_ANGLE = 0.1
"""Turn that counts as a nudge [rad]; six degrees, far above what a touch does."""
EMULATED_NUDGE = 6.0
"""Torque of the emulated hand [N m]: half a rad/s against the shorted winding."""
_PATIENCE = 30.0


class Hand(Protocol):
    """Who turns the link."""

    def begin(self) -> None:
        """Begin to turn."""

    def end(self, *, seen: bool = True) -> None:
        """Let go; the turn was seen or not."""


@dataclass
class Person:
    """A person, who is asked in words.

    Attributes:
        say: Shows a sentence.
        way: Which way they shall turn it.
    """

    say: Callable[[str], None]
    way: str = "COUNTER-CLOCKWISE"

    def begin(self) -> None:
        """Ask for it."""
        self.say(
            f"The motor gets no torque. Turn the link by hand, slowly, a little {self.way} as you look at it "
            f"(about 10 degrees), then let go. Waiting for {_PATIENCE:g} s."
        )

    def end(self, *, seen: bool = True) -> None:
        """Say whether it was seen."""
        self.say("Seen; let go." if seen else "Nothing was seen; let go.")


@dataclass
class EmulatedHand:
    """A torque on the link of an emulated actuator.

    Attributes:
        push: The emulator's, [N m].
        direction: 1 for counter-clockwise, -1 for clockwise.
    """

    push: Callable[[float], None]
    direction: int = 1

    def begin(self) -> None:
        """Push."""
        self.push(self.direction * EMULATED_NUDGE)

    def end(self, *, seen: bool = True) -> None:
        """Let go."""
        self.push(0.0)


def hand_of(port: ActuatorPort, say: Callable[[str], None], *, clockwise: bool = False) -> Hand:
    """Return the emulated hand of an emulator, and a person elsewhere, for a turn counter-clockwise or clockwise."""
    push = getattr(port, "push", None)
    if push is not None:
        return EmulatedHand(push, -1 if clockwise else 1)
    return Person(say, "CLOCKWISE" if clockwise else "COUNTER-CLOCKWISE")


def watch_nudge(port: ActuatorPort, hand: Hand, *, patience: float = _PATIENCE) -> float:
    """Return by how far the actuator turned when the hand turned the link [rad], in its own sign.

    Zero where nothing moved within the patience.

    Args:
        port: The actuator, with its strategy off.
        hand: Who turns.
        patience: Longest time to wait [s].

    Raises:
        ActuatorError: Feedback stays away.
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
