"""What each joint of a mechanism has: friction, ends of travel and an actuator."""

from __future__ import annotations

from dataclasses import dataclass

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.joints import Joint
from pendulum_msgs_py.parameters import ParameterSpec, reject_unknown, require_mapping
from pendulum_msgs_py.plants.quantities import read_quantities

__all__ = ["Actuator", "JointParameters", "actuator_specs", "check_joint", "joint_specs", "read_joint"]


@dataclass(frozen=True)
class Actuator:
    """The motor of one joint.

    Attributes:
        effort_limit: Largest torque or force, > 0 [N m or N].
        time_constant: First-order lag between command and effort; 0 for none [s].
        transport_delay: Time between a command and its first effect [s].
    """

    effort_limit: float
    time_constant: float = 0.0
    transport_delay: float = 0.0


@dataclass(frozen=True)
class JointParameters:
    """Friction, ends of travel and actuator of one joint.

    Attributes:
        damping: Viscous friction [N m s/rad or N s/m].
        coulomb_friction: Dry friction while sliding fast [N m or N].
        static_friction: Dry friction at which sliding starts; None for the same [N m or N].
        stribeck_velocity: Velocity over which the one falls to the other [rad/s or m/s].
        lower_stop: Lowest position, where an end stop holds; None for none [rad or m].
        upper_stop: Highest position [rad or m].
        actuator: The motor; None for a passive joint.
    """

    damping: float = 0.0
    coulomb_friction: float = 0.0
    static_friction: float | None = None
    stribeck_velocity: float = 0.01
    lower_stop: float | None = None
    upper_stop: float | None = None
    actuator: Actuator | None = None

    @property
    def breakaway(self) -> float:
        """Dry friction at which sliding starts [N m or N]."""
        return self.coulomb_friction if self.static_friction is None else self.static_friction


def joint_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of what a plant file may say of a joint, in its units."""
    effort = joint.effort_unit
    return (
        ParameterSpec("damping", 0.0, joint.damping_unit, "Viscous friction.", minimum=0.0),
        ParameterSpec("coulomb_friction", 0.0, effort, "Dry friction while sliding fast.", minimum=0.0),
        ParameterSpec("static_friction", 0.0, effort, "Dry friction at which sliding starts.", minimum=0.0),
        ParameterSpec(
            "stribeck_velocity", 0.01, joint.velocity_unit, "Velocity over which the static friction falls to Coulomb.",
            minimum=0.0, exclusive_minimum=True,
        ),
        ParameterSpec("lower_stop", 0.0, joint.unit, "Lowest position, at an end stop."),
        ParameterSpec("upper_stop", 0.0, joint.unit, "Highest position, at an end stop."),
    )  # fmt: skip


def actuator_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of what a plant file may say of a joint's actuator, in its units."""
    return (
        ParameterSpec(
            "effort_limit", 1.0, joint.effort_unit, "Largest effort of the actuator.",
            minimum=0.0, exclusive_minimum=True,
        ),
        ParameterSpec("time_constant", 0.0, "s", "First-order lag between command and effort.", minimum=0.0),
        ParameterSpec("transport_delay", 0.0, "s", "Time between a command and its first effect.", minimum=0.0),
    )  # fmt: skip


def read_joint(joint: Joint, entry: object, where: str) -> tuple[JointParameters, dict[str, list[float]]]:
    """Return what a plant file says of a joint, and the intervals in it by name.

    Args:
        joint: Which one.
        entry: What stands there.
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
