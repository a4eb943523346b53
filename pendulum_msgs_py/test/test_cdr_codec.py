"""The codec of one-joint states against the middleware's own serialisation."""

from __future__ import annotations

import contextlib
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pendulum_msgs_py.contract import cdr
from pendulum_msgs_py.contract.cdr import MAX_SECONDS, decode_joint_state, encode_clock, encode_joint_state
from pendulum_msgs_py.contract.cdr_trajectory import decode_joint_trajectory
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.trajectory import MAX_TRAJECTORY_POINTS, thesis_ramp
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

serialization = pytest.importorskip("rclpy.serialization")
JointState = pytest.importorskip("sensor_msgs.msg").JointState
Clock = pytest.importorskip("rosgraph_msgs.msg").Clock
JointTrajectory = pytest.importorskip("trajectory_msgs.msg").JointTrajectory
JointTrajectoryPoint = pytest.importorskip("trajectory_msgs.msg").JointTrajectoryPoint
convert = pytest.importorskip("pendulum_msgs_py.ros.convert")

_STAMPS = st.integers(0, MAX_SECONDS * NANOSECONDS + NANOSECONDS - 1)
_NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
_QUANTITIES = st.one_of(st.none(), st.floats(allow_nan=False))


def _message(stamp_ns: int, frame: str, joint: str, *quantities: float | None) -> JointState:
    message = JointState(name=[joint])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NANOSECONDS)
    message.header.frame_id = frame
    message.position, message.velocity, message.effort = ([] if q is None else [q] for q in quantities)
    return message


def _fields(stamp_ns: int, frame: str, joint: str, *quantities: float | None) -> tuple:
    return (stamp_ns, frame, (joint,), *(() if q is None else (q,) for q in quantities))


@given(_STAMPS, _NAMES, _NAMES, _QUANTITIES, _QUANTITIES, _QUANTITIES)
def test_the_middleware_reads_what_we_write(
    stamp: int, frame: str, joint: str, position: float | None, velocity: float | None, effort: float | None
) -> None:
    data = encode_joint_state(stamp, frame_id=frame, joint=joint, position=position, velocity=velocity, effort=effort)
    message = serialization.deserialize_message(data, JointState)
    assert message == _message(stamp, frame, joint, position, velocity, effort)
    assert decode_joint_state(data) == _fields(stamp, frame, joint, position, velocity, effort)


@given(_STAMPS, _NAMES, _NAMES, _QUANTITIES, _QUANTITIES, _QUANTITIES)
def test_we_read_what_the_middleware_writes(
    stamp: int, frame: str, joint: str, position: float | None, velocity: float | None, effort: float | None
) -> None:
    data = serialization.serialize_message(_message(stamp, frame, joint, position, velocity, effort))
    assert decode_joint_state(data) == _fields(stamp, frame, joint, position, velocity, effort)


@pytest.mark.parametrize("length", range(70))
def test_every_length_of_frame_id_is_read_fast(length: int) -> None:
    message = _message(5, "f" * length, JOINT, None, None, 1.5)
    fields = decode_joint_state(serialization.serialize_message(message))
    assert fields is not None
    assert fields.effort == (1.5,)


@given(st.integers(0, MAX_SECONDS), st.integers(0, 999_999_999))
def test_the_clock_is_what_rclpy_reads(sec: int, nanosec: int) -> None:
    message = serialization.deserialize_message(encode_clock(sec * 1_000_000_000 + nanosec), Clock)
    assert (message.clock.sec, message.clock.nanosec) == (sec, nanosec)


def test_equal_messages_are_equal_bytes() -> None:
    assert encode_joint_state(7, frame_id="abc", effort=1.0) == encode_joint_state(7, frame_id="abc", effort=1.0)


@pytest.mark.parametrize(
    ("fields", "data"),
    [
        (
            {"frame_id": "/sim/simulator", "position": 3.0, "velocity": -0.25, "effort": 1.5},
            (
                "00010000 002f6859 15cd5b07 0f000000 2f73696d 2f73696d 756c6174 6f720000 01000000 0f000000 70656e64"
                "756c756d 5f6a6f69 6e740000 01000000 00000000 00000840 01000000 00000000 00000000 0000d0bf 01000000"
                "00000000 00000000 0000f83f"
            ),
        ),
        (
            {"frame_id": "/sim/controller", "effort": -0.5},
            (
                "00010000 002f6859 15cd5b07 10000000 2f73696d 2f636f6e 74726f6c 6c657200 01000000 0f000000 70656e64"
                "756c756d 5f6a6f69 6e740000 00000000 00000000 01000000 00000000 0000e0bf"
            ),
        ),
    ],
)
def test_the_bytes_of_states_and_commands_of_one_joint_stay_as_bags_hold_them(fields: dict, data: str) -> None:
    assert encode_joint_state(1_500_000_000_123_456_789, **fields).hex() == data.replace(" ", "")


