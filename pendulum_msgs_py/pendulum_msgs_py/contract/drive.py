"""Modes, inputs and limits of a plant, and the drive that it applies until the next decision."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.values import Vector
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
        # Runs several times a period; a set would hash the members, which enum does in Python.
        return self is Mode.EFFORT or self is Mode.POSITION


class Input(str, Enum):
    """The inputs that carry torque."""

    EFFORT_COMMAND = "effort_command"
    DISTURBANCE = "disturbance"
    PUSH = "push"


class DriveKind(str, Enum):
    """What the plant applies until the next decision."""

    OFF = "off"
    EFFORT = "effort"
    POSITION = "position"


class Drive(NamedTuple):
    """One decision, for the m driven joints of n; the defaults are those of one joint.

    Attributes:
        kind: Off (zero effort, drive released), effort, or position control.
        effort: m commands; under position control the feed-forward of the handover [N m or N, or V].
        position: m set points [rad or m], for ``POSITION``.
        velocity: Their velocities.
        controller: The controller's share of the commands, before limits.
        disturbance: The disturbance's share.
        push: n efforts on the joints themselves, applied in every mode.
        saturated: A sum was clamped.
        starved: Armed for effort without a fresh command: zero torque.
        handover: Under position control, the remaining share of the handover from effort, 1 to 0 [-].
    """

    kind: DriveKind
    effort: Vector = (0.0,)
    position: Vector = (0.0,)
    velocity: Vector = (0.0,)
    controller: Vector = (0.0,)
    disturbance: Vector = (0.0,)
    push: Vector = (0.0,)
    saturated: bool = False
    starved: bool = False
    handover: float = 0.0


@dataclass(frozen=True)
class PlantLimits:
    """Limits that a plant enforces; a scalar holds for each joint, in its own unit.

    Attributes:
        effort: Largest command of each driven joint, after the sum of controller and disturbance [N m or N, or V].
        command_timeout: Age at which a command is ignored [s].
        feedback_timeout: Age of the measurement at which an armed plant faults [s].
        velocity: Speed at which an armed plant faults, and largest of a trajectory [rad/s].
        position_min: Lower end of each joint's position window; ``(-inf,)`` for none [rad or m].
        position_max: Upper ends; ``(inf,)`` for none.
        slew: Largest rate of a rising torque; it falls at once [N m/s].
        handover_time: Time over which torque passes between position and effort control [s].
        tracking_error: Distance from the trajectory at which the plant faults [rad].
        arm_effort: Largest command that may wait when the plant is armed [N m].
        handover_effort: Largest distance between the holding torque and a command that takes over [N m].
        handover_sum: The same for its sum with a waiting disturbance [N m].
        start_effort: Largest first torque of a commander [N m].
        start_sum: The same for its sum with a waiting disturbance [N m].
        stop_time: Time over which torque fades at e-stop and disarm, stop category 1; 0 for category 0 [s].
        starvation: Time without a command after which a plant armed for effort disarms [s].
        enable_timeout: Silence of the hold-to-run switch that disarms; infinity for no switch [s].
        push: Effort of each driven joint that scales its largest push [N m or N]; empty for ``effort``.
        coordinates: Joints that give the messages their units.
    """

    effort: Vector
    command_timeout: float = 0.05
    feedback_timeout: float = math.inf
    velocity: float = math.inf
    position_min: Vector = (-math.inf,)
    position_max: Vector = (math.inf,)
    slew: float = math.inf
    handover_time: float = 0.1
    tracking_error: float = 0.3
    arm_effort: float = 0.5
    handover_effort: float = 2.0
    handover_sum: float = math.inf
    start_effort: float = math.inf
    start_sum: float = math.inf
    starvation: float = math.inf
    stop_time: float = 0.0
    enable_timeout: float = math.inf
    push: Vector = ()
    coordinates: Coordinates = field(default=ONE_JOINT, compare=False, repr=False)

    def __post_init__(self) -> None:
        of_position, of_velocity, _ = self.coordinates.units
        of_effort = self.coordinates.drive_unit
        for effort in self.effort:
            if not (math.isfinite(effort) and effort > 0.0):
                raise ParameterError(f"effort_limit is {effort} {of_effort}; expected a finite number > 0")
        if not all(math.isfinite(effort) and effort > 0.0 for effort in self.push):
            raise ParameterError(f"push is {self.push}; expected finite numbers > 0")
        if not (math.isfinite(self.command_timeout) and self.command_timeout > 0.0):
            raise ParameterError(f"command_timeout is {self.command_timeout} s; expected a finite number > 0")
        for name, unit in (
            ("feedback_timeout", "s"),
            ("velocity", of_velocity),
            ("slew", self.coordinates.slew_unit),
            ("handover_effort", of_effort),
            ("handover_sum", of_effort),
            ("start_effort", of_effort),
            ("start_sum", of_effort),
            ("starvation", "s"),
            ("enable_timeout", "s"),
        ):
            if not getattr(self, name) > 0.0:  # negated: NaN compares false
                raise ParameterError(f"{name} is {getattr(self, name)} {unit}; expected > 0")
        for name, unit in (("handover_time", "s"), ("stop_time", "s"), ("arm_effort", of_effort)):
            if not getattr(self, name) >= 0.0:
                raise ParameterError(f"{name} is {getattr(self, name)} {unit}; expected >= 0")
            if unit == "s" and not math.isfinite(getattr(self, name)):
                raise ParameterError(f"{name} is {getattr(self, name)} s; expected a finite number >= 0")
        if not self.tracking_error > 0.0:
            raise ParameterError(f"tracking_error is {self.tracking_error} {of_position}; expected > 0")
        for low, high in zip(self.position_min, self.position_max, strict=True):
            if not low < high:
                raise ParameterError(f"position window is [{low}, {high}] {of_position}; expected min < max")

    def for_joints(self, joints: int, driven: int) -> PlantLimits:
        """Return the limits with one position window per joint; raise a ParameterError for another number of joints."""
        if len(self.effort) != driven:
            raise ParameterError(f"there are {len(self.effort)} effort limits; expected {driven}, one per driven joint")
        if len(self.position_min) == joints:
            return self
        if self.position_min != (-math.inf,) or self.position_max != (math.inf,):
            raise ParameterError(f"there are {len(self.position_min)} position windows; expected {joints}")
        return replace(self, position_min=joints * self.position_min, position_max=joints * self.position_max)
