"""Joints and coordinates: which joints wrap, where upright is, and which joints are driven."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.contract.names import EFFORT_TOPICS, JOINT, VOLTAGE_TOPICS, DriveTopics
from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.errors import ParameterError

__all__ = ["ONE_JOINT", "Coordinates", "Joint", "Vector"]


@dataclass(frozen=True)
class Joint:
    """One joint of a mechanism.

    Attributes:
        name: Name, also in messages.
        unit: Unit of its position: ``rad``, or ``m`` for a sliding joint.
        turns: Whether positions a whole turn apart are the same, so that deviations wrap.
        goal: Position where the mechanism is upright [rad or m].
    """

    name: str
    unit: str = "rad"
    turns: bool = True
    goal: float = 0.0

    def __post_init__(self) -> None:
        if self.unit not in {"rad", "m"} or (self.unit == "m" and self.turns):
            raise ParameterError(
                f"joint {self.name!r} has the unit {self.unit!r}, turns {self.turns}; expected rad, or m without turns"
            )

    @property
    def velocity_unit(self) -> str:
        """Unit of its velocity."""
        return f"{self.unit}/s"

    @property
    def effort_unit(self) -> str:
        """Unit of its torque or force."""
        return "N m" if self.unit == "rad" else "N"

    @property
    def gear_unit(self) -> str:
        """Unit of a motor's turns per motion of the joint."""
        return "-" if self.unit == "rad" else "rad/m"

    @property
    def damping_unit(self) -> str:
        """Unit of viscous friction."""
        return "N m s/rad" if self.unit == "rad" else "N s/m"

    @property
    def drag_unit(self) -> str:
        """Unit of quadratic drag."""
        return "N m s^2/rad^2" if self.unit == "rad" else "N s^2/m^2"


@dataclass(frozen=True)
class Coordinates:
    """Joints in the model's order, and which of them are driven.

    Attributes:
        joints: All n joints.
        driven: Indices of the m joints with an actuator, ascending.
        volts: Whether their commands are voltages of motors, on topics of their own; else efforts.
    """

    joints: tuple[Joint, ...]
    driven: tuple[int, ...]
    volts: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all joints, as in ``joint_states``."""
        return tuple(joint.name for joint in self.joints)

    @property
    def with_units(self) -> str:
        """Names of all joints with the units of their positions, for messages."""
        return ", ".join(f"{joint.name} [{joint.unit}]" for joint in self.joints)

    @property
    def driven_names(self) -> tuple[str, ...]:
        """Names of the driven joints, as in commands."""
        return tuple(self.joints[index].name for index in self.driven)

    @property
    def units(self) -> tuple[str, str, str]:
        """Units of position, velocity and joint effort, for messages; ``rad or m`` where joints differ."""
        every = zip(*((joint.unit, joint.velocity_unit, joint.effort_unit) for joint in self.joints), strict=True)
        position, velocity, effort = (" or ".join(dict.fromkeys(units)) for units in every)
        return position, velocity, effort

    @property
    def drive_unit(self) -> str:
        """Unit of the actuators' commands, for messages."""
        return (
            "V" if self.volts else " or ".join(dict.fromkeys(self.joints[index].effort_unit for index in self.driven))
        )

    @property
    def topics(self) -> DriveTopics:
        """Topics of commands in this unit."""
        return VOLTAGE_TOPICS if self.volts else EFFORT_TOPICS

    @property
    def slew_unit(self) -> str:
        """Unit of the rate of these commands, for messages."""
        return " or ".join(f"{unit}/s" for unit in self.drive_unit.split(" or "))

    @property
    def goal(self) -> Vector:
        """The upright position [rad or m]."""
        return tuple(joint.goal for joint in self.joints)

    def deviation(self, position: Sequence[float], goal: Sequence[float] | None = None) -> Vector:
        """Return n positions minus the goal (None for upright) [rad or m]; turning joints wrap to [-pi, pi)."""
        wanted = self.goal if goal is None else goal
        return tuple(
            wrap(q - g) if joint.turns else q - g for joint, q, g in zip(self.joints, position, wanted, strict=True)
        )

    def for_each(self, name: str, values: Sequence[float]) -> Vector:
        """Return n values of a parameter that has n or one for all; another number is a ParameterError."""
        n = len(self.joints)
        if len(values) not in {1, n}:
            raise ParameterError(
                f"{name} has {len(values)} values; expected {n}, for {self.with_units}, or one for all"
            )
        return tuple(values) if len(values) == n else (values[0],) * n

    def spread(self, effort: Sequence[float]) -> Vector:
        """Return m efforts of the driven joints as n, zero at passive joints [N m or N]; another number is an error."""
        if len(effort) != len(self.driven):
            raise ParameterError(
                f"effort has {len(effort)} values; expected {len(self.driven)}, for {', '.join(self.driven_names)}"
            )
        values = [0.0] * len(self.joints)
        for index, value in zip(self.driven, effort, strict=True):
            values[index] = value
        return tuple(values)


ONE_JOINT = Coordinates((Joint(JOINT, goal=UPRIGHT),), (0,))
"""The pendulum: one hinge with a motor."""
