"""Writing bags: rosbag2 folders (MCAP, SQLite) that stay readable after a crash of the writer."""

from pendulum_rosbag.storage.bag_writer import STORAGES, BagWriter
from pendulum_rosbag.storage.message_types import MessageType, message_type, typestore
from pendulum_rosbag.storage.qos import QosProfile

__all__ = ["STORAGES", "BagWriter", "MessageType", "QosProfile", "message_type", "typestore"]
