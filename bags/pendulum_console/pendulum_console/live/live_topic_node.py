"""One topic for viewers: the bytes of the graph, subscribed to while there is a viewer."""

from __future__ import annotations

from typing import Any

import foxglove
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from pendulum_msgs_py.ros.convert import class_of
from pendulum_msgs_py.ros.polled import PolledInput, PollingNode
from pendulum_rosbag.reader.joint_state import Trimmer
from pendulum_rosbag.recorder.recorder_tap_node import wanted_qos
from pendulum_rosbag.storage.message_types import message_type

__all__ = ["LiveTopic"]

_DEPTH = 2000
"""Messages that the middleware holds between two polls: four seconds at 500 Hz."""


class LiveTopic:
    """A topic (of type ``package/msg/Name``) and its channel in the viewers' server; or an ImportError.

    ``lost`` messages are missing between ``sent`` ones by sequence number, counted while there is one publisher.
    """

    def __init__(self, node: PollingNode, topic: str, type_name: str, context: Any) -> None:
        self._class = class_of(type_name)
        self._node = node
        self._topic = topic
        self._trim = Trimmer() if type_name == "sensor_msgs/msg/JointState" else bytes
        text = message_type(type_name).definition.encode()
        schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=text)
        self._channel = foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=context)
        self._source: PolledInput | None = None
        self._has_one_publisher = False
        self._newest: int | None = None
        self.sent = 0
        self.lost = 0

    def take(self) -> None:
        """Pass on what has arrived; subscribe while there is a viewer."""
        if not self._channel.has_sinks():
            self._unsubscribe()
            return
        if self._source is None:
            self._source = self._subscribe()
        log, trim = self._channel.log, self._trim
        for data, info in self._source.messages():
            log(trim(data), log_time=info["received_timestamp"] or None)
            self.sent += 1
            number = info["publication_sequence_number"]
            if self._has_one_publisher and self._newest is not None and number > self._newest:
                self.lost += number - self._newest - 1
            self._newest = number

    def poll(self) -> None:
        """Update the publishers: sequence numbers of several cannot be compared."""
        self._has_one_publisher = self._node.count_publishers(self._topic) == 1

    def close(self) -> None:
        """Close the viewers' channel."""
        self._unsubscribe()
        self._channel.close()

    def _unsubscribe(self) -> None:
        if self._source is not None:
            self._node.destroy_polled_input(self._source)
            self._source = self._newest = None

    def _subscribe(self) -> PolledInput:
        # Latched messages come to reliable subscribers only. The others are best effort, because acknowledging them
        # would cost the plants time.
        _, latched = wanted_qos(self._node.get_publishers_info_by_topic(self._topic))
        profile = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        return self._node.create_polled_input(self._class, self._topic, profile)