def test_not_a_number_travels() -> None:
    fields = decode_joint_state(encode_joint_state(0, position=math.nan, effort=math.inf))
    assert fields is not None
    assert math.isnan(fields.position[0])
    assert fields.effort == (math.inf,)


@pytest.mark.parametrize(
    ("names", "efforts", "problem"),
    [
        ([], [], "effort has 0 values; expected 1"),
        ([JOINT], [], "effort has 0 values; expected 1"),
        ([JOINT, "b"], [1.0], "effort has 1 values; expected 2"),
        ([JOINT, "b"], [1.0, 2.0, 3.0], "effort has 3 values; expected 2"),
        ([JOINT], [1.0, 2.0], "effort has 2 values; expected 1"),
    ],
)
def test_what_has_not_one_effort_for_each_name_is_none_and_says_why(
    names: list[str], efforts: list[float], problem: str
) -> None:
    data = serialization.serialize_message(JointState(name=names, effort=efforts))
    assert convert.command_from_bytes(data) is None
    assert convert.problem_of_command(data) == problem


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        (JointState(position=[1.0], velocity=[0.0]), f"name is []; expected {JOINT!r} among them"),
        (JointState(name=["joint1"], position=[1.0]), f"name is ['joint1']; expected {JOINT!r} among them"),
        (JointState(name=[JOINT]), f"position has 0 values for 1 names; expected one for {JOINT!r}"),
        (
            JointState(name=["a", JOINT], position=[1.0, 2.0], velocity=[1.0]),
            f"velocity has 1 values for 2 names; expected one for {JOINT!r}",
        ),
        (JointState(name=[JOINT], position=[1.0], velocity=[0.0]), ""),
    ],
)
def test_what_is_no_state_of_our_joint_is_none_and_says_why(message: JointState, problem: str) -> None:
    data = serialization.serialize_message(message)
    assert (convert.sample_from_bytes(data) is None) == bool(problem)
    assert convert.problem_of_state(data) == problem


def test_a_command_without_a_joint_name_is_for_the_only_joint() -> None:
    command = convert.command_from_bytes(serialization.serialize_message(JointState(effort=[1.0])))
    assert command.joints == ()
    assert command.effort == (1.0,)


def test_a_state_among_other_joints_is_found() -> None:
    message = JointState(name=["a", JOINT], position=[1.0, 2.0], velocity=[3.0, 4.0], effort=[5.0, 6.0])
    sample = convert.sample_from_bytes(serialization.serialize_message(message))
    assert sample[1:] == ((2.0,), (4.0,), (6.0,))


def _truth(data: bytes) -> JointState | None:
    """What the middleware itself reads, or None where it refuses."""
    try:
        return serialization.deserialize_message(data, JointState)
    except Exception:  # noqa: BLE001  # rclpy raises its C library's error types
        return None


def _agrees_with_the_middleware(data: bytes) -> bool:
    """Read bytes in all our ways, and compare; return whether the middleware finds a message in them."""
    message = _truth(data)
    command, sample = convert.command_from_bytes(data), convert.sample_from_bytes(data)
    if message is None:
        # Nothing is believed that the middleware refuses.
        assert (command, sample, decode_joint_state(data)) == (None, None, None)
        return False
    is_command = len(message.effort) == (len(message.name) or 1)
    assert (command is not None) == is_command
    if command is not None:
        assert repr(command.effort) == repr(tuple(message.effort))
        assert (command.joints, command.source) == (tuple(message.name), message.header.frame_id)
    assert (sample is None) == bool(convert.problem_of_state(data))
    if sample is not None:
        index = list(message.name).index(JOINT)
        assert repr(sample[1:3]) == repr(((message.position[index],), (message.velocity[index],)))
    return True


@given(st.binary(max_size=120))
@example(b"")
@example(b"\x00" * 40)
def test_any_bytes_are_read_as_the_middleware_reads_them(data: bytes) -> None:
    for tail in (data, b"\x00\x01\x00\x00" + data):
        _agrees_with_the_middleware(tail)


@given(st.integers(0, 200), st.integers(0, 255), st.integers(0, 140))
def test_a_damaged_message_is_read_as_the_middleware_reads_it(place: int, value: int, cut: int) -> None:
    whole = encode_joint_state(5, frame_id="lqr", position=1.0, velocity=2.0, effort=3.0)
    assert _agrees_with_the_middleware(whole)
    data = bytearray(whole)
    data[place % len(data)] = value
    for damaged in (bytes(data), bytes(data[:cut]), bytes(data) + b"\xff" * cut):
        _agrees_with_the_middleware(damaged)


