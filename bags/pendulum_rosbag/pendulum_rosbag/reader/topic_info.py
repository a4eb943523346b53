"""A bag's description of a topic, and a stored message."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

__all__ = ["StoredMessage", "TopicInfo", "ros_topic", "ros_type"]

_DDS_TYPE = re.compile(r"(\w+(?:::\w+)+?)::(?:dds_::)?(\w+?)_?")
_OLD_TYPE = re.compile(r"(\w+)/(\w+)")


def ros_type(name: str) -> str:
    """Return the ROS 2 name of a message type, such as ``sensor_msgs/msg/JointState``.

    DDS recorders write ``sensor_msgs::msg::dds_::JointState_``, those of ROS 1 ``sensor_msgs/JointState``.
    """
    if dds := _DDS_TYPE.fullmatch(name):
        return "/".join([*dds[1].split("::"), dds[2]])
    old = _OLD_TYPE.fullmatch(name)
    return f"{old[1]}/msg/{old[2]}" if old else name


def ros_topic(name: str) -> str:
    """Return the full ROS 2 name of a topic recorded under a relative or a DDS name."""
    return name if name.startswith("/") else f"/{name.removeprefix('rt/')}"


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag.

    Args:
        type: Message type, such as ``sensor_msgs/msg/JointState``.
        count: Messages in the whole bag, also if a time span was requested.
        hash: Type description hash, empty if unknown.
        qos: Offered QoS profiles as the YAML text of the bag.
        definition: Message definition text, empty if the bag has none.
        serialization: Encoding of the messages, such as ``cdr``.
    """

    name: str
    type: str
    count: int
    hash: str = ""
    qos: str = ""
    definition: str = ""
    serialization: str = "cdr"


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """A message of any type: its log time [ns] and its fields as an object of rosbags."""

    log_time_ns: int
    message: Any
