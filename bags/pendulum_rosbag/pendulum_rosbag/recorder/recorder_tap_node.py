"""One subscription of the recorder: its QoS, and what has arrived."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from rclpy.event_handler import QoSSubscriptionEventType
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from pendulum_msgs_py.ros.convert import class_of
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_rosbag.reader.joint_state import Trimmer
from pendulum_rosbag.recorder.gaps import GapCounter
from pendulum_rosbag.recorder.session import RecordingSession
from pendulum_rosbag.storage import QosProfile
from pendulum_rosbag.storage.message_types import message_type
from pendulum_rosbag.storage.stamps import stamp_reader

__all__ = ["Tap", "wanted_qos"]

DEPTH = 4000
"""Queue depth of the middleware between two polls: four seconds at 1 kHz."""
SETTLING = 5.0
"""Time until a publisher and its subscription are matched at both ends [s].

A publisher resends missed messages only after its own match, which took up to 2 s after recorders had been killed.
"""


def wanted_qos(publishers: Sequence[TopicEndpointInfo]) -> tuple[bool, bool]:
    """Return whether all publishers are reliable, and whether all are transient local."""
    return (
        all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers),
        all(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers),
    )


class Tap:
    """A polled subscription, and what is needed to record from it; an ImportError if the type is not installed.

    Messages missed between it and the subscription ``before`` that it replaces are counted. The node destroys
    ``source`` after ``close``; ``announced`` is the session that has the topic.
    """

    def __init__(
        self, node: PollingNode, topic: str, publishers: Sequence[TopicEndpointInfo], before: Tap | None = None
    ) -> None:
        name = publishers[0].topic_type
        type_hash = str(publishers[0].topic_type_hash)
        self.topic = topic
        self.type_name = name
        self.reliable, self.latched = wanted_qos(publishers)
        self.publishers = len(publishers)
        self.qos = tuple(_offered(publisher) for publisher in publishers)
        self.announced: RecordingSession | None = None
        self.stamp = stamp_reader(name)
        self.type = message_type(name, type_hash if type_hash.startswith("RIHS") else "")
        self._newest: tuple[RecordingSession | None, bytes] = (None, b"")
        self._trim = Trimmer() if name == "sensor_msgs/msg/JointState" else bytes
        profile = QoSProfile(
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if self.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.latched else DurabilityPolicy.VOLATILE,
        )
        self._opened = self._first_opened = time.monotonic()
        self._reported_unmet = 0
        self.source = node.create_polled_input(class_of(name), topic, profile)
        # Taken on demand, not delivered by the executor, so that it is as recent as the messages.
        handle = self.source.subscription.handle
        with handle:
            self._matched = rclpy_implementation.EventHandle(handle, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED)
        self._gaps = GapCounter(self._count_publishers)
        if before is not None:
            self._gaps.go_on_from(before._gaps)

    @property
    def is_new(self) -> bool:
        """Whether its publishers' first messages may be missing because the topic is new."""
        return time.monotonic() - self._first_opened < SETTLING

    @property
    def is_settling(self) -> bool:
        """Whether some publisher may not have matched the subscription yet."""
        return time.monotonic() - self._opened < SETTLING

    def suits(self, publishers: Sequence[TopicEndpointInfo]) -> bool:
        """Return whether the subscription matches all these publishers; update their number."""
        if len(publishers) > self.publishers:
            self._opened = time.monotonic()
        self.publishers = len(publishers)
        reliable, latched = wanted_qos(publishers)
        return (reliable or not self.reliable) and (latched or not self.latched)

    def announce(self, session: RecordingSession) -> None:
        """Announce the topic to a session once."""
        if self.announced is not session:
            session.add_topic(self.topic, self.type, self.qos)
            self.announced = session

    def take(self) -> Iterator[tuple[int, bytes, int]]:
        """Yield time of arrival [ns] or 0, CDR bytes, and the number of messages missing before each."""
        see, trim = self._gaps.see, self._trim
        for data, info in self.source.messages():
            sequence = info["publication_sequence_number"]
            yield info["received_timestamp"], trim(data), see(sequence) if sequence else 0

    def repeats(self, session: RecordingSession | None, data: bytes) -> bool:
        """Store a stamped message; return whether it repeats the one before it, as in lockstep without a reply."""
        before, self._newest = self._newest, (session, data)
        again = before[0] is session and before[1] == data
        return again and self.stamp is not None and (self.stamp(data) or 0) > 0

    def unheard(self) -> int:
        """Return how many messages publishers had sent before the first one received, since the last call."""
        unheard = self._gaps.unmet - self._reported_unmet
        self._reported_unmet = self._gaps.unmet
        return unheard

    def close(self) -> None:
        """Release the middleware before the source is destroyed."""
        self._matched.destroy_when_not_in_use()

    def _count_publishers(self) -> tuple[int, int]:
        with self._matched:
            status = self._matched.take_event()
        return (status.total_count, status.current_count) if status else (0, 0)


def _offered(publisher: TopicEndpointInfo) -> QosProfile:
    profile = publisher.qos_profile
    return QosProfile(
        history=profile.history.name.lower(),
        depth=profile.depth,
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline_ns=profile.deadline.nanoseconds,
        lifespan_ns=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.name.lower(),
        lease_ns=profile.liveliness_lease_duration.nanoseconds,
    )