def test_a_name_with_a_nul_inside_is_left_to_the_middleware() -> None:
    assert decode_joint_state(encode_joint_state(0, frame_id="a\0b", effort=1.0)) is None


def test_trajectories_travel_to_a_nanosecond() -> None:
    ramp = thesis_ramp(0.1, 0.3)
    data = serialization.serialize_message(convert.trajectory_to_message(ramp, stamp_ns=5 * NANOSECONDS + 7))
    stamp_ns, back = decode_joint_trajectory(data)
    assert stamp_ns == 5 * NANOSECONDS + 7
    assert [(p.position, p.velocity) for p in back.points] == [(p.position, p.velocity) for p in ramp.points]
    assert max(abs(a.time - b.time) for a, b in zip(ramp.points, back.points, strict=True)) < 1e-9


@given(
    frame=_NAMES,
    counts=st.lists(st.tuples(*[st.integers(0, 2)] * 4), min_size=1, max_size=6),
    joints=st.sampled_from([[JOINT], [], [JOINT, JOINT], ["elbow"]]),
)
def test_a_trajectory_is_read_as_the_middleware_reads_it_or_refused(
    frame: str, counts: list[tuple[int, int, int, int]], joints: list[str]
) -> None:
    message = JointTrajectory(joint_names=joints)
    message.header.frame_id = frame
    for index, (positions, velocities, accelerations, effort) in enumerate(counts):
        point = JointTrajectoryPoint(
            positions=[0.1 * index] * positions,
            velocities=[0.2] * velocities,
            accelerations=[0.3] * accelerations,
            effort=[0.4] * effort,
        )
        point.time_from_start.sec, point.time_from_start.nanosec = index, 5
        message.points.append(point)
    data = serialization.serialize_message(message)
    if joints != [JOINT] or any(each[0] != 1 or each[1] > 1 for each in counts):
        with pytest.raises(ParameterError, match="trajectory"):
            decode_joint_trajectory(data)
        return
    _, back = decode_joint_trajectory(data)
    assert [point.position for point in back.points] == [0.1 * index for index in range(len(counts))]
    assert [point.velocity for point in back.points] == [0.2 * each[1] for each in counts]
    assert [round(point.time * 1e9) for point in back.points] == [n * NANOSECONDS + 5 for n in range(len(counts))]


@given(place=st.integers(0, 400), value=st.integers(0, 255), cut=st.integers(0, 300))
def test_a_damaged_trajectory_is_refused_or_read_but_never_raises_anything_else(
    place: int, value: int, cut: int
) -> None:
    trajectory = from_points([0.0, 1.0, 2.0], [0.0, 0.1, 0.2], [0.0, 0.1, 0.0])
    data = bytearray(serialization.serialize_message(convert.trajectory_to_message(trajectory)))
    data[place % len(data)] = value
    for damaged in (bytes(data), bytes(data[:cut])):
        with contextlib.suppress(ParameterError):
            decode_joint_trajectory(damaged)


def test_a_trajectory_longer_than_a_plant_takes_is_refused_before_its_points_are_read() -> None:
    points = MAX_TRAJECTORY_POINTS + 1
    empty = serialization.serialize_message(JointTrajectory(joint_names=[JOINT]))
    # The number of points stands where the empty message ends; none follows, so reading one would fail otherwise.
    place = empty.rindex(JOINT.encode()) + len(JOINT) + 1
    place += -place % 4
    data = empty[:place] + points.to_bytes(4, "little")
    with pytest.raises(ParameterError, match=f"trajectory has {points} points; expected at most {points - 1}"):
        decode_joint_trajectory(data)


@given(
    frame=st.sampled_from(["", "lqr", "/controller", "/sim/pid"]),
    quantities=st.sampled_from([(1.0, 2.0, 3.0), (None, None, 4.0), (1.0, 2.0, None)]),
    place=st.integers(0, 140),
    value=st.integers(0, 255),
    cut=st.integers(0, 8),
)
def test_a_remembered_layout_reads_what_an_unknown_one_would(
    frame: str, quantities: tuple[float | None, ...], place: int, value: int, cut: int
) -> None:
    position, velocity, effort = quantities
    whole = encode_joint_state(5, frame_id=frame, position=position, velocity=velocity, effort=effort)
    data = bytearray(whole)
    data[place % len(data)] = value
    for damaged in (bytes(data), bytes(data) + bytes(cut), bytes(data)[: len(data) - cut]):
        cdr._known_layouts.clear()
        unknown = decode_joint_state(damaged)
        cdr._known_layouts.clear()
        decode_joint_state(whole)
        assert repr(decode_joint_state(damaged)) == repr(unknown)
