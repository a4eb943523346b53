"""Reading bags: any rosbag2 folder or storage file to numpy arrays."""

from pendulum_rosbag.reader.bag import Bag, read_bag, read_bags
from pendulum_rosbag.reader.joint_state import FIELDS, canonical
from pendulum_rosbag.reader.same import Difference, same_messages
from pendulum_rosbag.reader.topic_info import StoredMessage, TopicInfo

__all__ = [
    "FIELDS",
    "Bag",
    "Difference",
    "StoredMessage",
    "TopicInfo",
    "canonical",
    "read_bag",
    "read_bags",
    "same_messages",
]
