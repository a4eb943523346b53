"""Responses of an experiment's trial to the states of a plant: the procedure node without ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from pendulum_hw_bridge.nodes.procedures import HandMotion, Phase
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.trajectory import Trajectory, TrajectoryPoint
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample

__all__ = ["HandTrial", "StaircaseTrial", "Trial", "TrialAnswer", "join_phases"]

Event = tuple[int, str, dict[str, Any]]
"""Stamp [ns], name, details."""


@dataclass
class TrialAnswer:
    """Response to a state: torque of drive and link [N m], None for no message, and events to record."""

    effort: float | None = 0.0
    push: float | None = None
    events: list[Event] = field(default_factory=list)


class Trial:
    """One trial; numbers start at 1."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.start_ns: int | None = None
        self.finished = False
        self._asked_to_finish = False

    @property
    def started(self) -> bool:
        """Whether the trial has begun."""
        return self.start_ns is not None

    def start(self, sample: JointSample) -> None:
        """Begin with a state."""
        self.start_ns = sample.stamp_ns

    def finish(self) -> None:
        """End with the next state."""
        self._asked_to_finish = self.started

    def hear(self, event: str) -> str:
        """Process an event of the plant (JSON); return why the trial has failed, or an empty string."""
        return ""

    def answer(self, sample: JointSample) -> TrialAnswer:
        """Return the response to a state."""
        raise NotImplementedError


class HandTrial(Trial):
    """The link is turned by a simulated hand, or (None) by a person who ends the trial; the drive has zero torque."""

    def __init__(self, number: int, motion: HandMotion | None) -> None:
        super().__init__(number)
        self.motion = motion
        self._logged_start = False

    def answer(self, sample: JointSample) -> TrialAnswer:
        """Return zero torque for the drive, and the hand's torque for the link."""
        motion = self.motion
        push = None if motion is None else 0.0
        if self.start_ns is None or self.finished:
            return TrialAnswer(push=push)
        events: list[Event] = []
        if not self._logged_start:
            self._logged_start = True
            who = "a person" if motion is None else "simulated"
            direction = 0 if motion is None else motion.direction
            details = {"trial": self.number, "procedure": "hand", "hand": who, "direction": direction}
            events.append((self.start_ns, names.Event.TRIAL_START, details))
        time = (sample.stamp_ns - self.start_ns) / NANOSECONDS
        if self._asked_to_finish or (motion is not None and time >= motion.duration):
            self.finished = True
            events.append((sample.stamp_ns, names.Event.TRIAL_END, {"trial": self.number}))
            return TrialAnswer(push=push, events=events)
        if motion is not None:
            push = motion.torque(time, sample.position[0], sample.velocity[0])
        return TrialAnswer(push=push, events=events)


class StaircaseTrial(Trial):
    """The plant follows one trajectory through all phases.

    Args:
        number: Of the trial.
        phases: Phases in order.
        release: Whether zero torque is commanded at the end; otherwise the plant holds the last angle.
    """

    def __init__(self, number: int, phases: Sequence[Phase], *, release: bool = True) -> None:
        super().__init__(number)
        self._release = release
        self.trajectory, self._times = join_phases(phases)
        self._phases = list(phases)
        self._follows_since_ns: int | None = None
        self._next = 0
        self._asked = False

    def start(self, sample: JointSample) -> None:
        """Begin with a state, by sending the trajectory in place of a response."""
        super().start(sample)
        self._asked = True

    def hear(self, event: str) -> str:
        """Detect that the plant has started or refused the trajectory."""
        try:
            content = json.loads(event)
        except json.JSONDecodeError:
            return ""
        if not self.started or self.finished or not isinstance(content, dict):
            return ""
        name, mode = content.get("name"), content.get("mode")
        if name == names.Event.PLANT_MODE and mode == "armed_position":
            self._follows_since_ns = int(content["stamp_ns"])
        elif name == names.Event.TRAJECTORY_REFUSED or (
            name == names.Event.PLANT_MODE and mode in {"fault", "e_stop", "disarmed"}
        ):
            self.finished = True
            return f"the plant does not follow the staircase: {content.get('reason')}"
        return ""

    def answer(self, sample: JointSample) -> TrialAnswer:
        """Return no torque while the plant follows, so that it continues; zero before and after."""
        if self.start_ns is None:
            return TrialAnswer()
        if self.finished:
            return TrialAnswer(effort=self._last_effort)
        events: list[Event] = []
        if self._asked:
            self._asked = False
            details = {"trial": self.number, "procedure": "staircase"}
            events.append((self.start_ns, names.Event.TRIAL_START, details))
        if self._follows_since_ns is None:
            return TrialAnswer(effort=None, events=events)
        while self._next < len(self._phases):
            stamp_ns = self._follows_since_ns + round(self._times[self._next] * NANOSECONDS)
            if sample.stamp_ns < stamp_ns:
                break
            phase = self._phases[self._next]
            details = {"trial": phase.trial, "angle": math.degrees(phase.angle), "upwards": phase.upwards}
            events.append((stamp_ns, phase.name, details))
            self._next += 1
        end_ns = self._follows_since_ns + round(self.trajectory.duration * NANOSECONDS)
        if self._asked_to_finish or sample.stamp_ns >= end_ns:
            self.finished = True
            events.append((min(end_ns, sample.stamp_ns), names.Event.TRIAL_END, {"trial": self.number}))
            return TrialAnswer(effort=self._last_effort, events=events)
        return TrialAnswer(effort=None, events=events)

    @property
    def _last_effort(self) -> float | None:
        return 0.0 if self._release else None


def join_phases(phases: Sequence[Phase]) -> tuple[Trajectory, list[float]]:
    """Return one trajectory through all phases, and the start time of each [s]."""
    points: list[TrajectoryPoint] = []
    times = []
    now = 0.0
    for phase in phases:
        times.append(now)
        for point in phase.trajectory.points:
            # One point, not two, where phases meet.
            if not points or now + point.time > points[-1].time + 1e-9:
                points.append(TrajectoryPoint(now + point.time, point.position, point.velocity))
        now += phase.trajectory.duration if phase.hold == 0.0 else phase.hold
        if phase.hold > 0.0:
            points.append(TrajectoryPoint(now, phase.trajectory.goal, 0.0))
    return Trajectory(tuple(points)), times
