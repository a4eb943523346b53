"""What this project asks of the middleware where the user has not said otherwise."""

from __future__ import annotations

import os

__all__ = ["set_middleware_defaults"]

_TRANSPORT_SETTINGS = (
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
)


def set_middleware_defaults() -> None:
    """Stay on this host, and pass messages through sockets; to be called before ``rclpy.init``.

    A plant that the whole subnet may command is a decision, not a default.

    Fast DDS passes messages between processes through shared memory. A process that is killed while it holds some
    leaves it locked: measured with a publisher of five topics at 500 Hz, after some ten kills new subscribers, matched
    as they were, got nothing any more. The kernel closes the sockets of the dead, and round trips take as long.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if not any(os.environ.get(name) for name in _TRANSPORT_SETTINGS):
        os.environ["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
