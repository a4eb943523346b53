"""Quality of service: one profile for each kind of topic."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

__all__ = ["CLOCK", "COMMAND", "COMMAND_INPUT", "DIAGNOSTICS", "EVENTS", "NEWEST_STATE", "STATE", "TRAJECTORY"]


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


_KEPT = 2000
"""Messages that a fast publisher keeps for a reliable reader that is late, four seconds at 500 Hz.

With the usual ten, a recorder that the scheduler lets wait for 20 ms loses messages in spite of being reliable: a
writer that keeps the last ten overwrites what was not acknowledged yet.
"""

STATE = _profile(_KEPT)
"""Published states and applied effort: reliable, because a best-effort publisher never matches RViz or a recorder."""
NEWEST_STATE = _profile(1)
"""A controller's subscription: only the newest state is worth an answer."""
COMMAND = _profile(_KEPT)
"""Published torques of controllers and disturbances."""
COMMAND_INPUT = _profile(10)
"""A plant's torque inputs; a few deep, so that a second commander is seen and not overwritten."""
CLOCK = _profile(_KEPT)
"""Simulated time; for those who record it."""
TRAJECTORY = _profile(1)
EVENTS = _profile(100, DurabilityPolicy.TRANSIENT_LOCAL)
"""Phase changes of an experiment; late recorders get the earlier ones too."""
DIAGNOSTICS = _profile(100)
