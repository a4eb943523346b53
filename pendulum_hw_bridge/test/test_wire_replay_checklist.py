"""Packets from strangers, recordings from disk, parameters and the checklist before arming."""

import json
import math
import socket
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from pendulum_hw_bridge.backends.replay import FeedbackRecording, ReplayBackend, load_feedback
from pendulum_hw_bridge.bridge.bridge_parameters import BRIDGE_SPECS, make_port
from pendulum_hw_bridge.emulation import wire
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.server import EmulatorServer
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import Command, Feedback, HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.feedback_message import QUANTITIES, encode_feedback
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.errors import DataError, ParameterError, PendulumError
from pendulum_msgs_py.parameters import validate
from pendulum_testing.bag_messages import joint_state, write_bag


def a_record() -> Feedback:
    actuator = EmulatedX5(load_emulator("x5_9"), position=0.4)
    actuator.advance_to(20_000_000)
    record = actuator.feedback(20_000_000)
    assert record is not None
    return record


def test_feedback_and_commands_come_through_the_wire_unchanged() -> None:
    record = a_record()
    assert str(wire.decode_feedback(wire.encode_feedback(record))) == str(
        record._replace(temperature_state=0, lock=0, position_limit=2, velocity_limit=2, effort_limit=2)
    )
    command = Command(position=1.0, pwm=-0.5)
    assert str(wire.decode_command(wire.encode_command(command))) == str(command)
    assert wire.gains_from_json(wire.gains_to_json(DEFAULT_GAINS[2])) == DEFAULT_GAINS[2]
    limits = HardwareLimits(effort=3.0, position_min=-1.0)
    assert wire.limits_from_json(wire.limits_to_json(limits)) == limits


@given(st.binary(max_size=300), st.sampled_from([b"", wire.COMMAND, wire.FEEDBACK, wire.REQUEST, wire.REPLY]))
@example(wire.encode_command(Command(position=1.0))[len(wire.COMMAND) :], wire.COMMAND)
@example(wire.encode_command(Command(position=math.inf))[len(wire.COMMAND) :], wire.COMMAND)
@example(wire.encode_feedback(a_record())[len(wire.FEEDBACK) :], wire.FEEDBACK)
@example(b'{"push": 1.0}', wire.REQUEST)
@example(b"[1]", wire.REQUEST)
def test_a_packet_is_read_in_full_or_not_at_all(tail: bytes, head: bytes) -> None:
    packet = head + tail
    sizes = [len(wire.encode_command(Command())), len(wire.encode_feedback(a_record()))]
    command = wire.decode_command(packet)
    assert command is None or len(packet) == sizes[0]
    if command is not None:
        setpoints = (command.position, command.velocity, command.effort, command.pwm)
        assert not any(math.isinf(value) for value in setpoints)
        assert str(wire.decode_command(wire.encode_command(command))) == str(command)
    else:
        assert len(packet) != sizes[0] or b"\xf0\x7f" in packet or b"\xf0\xff" in packet
    feedback = wire.decode_feedback(packet)
    assert (feedback is not None) == (len(packet) == sizes[1])
    value = wire.decode_json(packet)
    assert isinstance(value, dict)
    if value:
        assert json.loads(packet[len(wire.REQUEST) :]) == value or "NaN" in str(packet)
    if head:
        assert wire.kind_of(packet) == head


SERVED = EmulatorServer(EmulatedX5(load_emulator("thesis")), ("127.0.0.1", 0), lambda: 0)


