"""Torques in a picture of a plant: those that act, not those that are commanded."""

from __future__ import annotations

import math

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand

__all__ = ["SHOWN_TOPICS", "ShownTorques"]

SHOWN_TOPICS = (names.APPLIED_EFFORT, names.EFFORT_COMMAND, names.DISTURBANCE, names.PUSH)
"""Topics that :class:`ShownTorques` reads."""
_STALE_NS = NANOSECONDS // 2
"""Age from which a torque is not drawn, by the states' clock [ns]."""
_TOGETHER_NS = NANOSECONDS // 20
"""Largest distance between the stamps of command and disturbance that act together, a command's lifetime [ns]."""


class ShownTorques:
    """The newest torques of one plant."""

    def __init__(self) -> None:
        self.mode = ""
        self._newest: dict[tuple[str, str], tuple[int, float]] = {}

    def note(self, topic: str, command: JointCommand) -> None:
        """Record a message of one of ``SHOWN_TOPICS``; without names it is the pendulum's."""
        for joint, effort in zip(command.joints or (names.JOINT,), command.effort, strict=False):
            if math.isfinite(effort):
                self._newest[topic, joint] = (command.stamp_ns, effort)

    def acting_on(self, topic: str, now_ns: int, joints: tuple[str, ...]) -> dict[str, float]:
        """Return :meth:`acting` of those joints that were in a message, by name."""
        return {joint: self.acting(topic, now_ns, joint) for joint in joints if (topic, joint) in self._newest}

    @property
    def newest_ns(self) -> int:
        """Newest stamp [ns]; 0 before the first."""
        return max((stamp for stamp, _ in self._newest.values()), default=0)

    def acting(self, topic: str, now_ns: int, joint: str = names.JOINT) -> float:
        """Return the torque of a topic that acts on a joint at a time of the states' clock [ns], or 0 [N m or N].

        The plant adds a disturbance to a fresh command under torque control only, and the limit may cut it: what acts
        is the difference between applied and commanded torque.
        """
        stamp_ns, effort = self._newest.get((topic, joint), (0, 0.0))
        if (topic, joint) not in self._newest or abs(now_ns - stamp_ns) >= _STALE_NS:
            return 0.0
        if topic != names.DISTURBANCE:
            return effort
        applied_ns, applied = self._newest.get((names.APPLIED_EFFORT, joint), (0, 0.0))
        command_ns, command = self._newest.get((names.EFFORT_COMMAND, joint), (0, 0.0))
        together = max(applied_ns, command_ns, stamp_ns) - min(applied_ns, command_ns, stamp_ns) <= _TOGETHER_NS
        if not together or applied == 0.0 or self.mode not in {"", Mode.EFFORT.value}:
            return 0.0
        return max(min(0.0, effort), min(max(0.0, effort), applied - command))
