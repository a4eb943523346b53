"""Messages to typed values and back."""

from __future__ import annotations

import importlib
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
from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.json_values import without_nan

__all__ = [
    "class_of",
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


def class_of(name: str) -> Any:
    """Return the class of a name such as ``sensor_msgs/msg/JointState``; raise an ImportError if not installed."""
    package, kind, short = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    if not hasattr(module, short):
        raise ImportError(f"{module.__name__} has no {short}")
    return getattr(module, short)


def stamp_to_message(stamp_ns: int) -> Time:
    """Return nanoseconds as a ROS time."""
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=sec, nanosec=nanosec)


def stamp_from_message(stamp: Time) -> int:
    """Return a ROS time in nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def fields_from_bytes(data: bytes) -> JointStateFields | None:
    """Return the content of a serialised JointState of any joints, or None if it is none."""
    fields = decode_joint_state(data)
    if fields is not None:
        return fields
    try:
        message = deserialize_message(data, JointState)
    except Exception:  # noqa: BLE001  # rclpy raises its C library's error types, which have no common base
        return None
    return _fields_from_message(message)


def _fields_from_message(message: JointState) -> JointStateFields:
    return JointStateFields(
        stamp_from_message(message.header.stamp), message.header.frame_id, tuple(message.name),
        tuple(message.position), tuple(message.velocity), tuple(message.effort),
    )  # fmt: skip


def command_from_bytes(data: bytes) -> JointCommand | None:
    """Return the command in a serialised JointState, or None unless it has one effort per name."""
    fields = fields_from_bytes(data)
    if fields is None or _problem_of_efforts(fields):
        return None
    return JointCommand(fields.stamp_ns, fields.effort, fields.frame_id, fields.joints)


def sample_from_bytes(data: bytes, joints: tuple[str, ...] = ONE_JOINT.names) -> JointSample | None:
    """Return the state of a plant's joints in a serialised JointState, or None.

    A single joint may be one among others; several must be alone and in order, so that none is mistaken for another.
    """
    fields = fields_from_bytes(data)
    return None if fields is None else _sample_from_fields(fields, joints)


def sample_from_message(message: JointState, joints: tuple[str, ...] = ONE_JOINT.names) -> JointSample | None:
    """Return the state in a message, as :func:`sample_from_bytes`."""
    return _sample_from_fields(_fields_from_message(message), joints)


def _sample_from_fields(fields: JointStateFields, joints: tuple[str, ...]) -> JointSample | None:
    stamp_ns, _, found, position, velocity, effort = fields
    count = len(joints)
    if found == joints and len(position) == len(velocity) == count and len(effort) in {0, count}:
        return JointSample(stamp_ns, position, velocity, effort or (0.0,) * count)
    if _problem_of_positions(fields, joints):
        return None
    index = found.index(joints[0])
    return JointSample.of_one(stamp_ns, position[index], velocity[index], effort[index] if len(effort) > index else 0.0)


def stamp_of_state(data: bytes, joints: tuple[str, ...]) -> tuple[int | None, tuple[str, ...]]:
    """Return the stamp of a serialised state with these joints, in order [ns], or None, and all its joints."""
    fields = fields_from_bytes(data)
    if fields is None:
        return None, ()
    found = fields.joints
    full = min(len(fields.position), len(fields.velocity)) >= len(found)
    return (fields.stamp_ns if full and joints == tuple(name for name in found if name in joints) else None), found


def problem_of_state(data: bytes, joints: tuple[str, ...] = ONE_JOINT.names) -> str:
    """Return which field of a serialised JointState makes it no state of all these joints, or an empty string."""
    fields = fields_from_bytes(data)
    return _NO_JOINT_STATE if fields is None else _problem_of_positions(fields, joints)


def _problem_of_positions(fields: JointStateFields, joints: tuple[str, ...]) -> str:
    found = list(fields.joints)
    quantities = {"position": fields.position, "velocity": fields.velocity, "effort": fields.effort}
    if len(joints) > 1:
        if fields.joints != joints:
            return f"name is {found}; expected {list(joints)}"
        for field, values in quantities.items():
            count = len(values)
            if count != len(found) and (count or field != "effort"):
                return f"{field} has {count} values; expected {len(found)}"
        return ""
    (joint,) = joints
    if joint not in found:
        return f"name is {found}; expected {joint!r} among them"
    for field in ("position", "velocity"):
        count = len(quantities[field])
        if count <= found.index(joint):
            return f"{field} has {count} values for {len(found)} names; expected one for {joint!r}"
    return ""


def problem_of_command(data: bytes) -> str:
    """Return which field of a serialised JointState makes it no command, or an empty string."""
    fields = fields_from_bytes(data)
    return _NO_JOINT_STATE if fields is None else _problem_of_efforts(fields)


def _problem_of_efforts(fields: JointStateFields) -> str:
    count, expected = len(fields.effort), len(fields.joints) or 1
    return "" if count == expected else f"effort has {count} values; expected {expected}"


def trajectory_to_message(trajectory: Trajectory, stamp_ns: int = 0) -> JointTrajectory:
    """Return the message of a trajectory."""
    message = JointTrajectory(joint_names=[JOINT])
    message.header.stamp = stamp_to_message(stamp_ns)
    message.points = [
        JointTrajectoryPoint(
            positions=[point.position], velocities=[point.velocity], time_from_start=seconds_to_duration(point.time)
        )
        for point in trajectory.points
    ]
    return message


def seconds_to_duration(seconds: float) -> Duration:
    """Return a ROS duration, rounded to a nanosecond."""
    sec, nanosec = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
    return Duration(sec=sec, nanosec=nanosec)


def event_message(stamp_ns: int, name: str, **details: Any) -> String:
    """Return an event: JSON with at least ``stamp_ns`` and ``name``."""
    return String(data=json.dumps(without_nan({"stamp_ns": stamp_ns, "name": name, **details}), sort_keys=True))


def diagnostic_status(
    name: str, level: bytes, message: str, values: Mapping[str, object], *, hardware_id: str = "none"
) -> DiagnosticStatus:
    """Return a status of, for example, ``/sim/simulator: plant``; ``hardware_id`` is ``none`` for a program."""
    return DiagnosticStatus(
        name=name,
        hardware_id=hardware_id,
        level=level,
        message=message,
        values=[KeyValue(key=key, value=_format(value)) for key, value in values.items()],
    )


def plant_mode(message: DiagnosticArray, namespace: str) -> str:
    """Return the mode of the plant in a namespace, or an empty string."""
    return plant_value(message, namespace, "mode")


def plant_value(message: DiagnosticArray, namespace: str, key: str) -> str:
    """Return a diagnostic value of the plant in a namespace, or an empty string."""
    prefix = namespace.rstrip("/") + "/"
    for status in message.status:
        name, _, what = status.name.partition(": ")
        if what == "plant" and name.startswith(prefix) and "/" not in name[len(prefix) :]:
            return next((pair.value for pair in status.values if pair.key == key), "")
    return ""


def _format(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
