"""Adds to commands of ros2_control's effort controllers the stamp of the state that they reply to.

These commands have no stamp to check, and effort controllers hold the last one for ever. Here each command becomes one
torque for the newest state and is never repeated, so that a silent controller triggers the plant's command timeout.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError

__all__ = ["EffortAdapter", "effort_of_array", "effort_of_joint"]


def effort_of_array(data: Sequence[float]) -> float:
    """Return the torque [N m] of a ``std_msgs/Float64MultiArray``; DataError unless it is one finite value."""
    if len(data) != 1:
        raise DataError(f"command has {len(data)} values; expected 1, the torque of {JOINT} [N m]")
    return _finite(data[0])


def effort_of_joint(joints: Sequence[str], efforts: Sequence[float]) -> float:
    """Return the torque [N m] for the pendulum's joint in a ``sensor_msgs/JointState`` of several joints.

    Raises:
        DataError: The joint is missing, efforts are missing, or its own is not finite.
    """
    if JOINT not in joints:
        raise DataError(f"command is for {', '.join(joints) or 'no joint'}; expected {JOINT}")
    if len(efforts) != len(joints):
        raise DataError(f"command has {len(efforts)} efforts for {len(joints)} joints; expected one for each")
    return _finite(efforts[joints.index(JOINT)])


def _finite(effort: float) -> float:
    if not math.isfinite(effort):
        raise DataError(f"command is {effort} N m; expected a finite torque")
    return float(effort)


class EffortAdapter:
    """Pairs commands with states.

    A command replies to the newest state at once; if that one has a reply it waits for the next, and a later command
    replaces it.

    Args:
        timeout: Age at which a waiting command is dropped [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout_ns = round(timeout * NANOSECONDS)
        self._newest_ns: int | None = None
        self._answered_ns = -1
        self._waiting: tuple[float, int] | None = None
        self.counts: Counter[str] = Counter()

    @property
    def newest_stamp_ns(self) -> int | None:
        """Stamp of the newest state [ns]."""
        return self._newest_ns

    @property
    def answered_ns(self) -> int | None:
        """Stamp of the newest state that got a command [ns]; None before the first of this plant."""
        return None if self._answered_ns < 0 else self._answered_ns

    def command(self, effort: float, now_ns: int) -> tuple[int, float] | None:
        """Process a command at steady time [ns]; return stamp [ns] and torque [N m] to publish, or None to wait."""
        self.counts["commands"] += 1
        if self._waiting is not None:
            self.counts["replaced"] += 1
        self._waiting = (effort, now_ns)
        return self._answer(now_ns)

    def state(self, stamp_ns: int, now_ns: int) -> tuple[int, float] | None:
        """Process a state at steady time [ns]; return stamp [ns] and torque [N m] of a waiting command, or None."""
        # The plant was restarted or reset.
        self._newest_ns = stamp_ns
        if stamp_ns < self._answered_ns:
            self._answered_ns = -1
        return self._answer(now_ns)

    def _answer(self, now_ns: int) -> tuple[int, float] | None:
        if self._waiting is None or self._newest_ns is None or self._newest_ns == self._answered_ns:
            return None
        (effort, since_ns), self._waiting = self._waiting, None
        if now_ns - since_ns > self._timeout_ns:
            self.counts["too_old"] += 1
            return None
        self._answered_ns = self._newest_ns
        self.counts["answers"] += 1
        return self._newest_ns, effort
