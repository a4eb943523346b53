"""What each joint of a mechanism has: friction, ends of travel and an actuator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, reject_unknown, require_mapping
from pendulum_msgs_py.plants.quantities import Quantity, read_quantities, specs_of

__all__ = ["Actuator", "JointParameters", "actuator_specs", "check_joint", "joint_specs", "read_joint"]


_LARGEST_EFFORT = 1e4
"""More than any joint's drive gives, those of the largest robots included [N m or N]: beyond it a unit is wrong."""


@dataclass(frozen=True)
class Actuator:
    """The motor of one joint; ``effort_unit`` is the joint's."""

    effort_limit: Annotated[
        float,
        Quantity("effort_unit", "Largest effort of the actuator.", positive=True, example=1.0, largest=_LARGEST_EFFORT),
    ]
    time_constant: Annotated[float, Quantity("s", "First-order lag between command and effort.")] = 0.0
    transport_delay: Annotated[float, Quantity("s", "Time between a command and its first effect.")] = 0.0


@dataclass(frozen=True)
class JointParameters:
    """Friction, ends of travel and actuator of one joint; units such as ``effort_unit`` are the joint's.

    Where ``static_friction`` is None it is the Coulomb friction; a stop or an actuator that is None is not there.
    """

    damping: Annotated[float, Quantity("damping_unit", "Viscous friction.")] = 0.0
    coulomb_friction: Annotated[float, Quantity("effort_unit", "Dry friction while sliding fast.")] = 0.0
    static_friction: Annotated[float | None, Quantity("effort_unit", "Dry friction at which sliding starts.")] = None
    stribeck_velocity: Annotated[
        float,
        Quantity("velocity_unit", "Velocity over which the static friction falls to Coulomb.", positive=True),
    ] = 0.01
    lower_stop: Annotated[float | None, Quantity("unit", "Lowest position, at an end stop.", signed=True)] = None
    upper_stop: Annotated[float | None, Quantity("unit", "Highest position, at an end stop.", signed=True)] = None
    actuator: Actuator | None = None

    @property
    def breakaway(self) -> float:
        """Dry friction at which sliding starts [N m or N]."""
        return self.coulomb_friction if self.static_friction is None else self.static_friction


@cache
def joint_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of a joint's entries in a plant file, in its units."""
    return _in_units_of(joint, JointParameters)


@cache
def actuator_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of an actuator's entries in a plant file, in its joint's units."""
    return _in_units_of(joint, Actuator)


def _in_units_of(joint: Joint, kind: type) -> tuple[ParameterSpec, ...]:
    return tuple(replace(spec, unit=getattr(joint, spec.unit, spec.unit)) for spec in specs_of(kind))


def read_joint(joint: Joint, entry: object, where: str) -> tuple[JointParameters, dict[str, list[float]]]:
    """Return a joint's entries in a plant file, and the intervals in them by name.

    Args:
        joint: The joint.
        entry: The entry as parsed.
        where: Prefix of messages.

    Raises:
        ParameterError: An entry is unknown, missing or refused.
    """
    content = dict(require_mapping(entry if entry is not None else {}, where))
    has_actuator = "actuator" in content
    block = content.pop("actuator", None)
    reject_unknown(content, (*(spec.name for spec in joint_specs(joint)), "actuator"), where=where)
    values, intervals = read_quantities(content, joint_specs(joint), where)
    actuator = None
    if has_actuator:
        drive, more = read_quantities(block, actuator_specs(joint), f"{where}.actuator")
        if "effort_limit" not in drive:
            raise ParameterError(f"{where}.actuator.effort_limit is missing; expected a value in {joint.effort_unit}")
        actuator = Actuator(**drive)
        intervals.update(more)
    return JointParameters(**values, actuator=actuator), intervals


def check_joint(joint: Joint, own: JointParameters) -> None:
    """Refuse a value outside its domain, a static friction below the sliding one, and stops out of order.

    Raises:
        ParameterError: There is one.
    """
    for spec in joint_specs(joint):
        value = getattr(own, spec.name)
        if value is not None:
            spec.check(value, where=joint.name)
    if own.actuator is not None:
        for spec in actuator_specs(joint):
            spec.check(getattr(own.actuator, spec.name), where=f"{joint.name}.actuator")
    if own.breakaway < own.coulomb_friction:
        unit = joint.effort_unit
        raise ParameterError(
            f"{joint.name}: static_friction is {own.static_friction} {unit}; "
            f"expected >= coulomb_friction = {own.coulomb_friction} {unit}"
        )
    low, high = own.lower_stop, own.upper_stop
    if low is not None and high is not None and not low < high:
        raise ParameterError(f"{joint.name}: lower_stop is {low} {joint.unit}; expected < upper_stop = {high}")
