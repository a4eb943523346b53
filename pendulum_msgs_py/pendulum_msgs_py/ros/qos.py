"""Quality of service: one profile for each kind of topic."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

__all__ = ["COMMAND", "DIAGNOSTICS", "EVENTS", "NEWEST_STATE", "STATE", "TRAJECTORY"]


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


STATE = _profile(10)
"""Published states and applied effort: reliable, because a best-effort publisher never matches RViz or a recorder."""
NEWEST_STATE = _profile(1)
"""A controller's subscription: only the newest state is worth an answer."""
COMMAND = _profile(10)
"""Torque inputs; a few deep, so that a second commander is seen and not overwritten."""
TRAJECTORY = _profile(1)
EVENTS = _profile(100, DurabilityPolicy.TRANSIENT_LOCAL)
"""Phase changes of an experiment; late recorders get the earlier ones too."""
DIAGNOSTICS = _profile(10)
