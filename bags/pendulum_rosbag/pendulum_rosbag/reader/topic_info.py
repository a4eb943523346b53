"""What a bag says of a topic, and a message as it is stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["StoredMessage", "TopicInfo"]


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag.

    Args:
        name: Full name.
        type: Message type, such as ``sensor_msgs/msg/JointState``.
        count: Messages in the bag (of the whole bag, also when a time span was asked for).
        hash: Type description hash, empty when the bag does not tell.
        qos: Offered QoS profiles as the YAML text of the bag.
        definition: Message definition text, empty when the bag has none.
        serialization: How messages are encoded: ``cdr``, or as another writer says.
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
