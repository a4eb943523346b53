"""Adds what commands of ros2_control's effort controllers lack: the stamp of the state that they reply to.

ros2_control's commands have no stamp that a plant could check, and its effort controllers hold the last one for ever.
Here each command becomes one torque, as the reply to the newest state; none is ever repeated, so that a silent
controller meets the plant's rule for stale commands.
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
    """Return the torque [N m] of a ``std_msgs/Float64MultiArray`` for a group of one joint.

    Raises:
        DataError: It has another number of values than one, or one that is not finite.
    """
    if len(data) != 1:
        raise DataError(f"command has {len(data)} values; expected 1, the torque of {JOINT} [N m]")
    return _finite(data[0])


def effort_of_joint(joints: Sequence[str], efforts: Sequence[float]) -> float:
    """Return the torque [N m] for the pendulum's joint in a ``sensor_msgs/JointState`` that commands several.

    Raises:
        DataError: The joint is not among them, efforts are missing, or its own is not finite.
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

    A command replies to the newest state at once; if that one has a reply it waits for the next, and a later
    command takes its place.

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
        """Take a command and return stamp [ns] and torque [N m] to publish, or None where it has to wait.

        Args:
            effort: Torque [N m].
            now_ns: Time on a steady clock [ns].
        """
        self.counts["commands"] += 1
        if self._waiting is not None:
            self.counts["replaced"] += 1
        self._waiting = (effort, now_ns)
        return self._answer(now_ns)

    def state(self, stamp_ns: int, now_ns: int) -> tuple[int, float] | None:
        """Take a state and return the reply to it, if a command was waiting.

        Args:
            stamp_ns: Its stamp [ns].
            now_ns: Time on the same steady clock [ns].
        """
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