@given(
    st.one_of(
        st.binary(max_size=60).map(lambda tail: wire.COMMAND + tail),
        st.recursive(
            st.one_of(st.none(), st.booleans(), st.integers(-5, 5), st.floats(allow_nan=False), st.text(max_size=5)),
            lambda inner: st.dictionaries(
                st.sampled_from(["settings", "strategy", "gains", "limits", "push", "inject", "command_lifetime"]),
                inner,
                max_size=3,
            ),
            max_leaves=6,
        ).map(lambda value: wire.REQUEST + json.dumps(value).encode()),
    )
)
@example(wire.REQUEST + b'{"push": Infinity}')
@example(wire.REQUEST + b'{"push": NaN}')
@example(wire.REQUEST + b'{"push": 1e400}')
@example(wire.REQUEST + b'{"settings": {"strategy": Infinity}}')
@example(wire.REQUEST + b'{"settings": {"strategy": 3, "command_lifetime": Infinity}}')
def test_after_any_request_of_a_stranger_the_emulator_answers_and_stays_finite(packet: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as friend:
        friend.bind(("127.0.0.1", 0))
        friend.settimeout(5.0)
        SERVED._receive(packet, ("127.0.0.1", 9), 0)
        assert math.isfinite(SERVED.actuator.push)
        SERVED._receive(wire.encode_json(wire.REQUEST, {"id": 7, "push": 0.25}), friend.getsockname(), 0)
        reply = wire.decode_json(friend.recv(65536))
    assert reply["id"] == 7
    assert not reply.get("error")
    assert SERVED.actuator.push == 0.25
    SERVED.actuator.push = 0.0


@pytest.mark.skipif(not hasattr(socket.socket, "recvmsg") or sys.platform != "linux", reason="Linux stamps packets")
def test_a_module_acts_on_a_packet_when_it_came_though_its_process_ran_later() -> None:
    """A busy machine keeps an emulator from running; a module on a network of its own is not kept."""
    clock = SteadyWallClock()
    server = EmulatorServer(EmulatedX5(load_emulator("thesis"), start_ns=clock()), ("127.0.0.1", 0), clock)
    actuator, delay_ns = server.actuator, 20_000_000
    actuator.configure(strategy=Strategy.DIRECT_PWM, command_lifetime=1.0)
    seen: list[tuple[int, float]] = []
    actuator.trace = lambda link: seen.append((link.time_ns, link.pwm))

    def starve(packet: bytes) -> int:
        """Send a packet, and let the server run later; return when it was sent [ns]."""
        server._turn(0.0)
        friend.sendto(packet, server.address)
        sent_ns = clock()
        while clock() < sent_ns + 5 * delay_ns:
            time.sleep(0.001)
        server._turn(0.0)
        return sent_ns

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as friend:
        driven_ns = starve(wire.encode_command(Command(pwm=0.25)))
        assert actuator.last_command_ns is not None
        assert abs(actuator.last_command_ns - driven_ns) < delay_ns
        off_ns = starve(wire.encode_json(wire.REQUEST, {"id": 1, "settings": {"strategy": int(Strategy.OFF)}}))
    assert actuator.strategy is Strategy.OFF
    driven = [time_ns for time_ns, duty in seen if duty != 0.0]
    assert abs(driven[0] - driven_ns) < delay_ns
    assert abs(driven[-1] - off_ns) < delay_ns
    server._socket.close()


@pytest.mark.parametrize("step_ns", [-(10**12), 10**12])
def test_a_step_of_the_system_clock_moves_no_packet_out_of_its_turn(
    monkeypatch: pytest.MonkeyPatch, step_ns: int
) -> None:
    clock = SteadyWallClock()
    server = EmulatorServer(EmulatedX5(load_emulator("thesis"), start_ns=clock()), ("127.0.0.1", 0), clock)
    server._turn(0.0)
    turned_ns = server.actuator.now_ns
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as friend:
        friend.sendto(wire.encode_command(Command(effort=0.25)), server.address)
        now = time.time_ns
        monkeypatch.setattr(time, "time_ns", lambda: now() + step_ns)
        until = time.monotonic() + 10.0
        while server.actuator.last_command_ns is None:  # It acts once the emulated link has carried it.
            assert time.monotonic() < until
            server._turn(0.01)
    assert turned_ns <= server.actuator.last_command_ns <= clock()
    server._socket.close()


@pytest.mark.parametrize("address", ["", "localhost", "host:", ":80", "host:x", "host:70000"])
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(ParameterError, match="expected HOST:PORT"):
        wire.parse_address(address)


def test_an_address_in_use_is_reported() -> None:
    with pytest.raises(PendulumError, match="emulator cannot listen on"):
        EmulatorServer(SERVED.actuator, SERVED.address)


def test_records_of_several_modules_are_one_message_with_the_joint_before_each_quantity() -> None:
    first, second = a_record(), a_record()._replace(position=-0.25, stamp_ns=a_record().stamp_ns + 5)
    message = deserialize_message(encode_feedback([second, first], ("cart", "pole")), JointState)
    assert list(message.name) == [f"{joint}/{name}" for joint in ("cart", "pole") for name in QUANTITIES]
    read = dict(zip(message.name, message.position, strict=True))
    assert (read["cart/position"], read["pole/position"]) == (-0.25, first.position)
    assert read["pole/processor_temperature"] == first.processor_temperature
    assert message.header.stamp.nanosec == first.stamp_ns % 1_000_000_000  # as old as the oldest part
    stamped = deserialize_message(encode_feedback([first], (), 7), JointState)
    assert (stamped.header.stamp.sec, stamped.header.stamp.nanosec) == (0, 7)


def test_the_full_record_is_a_joint_state_that_ros_reads() -> None:
    record = a_record()
    message = deserialize_message(encode_feedback([record]), JointState)
    assert tuple(message.name) == QUANTITIES
    read = dict(zip(message.name, message.position, strict=True))
    assert read["position"] == record.position
    assert math.isnan(read["effort_command"])
    assert read["processor_temperature"] == record.processor_temperature
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(record.stamp_ns, 1_000_000_000)
    assert not message.velocity
    assert not message.effort


def test_replay_plays_what_was_recorded_when_it_was_recorded(tmp_path: Path) -> None:
    time = np.arange(0.0, 1.0, 0.01)
    columns = {
        "time": 5.0 + time,
        "position": time,
        "velocity": 2 * time,
        "effort": 3 * time,
        "pwm_command": 0 * time,
    }
    np.savez(tmp_path / "run.npz", **columns)
    header = ",".join(columns)
    np.savetxt(
        tmp_path / "run.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=header,
        comments="",
    )
    for name in ("run.npz", "run.csv"):
        port = ReplayBackend(load_feedback(tmp_path / name), SteppedClock())
        port.connect()
        records = []
        while (record := port.read(0.05)) is not None:
            records.append(record)
        assert len(records) == 100
        assert port.finished
        np.testing.assert_allclose([record.effort for record in records], 3 * time)
        np.testing.assert_allclose([record.stamp_ns * 1e-9 for record in records], time, atol=1e-9)
        assert math.isnan(records[0].winding_current)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,position\n0,1\n", "velocity is missing"),
        ("time,position,velocity,effort\n0,1,1,1\n0,1,1,1\n", "time does not increase"),
        ("time,position,velocity,effort\n0,1,1\n", ":2: 3 values; expected 4"),
        ("time,position,velocity,effort\n0,1,x,1\n", "velocity is 'x'; expected a number"),
        ("time,position,velocity,torque\n0,1,1,1\n", "unknown quantity 'torque'"),
        ("time,time\n", "given twice"),
        ("", "time is missing"),
    ],
)
def test_a_wrong_recording_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        load_feedback(path)
    with pytest.raises(DataError, match="cannot be read"):
        load_feedback(tmp_path / "missing.csv")
    other = tmp_path / "run.txt"
    other.write_text(text)
    with pytest.raises(DataError, match=r"expected \.npz, \.csv or \.hebilog"):
        load_feedback(other)


