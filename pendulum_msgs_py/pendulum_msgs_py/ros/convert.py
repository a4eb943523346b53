"""Messages to typed values and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pendulum_msgs_py.contract.cdr import JointStateFields, decode_joint_state
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.joints import ONE_JOINT

__all__ = [
    "command_from_bytes",
    "diagnostic_status",
    "event_message",
    "fields_from_bytes",
    "plant_mode",
    "plant_value",
    "problem_of_command",
    "problem_of_state",
    "sample_from_bytes",
    "sample_from_message",
    "seconds_to_duration",
    "stamp_from_message",
    "stamp_of_state",
    "stamp_to_message",
    "trajectory_to_message",
]


_NO_JOINT_STATE = "its bytes are no sensor_msgs/JointState"


def stamp_to_message(stamp_ns: int) -> Time:
    """Return a ROS time from nanoseconds."""
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)


def stamp_from_message(stamp: Time) -> int:
    """Return nanoseconds from a ROS time."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def command_from_bytes(data: bytes) -> JointCommand | None:
    """Return the command that a serialised JointState carries, or None where it has not one effort for each name."""
    fields = decode_joint_state(data)
    if fields is not None:
        if not fields.effort:
            return None
        return JointCommand(fields.stamp_ns, fields.effort, fields.frame_id, fields.joints)
    message = _deserialise(data)
    if message is None or _problem_of_efforts(message):
        return None
    return JointCommand(
        stamp_from_message(message.header.stamp), tuple(message.effort), message.header.frame_id, tuple(message.name)
    )


def fields_from_bytes(data: bytes) -> JointStateFields | None:
    """Return what a serialised JointState holds, whatever its joints, to show it; None where it is none."""
    fields = decode_joint_state(data)
    if fields is None and (message := _deserialise(data)) is not None:
        fields = JointStateFields(
            stamp_from_message(message.header.stamp), message.header.frame_id, tuple(message.name),
            tuple(message.position), tuple(message.velocity), tuple(message.effort),
        )  # fmt: skip
    return fields


def sample_from_bytes(data: bytes, joints: tuple[str, ...] = ONE_JOINT.names) -> JointSample | None:
    """Return the state of a plant's joints that a serialised JointState carries, or None where it carries none.

    Args:
        data: The message.
        joints: All joints of the plant. The one joint of a plant is found among others; several are expected alone and
            in their order, so that nobody ever takes one for another.
    """
    fields = decode_joint_state(data)
    if fields is not None and fields.joints == joints and fields.position and fields.velocity:
        return JointSample(
            fields.stamp_ns, fields.position, fields.velocity, fields.effort or (0.0,) * len(fields.position)
        )
    message = _deserialise(data)
    return None if message is None else sample_from_message(message, joints)


def sample_from_message(message: JointState, joints: tuple[str, ...] = ONE_JOINT.names) -> JointSample | None:
    """Return the state of a plant's joints that a message carries, as :func:`sample_from_bytes` does."""
    if _problem_of_positions(message, joints):
        return None
    stamp_ns = stamp_from_message(message.header.stamp)
    if len(joints) > 1:
        efforts = tuple(message.effort) or (0.0,) * len(joints)
        return JointSample(stamp_ns, tuple(message.position), tuple(message.velocity), efforts)
    index = list(message.name).index(joints[0])
    effort = message.effort[index] if len(message.effort) > index else 0.0
    return JointSample.of_one(stamp_ns, message.position[index], message.velocity[index], effort)


def stamp_of_state(data: bytes, joints: tuple[str, ...]) -> tuple[int | None, tuple[str, ...]]:
    """Return the stamp of a serialised state that tells of some joints [ns], else None, and whose state it is.

    Args:
        data: The message.
        joints: Joints that must be among its own, each with position and velocity, in this order.
    """
    fields = decode_joint_state(data)
    if fields is not None:
        stamp_ns, found = fields.stamp_ns, fields.joints
        counts = len(fields.position), len(fields.velocity)
    else:
        message = _deserialise(data)
        if message is None:
            return None, ()
        stamp_ns, found = stamp_from_message(message.header.stamp), tuple(message.name)
        counts = len(message.position), len(message.velocity)
    full = min(counts) >= len(found)
    return (stamp_ns if full and joints == tuple(name for name in found if name in joints) else None), found


