"""Result of a trajectory goal, from the events of the plant.

A plant receives trajectories on a topic and reports on ``events``; an action ends once: reached, cancelled, or given
up.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.names import JOINT, Event

__all__ = ["End", "Outcome", "PlantFollowing", "goal_problem"]

_COMMANDED_BY = "commanded by "
"""Start of a plant's reason for effort control."""
_POSITION, _EFFORT = Mode.POSITION.value, Mode.EFFORT.value


class Outcome(enum.Enum):
    """How a goal ended; the values are the error codes of ``control_msgs/action/FollowJointTrajectory``."""

    REACHED = 0
    CANCELLED = 1
    """No error code: the action has a state for it."""
    REFUSED = -1
    WRONG_JOINTS = -2
    LEFT = -4
    """The plant stopped following."""


@dataclass(frozen=True)
class End:
    """How a goal ended, and why."""

    outcome: Outcome
    reason: str


def goal_problem(joints: list[str], other_joints: list[str], tolerances: Mapping[str, int]) -> End | None:
    """Return why a goal is refused here, or None; the plant itself checks points, limits and times.

    Args:
        joints: Joints of its trajectory.
        other_joints: Joints of several degrees of freedom.
        tolerances: Number of tolerances by the name of their list.
    """
    if joints != [JOINT] or other_joints:
        return End(Outcome.WRONG_JOINTS, f"goal is for joints {[*joints, *other_joints][:5]}; expected [{JOINT!r}]")
    given = [name for name, count in tolerances.items() if count]
    if given:
        return End(
            Outcome.REFUSED,
            f"goal has {', '.join(given)}; expected none: the plant has a tolerance of its own, its parameter "
            "tracking_error, and faults beyond it",
        )
    return None


class PlantFollowing:
    """One plant, and at most one goal that it follows.

    The plant reports neither the sender of a trajectory nor its replacement by another. So a goal is started only while
    it follows none, and given up when another sender publishes one.
    """

    def __init__(self) -> None:
        self._busy = False
        self._begun = False
        self._cancelled = False
        self.active = False

    @property
    def busy(self) -> bool:
        """Whether the plant follows a trajectory of any sender."""
        return self._busy

    def begin(self) -> None:
        """Record that a goal has been sent to the plant."""
        self.active, self._begun, self._cancelled = True, False, False

    def cancel(self) -> None:
        """Record that the plant was requested to hold its position."""
        self._cancelled = True

    def on_event(self, event: Mapping[str, Any]) -> End | None:
        """Process an event with ``name``, and maybe ``mode`` and ``reason``; return how the goal ended, or None."""
        name, mode, reason = event.get("name"), event.get("mode"), str(event.get("reason", ""))
        if name == Event.PLANT_MODE:
            self._busy = mode == _POSITION
            if not self.active:
                return None
            if self._busy:
                self._begun = True
                return None
            if mode == _EFFORT:
                # Torque commands are possible before it follows, but not again before the end.
                if not self._begun:
                    return None
                if reason.startswith(_COMMANDED_BY):
                    return self._at_the_end(reason)
                # Nor does it wait for torques at the end, which a plant that has just started does.
                return self._end(Outcome.LEFT, f"plant is {mode}, as if it had started again: {reason}")
            return self._end(Outcome.LEFT, f"plant is {mode}: {reason}")
        if name == Event.TRAJECTORY_FINISHED:
            self._busy = False
            if self.active and (self._begun or self._cancelled):
                return self._at_the_end(reason)
        elif name == Event.TRAJECTORY_REFUSED and self.active:
            if self._cancelled:
                return self._end(Outcome.LEFT, f"plant did not hold where it was: {reason}")
            if not self._begun:
                return self._end(Outcome.REFUSED, reason)
        return None

    def on_other_trajectory(self) -> End | None:
        """Record that another sender published a trajectory."""
        return self._end(Outcome.LEFT, "another sender published a trajectory") if self.active else None

    def on_wait(self, seconds: float, patience: float) -> End | None:
        """Give the goal up if the plant has not reported within ``patience`` [s] of a request ``seconds`` [s] ago."""
        if not self.active or seconds <= patience or (self._begun and not self._cancelled):
            return None
        if self._cancelled:
            return self._end(Outcome.LEFT, f"plant did not say within {patience:g} s that it holds where it was")
        return self._end(Outcome.LEFT, f"plant did not begin within {patience:g} s, and did not say why")

    def on_silence(self, seconds: float) -> End | None:
        """Record the time since the plant's last message [s]."""
        if not self.active:
            return None
        return self._end(Outcome.LEFT, f"plant has been silent for {seconds:.1f} s; whether it moves is not known")

    def _at_the_end(self, reason: str) -> End:
        if self._cancelled:
            return self._end(Outcome.CANCELLED, "holding where it was")
        return self._end(Outcome.REACHED, reason)

    def _end(self, outcome: Outcome, reason: str) -> End:
        self.active = False
        return End(outcome, reason)
