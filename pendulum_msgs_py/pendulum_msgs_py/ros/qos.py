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
"""History of a fast publisher for late reliable readers, four seconds at 500 Hz.

With the usual ten, a recorder delayed by 20 ms loses messages: the writer overwrites unacknowledged ones.
"""

STATE = _profile(_KEPT)
"""Published states and applied effort: reliable, as a best-effort publisher never matches RViz or a recorder."""
COMMAND = _profile(_KEPT)
"""Published torques of controllers and disturbances."""
CLOCK = _profile(_KEPT)
"""Simulated time; the history serves recorders."""
TRAJECTORY = _profile(1)
EVENTS = _profile(100, DurabilityPolicy.TRANSIENT_LOCAL)
"""Phase changes of an experiment; late recorders get the earlier ones too."""
DIAGNOSTICS = _profile(100)
NEWEST_STATE = _profile(1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Subscription of controllers and viewers to states.

Acknowledging each state and torque would cost a seventh of a real-time loop and a tenth of a lockstep run's speed. In
real time the next state precedes a repetition, and in lockstep the plant repeats an unanswered state.
"""
COMMAND_INPUT = _profile(10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A plant's subscription to torques, deep enough that a second commander is detected."""