def test_a_bag_is_replayed_and_one_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from pendulum_msgs_py.contract.cdr import encode_joint_state

    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        states = writer.add_connection("/hw/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for i in range(20):
            stamp = 1_700_000_000_000_000_000 + 10_000_000 * i
            writer.write(states, stamp, encode_joint_state(stamp, position=0.1 * i, velocity=1.0, effort=0.5))
    recording = load_feedback(tmp_path / "bag")
    np.testing.assert_allclose(recording.columns["position"], 0.1 * np.arange(20))
    np.testing.assert_allclose(np.diff(recording.time_ns), 10_000_000, atol=1000)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(DataError, match=r"bag .* cannot be read: \S+"):
        load_feedback(tmp_path / "bag")


@pytest.mark.parametrize("topic", ["joint_states", "actuator/feedback"])
def test_a_bag_of_several_joints_is_refused_instead_of_replaying_the_first(tmp_path: Path, topic: str) -> None:
    prefix = "" if topic == "joint_states" else "/position"
    names = [f"{joint}{prefix}" for joint in ("cart", "pole")]
    data = joint_state(1_700_000_000_000_000_000, "", names, [0.1, 3.1], [0.0, 0.0], [0.0, 0.0])
    write_bag(tmp_path / "bag", [(f"/hw/{topic}", 1_700_000_000_000_000_000, data)], seal_every=1)
    with pytest.raises(DataError, match=r"is of several joints \(cart, pole\); expected feedback of one module$"):
        load_feedback(tmp_path / "bag")


def test_a_recording_needs_equal_lengths() -> None:
    with pytest.raises(DataError, match=r"effort has shape \(1,\)"):
        FeedbackRecording({"time": [0.0, 1.0], "position": [0, 0], "velocity": [0, 0], "effort": [0]})


def test_defaults_of_all_parameters_pass_their_own_checks() -> None:
    values = validate(BRIDGE_SPECS, {})
    assert {spec.name: spec.check(values[spec.name]) for spec in BRIDGE_SPECS} == values
    with pytest.raises(ParameterError, match="did you mean 'backend'"):
        validate(BRIDGE_SPECS, {"bakend": "hebi"})


def test_only_the_emulator_can_run_in_lockstep() -> None:
    values = validate(BRIDGE_SPECS, {"backend": "hebi"})
    with pytest.raises(ParameterError, match="expected backend 'emulator'"):
        make_port(values, SteppedClock(), lockstep=True)
