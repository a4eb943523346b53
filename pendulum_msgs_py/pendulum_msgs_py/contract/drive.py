"""The words of a plant's decisions: modes, inputs, limits, and what to do until the next decision."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from pendulum_msgs_py.errors import ParameterError

__all__ = ["Drive", "DriveKind", "Input", "Mode", "PlantLimits"]


class Mode(str, Enum):
    """State of a plant; the value is shown in diagnostics."""

    DISARMED = "disarmed"
    POSITION = "armed_position"
    EFFORT = "armed_effort"
    FAULT = "fault"
    E_STOP = "e_stop"

    @property
    def armed(self) -> bool:
        """Whether torque may flow."""
        # Asked several times a period: a set would hash the members, which enum does in Python.
        return self is Mode.EFFORT or self is Mode.POSITION


class Input(str, Enum):
    """The inputs that carry torque."""

    EFFORT_COMMAND = "effort_command"
    DISTURBANCE = "disturbance"
    PUSH = "push"


class DriveKind(str, Enum):
    """What the plant has to do until the next decision."""

    OFF = "off"
    EFFORT = "effort"
    POSITION = "position"


class Drive(NamedTuple):
    """One decision.

    Attributes:
        kind: Off (zero torque, drive released), torque, or position control.
        effort: Torque to apply; under position control the feed-forward of the hand-over [N m].
        position: Position to hold or follow [rad], for ``POSITION``.
        velocity: Its velocity [rad/s].
        controller: The controller's share of the effort, before limits [N m].
        disturbance: The disturbance's share [N m].
        push: Torque on the link itself [N m]; applied whatever the kind, as a hand would.
        saturated: The sum was clamped.
        starved: Armed for effort, but without a fresh command of somebody who may command: zero torque.
        handover: Under position control, the share of the hand-over from effort that is still to go, 1 to 0 [-].
    """

    kind: DriveKind
    effort: float = 0.0
    position: float = 0.0
    velocity: float = 0.0
    controller: float = 0.0
    disturbance: float = 0.0
    push: float = 0.0
    saturated: bool = False
    starved: bool = False
    handover: float = 0.0


@dataclass(frozen=True)
class PlantLimits:
    """Limits that a plant keeps.

    Attributes:
        effort: Largest torque, after the sum of controller and disturbance [N m].
        command_timeout: Age at which a command counts for nothing [s].
        feedback_timeout: Age of the measurement at which an armed plant faults [s].
        velocity: Speed at which an armed plant faults, and largest of a trajectory [rad/s].
        position_min: Lower end of the position window [rad].
        position_max: Upper end [rad].
        slew: Largest rate of change of the torque [N m/s].
        handover_time: Time over which torque passes from position to effort control and back [s].
        tracking_error: Distance from the trajectory at which the plant faults [rad].
        arm_effort: Largest command that may be waiting when the plant is armed [N m].
        handover_effort: Largest distance of a command from the torque that holds, for it to take over [N m].
        start_effort: Largest torque with which a commander may begin where nobody commands [N m].
        starvation: Time without a command after which a plant that is armed for effort disarms [s].
    """

    effort: float
    command_timeout: float = 0.05
    feedback_timeout: float = math.inf
    velocity: float = math.inf
    position_min: float = -math.inf
    position_max: float = math.inf
    slew: float = math.inf
    handover_time: float = 0.1
    tracking_error: float = 0.3
    arm_effort: float = 0.5
    handover_effort: float = 2.0
    start_effort: float = math.inf
    starvation: float = math.inf

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing or everything; NaN, which compares false, would do the first."""
        if not (math.isfinite(self.effort) and self.effort > 0.0):
            raise ParameterError(f"effort_limit is {self.effort} N m; expected a finite number > 0")
        if not (math.isfinite(self.command_timeout) and self.command_timeout > 0.0):
            raise ParameterError(f"command_timeout is {self.command_timeout} s; expected a finite number > 0")
        for name, unit in (
            ("feedback_timeout", "s"),
            ("velocity", "rad/s"),
            ("slew", "N m/s"),
            ("start_effort", "N m"),
            ("starvation", "s"),
        ):
            if not getattr(self, name) > 0.0:
                raise ParameterError(f"{name} is {getattr(self, name)} {unit}; expected > 0")
        for name, unit in (("handover_time", "s"), ("arm_effort", "N m")):
            if not getattr(self, name) >= 0.0:
                raise ParameterError(f"{name} is {getattr(self, name)} {unit}; expected >= 0")
        if not math.isfinite(self.handover_time):
            raise ParameterError(f"handover_time is {self.handover_time} s; expected a finite number >= 0")
        if not self.handover_effort > 0.0:
            raise ParameterError(f"handover_effort is {self.handover_effort} N m; expected > 0")
        if not self.tracking_error > 0.0:
            raise ParameterError(f"tracking_error is {self.tracking_error} rad; expected > 0")
        if not self.position_min < self.position_max:
            raise ParameterError(
                f"position window is [{self.position_min}, {self.position_max}] rad; expected min < max"
            )