def problem_of_state(data: bytes, joints: tuple[str, ...] = ONE_JOINT.names) -> str:
    """Return which field of a serialised JointState keeps it from being a state of the joints, empty where none does.

    Args:
        data: The message.
        joints: All joints of the plant.
    """
    message = _deserialise(data)
    return _NO_JOINT_STATE if message is None else _problem_of_positions(message, joints)


def _problem_of_positions(message: JointState, joints: tuple[str, ...]) -> str:
    names = list(message.name)
    if len(joints) > 1:
        if tuple(names) != joints:
            return f"name is {names}; expected {list(joints)}"
        for field in ("position", "velocity", "effort"):
            count = len(getattr(message, field))
            if count != len(names) and (count or field != "effort"):
                return f"{field} has {count} values; expected {len(names)}"
        return ""
    (joint,) = joints
    if joint not in names:
        return f"name is {names}; expected {joint!r} among them"
    for field in ("position", "velocity"):
        count = len(getattr(message, field))
        if count <= names.index(joint):
            return f"{field} has {count} values for {len(names)} names; expected one for {joint!r}"
    return ""


def problem_of_command(data: bytes) -> str:
    """Return which field of a serialised JointState keeps it from being a command, empty where none does."""
    message = _deserialise(data)
    return _NO_JOINT_STATE if message is None else _problem_of_efforts(message)


def _problem_of_efforts(message: JointState) -> str:
    count, expected = len(message.effort), len(message.name) or 1
    return "" if count == expected else f"effort has {count} values; expected {expected}"


def trajectory_to_message(trajectory: Trajectory, stamp_ns: int = 0) -> JointTrajectory:
    """Return the message for a trajectory of our joint."""
    message = JointTrajectory(joint_names=[JOINT])
    message.header.stamp = stamp_to_message(stamp_ns)
    message.points = [
        JointTrajectoryPoint(
            positions=[point.position],
            velocities=[point.velocity],
            time_from_start=seconds_to_duration(point.time),
        )
        for point in trajectory.points
    ]
    return message


def seconds_to_duration(seconds: float) -> Duration:
    """Return a ROS duration, rounded to a nanosecond."""
    sec, nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
    return Duration(sec=sec, nanosec=nanosec)


def event_message(stamp_ns: int, name: str, **details: Any) -> String:
    """Return an event for the ``events`` topic: JSON with at least ``stamp_ns`` and ``name``."""
    return String(data=json.dumps({"stamp_ns": stamp_ns, "name": name, **details}, sort_keys=True))


def diagnostic_status(
    name: str, level: bytes, message: str, values: Mapping[str, object], *, hardware_id: str = "none"
) -> DiagnosticStatus:
    """Return a diagnostic status; numbers are written with as many digits as a reader needs.

    Args:
        name: What is told of, such as ``/sim/simulator: plant``.
        level: A constant of the message.
        message: How it is, in words.
        values: Figures by name.
        hardware_id: Which device it is about; ``none`` for a program, as diagnostic_updater says.
    """
    return DiagnosticStatus(
        name=name,
        hardware_id=hardware_id,
        level=level,
        message=message,
        values=[KeyValue(key=key, value=_format(value)) for key, value in values.items()],
    )


def plant_mode(message: DiagnosticArray, namespace: str) -> str:
    """Return the mode that the plant in a namespace tells in its diagnostics, or nothing where it is not among them."""
    return plant_value(message, namespace, "mode")


def plant_value(message: DiagnosticArray, namespace: str, key: str) -> str:
    """Return a value that the plant in a namespace tells in its diagnostics, or nothing where it is not among them."""
    prefix = namespace.rstrip("/") + "/"
    for status in message.status:
        name, _, what = status.name.partition(": ")
        if what == "plant" and name.startswith(prefix) and "/" not in name[len(prefix) :]:
            return next((pair.value for pair in status.values if pair.key == key), "")
    return ""


def _format(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _deserialise(data: bytes) -> JointState | None:
    try:
        return deserialize_message(data, JointState)
    except Exception:  # noqa: BLE001  # rclpy raises its C library's error types, which have no common base
        return None
