"""Recording without ROS: stamps, gap counting, the bounded queue and the thread that writes."""

from pendulum_rosbag.recorder.gaps import GapCounter
from pendulum_rosbag.recorder.session import RecordingSession, SessionReport, TopicCount
from pendulum_rosbag.storage.stamps import LOG_TIMES, StampReader, stamp_reader

__all__ = [
    "LOG_TIMES",
    "GapCounter",
    "RecordingSession",
    "SessionReport",
    "StampReader",
    "TopicCount",
    "stamp_reader",
]
