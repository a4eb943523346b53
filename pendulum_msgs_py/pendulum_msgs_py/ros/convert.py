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

from pendulum_msgs_py.contract.cdr import decode_joint_state
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample

__all__ = [
    "command_from_bytes",
    "diagnostic_status",
    "event_message",
    "plant_mode",
    "plant_value",
    "problem_of_command",
    "problem_of_state",
    "sample_from_bytes",
    "sample_from_message",
    "seconds_to_duration",
    "stamp_from_message",
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
    """Return the command that a serialised JointState carries, or None where it is no command for one joint."""
    fields = decode_joint_state(data)
    if fields is not None:
        if fields.effort is None:
            return None
        return JointCommand(fields.stamp_ns, fields.effort, fields.frame_id, (fields.joint,))
    message = _deserialise(data)
    if message is None or len(message.effort) != 1 or len(message.name) > 1:
        return None
    return JointCommand(
        stamp_from_message(message.header.stamp), message.effort[0], message.header.frame_id, tuple(message.name)
    )


def sample_from_bytes(data: bytes) -> JointSample | None:
    """Return the state that a serialised JointState carries for our joint, or None where it carries none."""
    fields = decode_joint_state(data)
    if fields is not None and fields.joint == JOINT and fields.position is not None and fields.velocity is not None:
        return JointSample(fields.stamp_ns, fields.position, fields.velocity, fields.effort or 0.0)
    message = _deserialise(data)
    return None if message is None else sample_from_message(message)


def sample_from_message(message: JointState) -> JointSample | None:
    """Return the state of our joint among those of a message, or None where it is not there in full."""
    try:
        index = list(message.name).index(JOINT)
        effort = message.effort[index] if len(message.effort) > index else 0.0
        return JointSample(
            stamp_from_message(message.header.stamp), message.position[index], message.velocity[index], effort
        )
    except (ValueError, IndexError):
        return None


def problem_of_state(data: bytes) -> str:
    """Return which field of a serialised JointState keeps it from being a state of our joint, empty where none does."""
    message = _deserialise(data)
    if message is None:
        return _NO_JOINT_STATE
    names = list(message.name)
    if JOINT not in names:
        return f"name is {names}; expected {JOINT!r} among them"
    for field in ("position", "velocity"):
        count = len(getattr(message, field))
        if count <= names.index(JOINT):
            return f"{field} has {count} values for {len(names)} names; expected one for {JOINT!r}"
    return ""


def problem_of_command(data: bytes) -> str:
    """Return which field of a serialised JointState keeps it from being a command, empty where none does."""
    message = _deserialise(data)
    if message is None:
        return _NO_JOINT_STATE
    if len(message.name) > 1:
        return f"name is {list(message.name)}; expected [{JOINT!r}] or none"
    if len(message.effort) != 1:
        return f"effort has {len(message.effort)} values; expected 1"
    return ""


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
