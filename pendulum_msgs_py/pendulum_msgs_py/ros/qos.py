"""Quality of service: one profile for each kind of topic."""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

__all__ = [
    "CLOCK",
    "COMMAND",
    "DIAGNOSTICS",
    "EVENTS",
    "LAST_WORDS",
    "STATE",
    "TRAJECTORY",
    "WATCHED_STATE",
    "command_input",
    "newest_state",
]


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


_KEPT = 2000
"""Messages that a fast publisher keeps for a reliable reader that is late, four seconds at 500 Hz.

With the usual ten, a recorder that the scheduler lets wait for 20 ms loses messages in spite of being reliable: a
writer that keeps the last ten overwrites what was not acknowledged yet.
"""

STATE = _profile(_KEPT)
"""Published states and applied effort: reliable, because a best-effort publisher never matches RViz or a recorder."""
COMMAND = _profile(_KEPT)
"""Published torques of controllers and disturbances."""
CLOCK = _profile(_KEPT)
"""Simulated time; for those who record it."""
TRAJECTORY = _profile(1)
EVENTS = _profile(100, DurabilityPolicy.TRANSIENT_LOCAL)
"""Phase changes of an experiment; late recorders get the earlier ones too."""
DIAGNOSTICS = _profile(100)
LAST_WORDS = Duration(seconds=0.2)
"""Longest wait of a node that ends for its reliable subscribers to have heard its last message."""


def newest_state(*, reliable: bool) -> QoSProfile:
    """Return a controller's subscription to states: only the newest is worth an answer.

    Args:
        reliable: For lockstep, where none may be lost. In real time the next state comes before a repeated one would,
            and acknowledging each costs a seventh of the loop.
    """
    return _input(1, reliable=reliable)


def command_input(*, reliable: bool) -> QoSProfile:
    """Return a plant's subscription to torques, a few deep, so that a second commander is seen and not overwritten.

    Args:
        reliable: As for :func:`newest_state`.
    """
    return _input(10, reliable=reliable)


def _input(depth: int, *, reliable: bool) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)


WATCHED_STATE = newest_state(reliable=False)
"""The subscription of those who only look: viewers, the conductor of an experiment."""
