"""JointTrajectory from CDR bytes in plain Python, so that other threads run meanwhile.

rclpy holds the GIL for 45 ms to read 1600 points (a move of the thesis), which would block the threads of actuator and
e-stop. This parser takes 5 to 10 us a point.

Layout (XCDR1, little endian)::

    header (int32 sec, uint32 nanosec, string frame_id), sequence<string> joint_names, uint32 points, each of
        sequence<double> positions, velocities, accelerations, effort; int32 sec, uint32 nanosec

Source: OMG CDR (formal/02-06-51, section 15.3); trajectory_msgs/msg/JointTrajectory.
"""

from __future__ import annotations

import struct

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.trajectory import MAX_TRAJECTORY_POINTS, Trajectory, TrajectoryPoint
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError

__all__ = ["decode_joint_trajectory"]

_PLAIN_CDR = b"\x00\x01"
_COUNT = struct.Struct("<I")
_NUMBER = struct.Struct("<d")
_TIME = struct.Struct("<iI")
_MOST_JOINTS = 64
_SEQUENCES = ("positions", "velocities", "accelerations", "effort")


def decode_joint_trajectory(data: bytes) -> tuple[int, Trajectory]:
    """Return stamp [ns] and trajectory of a serialised message, encapsulation header included.

    Raises:
        ParameterError: It is malformed, for another joint, too long, or a point lacks its position.
    """
    try:
        return _decode(memoryview(data))
    except (struct.error, UnicodeDecodeError) as error:
        raise ParameterError(f"trajectory of {len(data)} bytes is not understood: {error}") from error


def _decode(data: memoryview) -> tuple[int, Trajectory]:
    if data[:2] != _PLAIN_CDR:
        raise ParameterError("trajectory is not in little-endian CDR; expected what ROS nodes send")
    sec, nanosec = _TIME.unpack_from(data, 4)
    _, offset = _string(data, 12)
    joints, offset = _count(data, offset)
    names: list[str] = []
    for _ in range(min(joints, _MOST_JOINTS)):
        name, offset = _string(data, offset)
        names.append(name)
    if joints != 1 or names != [JOINT]:
        raise ParameterError(f"trajectory is for joints {names[:5]}; expected [{JOINT!r}]")
    count, offset = _count(data, offset)
    if count > MAX_TRAJECTORY_POINTS:
        raise ParameterError(f"trajectory has {count} points; expected at most {MAX_TRAJECTORY_POINTS}")
    points = []
    for index in range(count):
        position = velocity = 0.0
        positions = velocities = 0
        for quantity in _SEQUENCES:
            # A sequence's length is aligned to 4 bytes, its doubles to 8, both counted from behind the header of 4.
            (length,) = _COUNT.unpack_from(data, offset)
            offset += 4
            if length == 0:
                continue
            offset += (4 - offset) & 7
            if quantity == "positions":
                positions = length
                (position,) = _NUMBER.unpack_from(data, offset)
            elif quantity == "velocities":
                velocities = length
                (velocity,) = _NUMBER.unpack_from(data, offset)
            offset += 8 * length
        if positions != 1 or velocities > 1:
            raise ParameterError(
                f"trajectory point {index} has {positions} positions and {velocities} velocities; "
                "expected 1 position and at most 1 velocity"
            )
        seconds, nanoseconds = _TIME.unpack_from(data, offset)
        offset += 8
        points.append(TrajectoryPoint(seconds + nanoseconds / NANOSECONDS, position, velocity))
    return sec * NANOSECONDS + nanosec, Trajectory(tuple(points))


def _count(data: memoryview, offset: int) -> tuple[int, int]:
    offset = (offset + 3) & ~3
    (count,) = _COUNT.unpack_from(data, offset)
    return count, offset + 4


def _string(data: memoryview, offset: int) -> tuple[str, int]:
    length, offset = _count(data, offset)
    if length == 0 or offset + length > len(data):
        raise struct.error("a string is longer than the message")
    return bytes(data[offset : offset + length - 1]).decode(), offset + length
