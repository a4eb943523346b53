"""Quality of service: one profile for each kind of topic."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

__all__ = ["CLOCK", "COMMAND", "COMMAND_INPUT", "DIAGNOSTICS", "EVENTS", "NEWEST_STATE", "STATE", "TRAJECTORY"]


def _profile(
    depth: int,
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
) -> QoSProfile:
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability, durability=durability)


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
NEWEST_STATE = _profile(1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The subscription of controllers and viewers to states: only the newest is worth an answer, or a look.

Acknowledging each state and each torque would cost a seventh of a loop in real time and a tenth of its speed in
lockstep. Nothing needs it: in real time the next state comes before a repeated one would, and in lockstep the plant
publishes a state again that is not answered.
"""
COMMAND_INPUT = _profile(10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A plant's subscription to torques, a few deep, so that a second commander is seen and not overwritten."""
