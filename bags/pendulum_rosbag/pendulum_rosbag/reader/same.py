"""Message-by-message comparison of two bags, as for two runs with one seed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING

from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.decode import decoder_for, store_for
from pendulum_rosbag.reader.joint_state import canonical

if TYPE_CHECKING:
    from pendulum_rosbag.reader.bag import Bag
    from pendulum_rosbag.reader.topic_info import TopicInfo

__all__ = ["Difference", "same_messages"]


@dataclass(slots=True)
class Difference:
    """Result of :func:`same_messages`; true if the bags are equal.

    Args:
        compared: Topic -> number of compared messages.
        reasons: One sentence for each topic that differs, with its first difference.
    """

    compared: dict[str, int] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Whether messages were compared and none differs."""
        return not self.reasons and bool(self.compared)

    def __bool__(self) -> bool:
        return self.equal

    def __str__(self) -> str:
        if self.reasons:
            return "; ".join(self.reasons)
        return f"{sum(self.compared.values())} messages on {len(self.compared)} topics are equal"


def same_messages(bag_a: Bag, bag_b: Bag, topics: Sequence[str] | None = None, *, log_times: bool = True) -> Difference:
    """Compare two bags (all topics by default) message by message, each topic in order of log time.

    Padding and trailing bytes do not count: rclpy leaves both uninitialised. Types that neither the bags nor ROS 2
    Jazzy define are compared byte by byte. Messages of one topic and log time have no order, as two nodes may have
    published them. ``log_times`` False is for bags whose log time is the time of arrival.
    """
    answer = Difference()
    for topic in sorted(topics if topics is not None else {*bag_a.topics, *bag_b.topics}):
        absent = [str(bag.path) for bag in (bag_a, bag_b) if topic not in bag.topics]
        if absent:
            answer.reasons.append(f"{topic} is missing in {' and '.join(absent)}")
            continue
        types = bag_a.topics[topic].type, bag_b.topics[topic].type
        if types[0] != types[1]:
            answer.reasons.append(f"{topic} has type {types[0]} in one bag and {types[1]} in the other")
            continue
        clean = _canonical_of(bag_a.topics[topic])
        reason = _first_difference(topic, clean, bag_a.raw(topic), bag_b.raw(topic), log_times)
        if reason:
            answer.reasons.append(reason)
        else:
            answer.compared[topic] = bag_a.topics[topic].count
    return answer


def _canonical_of(info: TopicInfo) -> Callable[[bytes], bytes]:
    if info.type == "sensor_msgs/msg/JointState":
        return canonical
    try:
        decode = decoder_for(info)
    except DataError:
        return bytes

    def again(data: bytes) -> bytes:
        try:
            return bytes(store_for(info).serialize_cdr(decode(data), info.type))
        except DataError:
            return data

    return again


def _first_difference(
    topic: str, clean: Callable[[bytes], bytes], a: list[tuple[int, bytes]], b: list[tuple[int, bytes]], log_times: bool
) -> str:
    if log_times:
        a, b = _ordered(a, clean), _ordered(b, clean)
    for number, ((time_a, data_a), (time_b, data_b)) in enumerate(zip(a, b, strict=False)):
        if log_times and time_a != time_b:
            return f"{topic} message {number} has log time {time_a} ns in one bag and {time_b} ns in the other"
        if data_a != data_b and clean(data_a) != clean(data_b):
            return f"{topic} message {number} at {time_a} ns differs"
    if len(a) != len(b):
        return f"{topic} has {len(a)} messages in one bag and {len(b)} in the other"
    return ""


def _ordered(messages: list[tuple[int, bytes]], clean: Callable[[bytes], bytes]) -> list[tuple[int, bytes]]:
    ordered: list[tuple[int, bytes]] = []
    for _, group in itertools.groupby(messages, key=itemgetter(0)):
        same_time = list(group)
        ordered += same_time if len(same_time) == 1 else sorted(same_time, key=lambda item: clean(item[1]))
    return ordered
