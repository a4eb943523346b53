"""The black box: the last seconds before a fault or an e-stop, in bounded memory, in a bag of its own."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import event_message
from pendulum_rosbag.reader.bag import read_bag
from pendulum_rosbag.recorder.black_box import BlackBox
from pendulum_rosbag.recorder.options import RecorderOptions
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup

_S = NANOSECONDS
_NOW = 1000 * _S


def _event(mode: str, stamp_ns: int = _NOW, name: str = "plant_mode") -> bytes:
    return bytes(serialize_message(event_message(stamp_ns, name, mode=mode, reason="why")))


@pytest.mark.parametrize(
    ("event", "due"),
    [
        (_event("fault"), True),
        (_event("e_stop"), True),
        (_event("disarmed"), False),
        (_event("fault", name="trial_start"), False),
        # Kept by its topic for latecomers: of a fault before the black box.
        (_event("fault", _NOW - 60 * _S), False),
        (b"\0\1\0\0\5\0\0\0no {}", False),
        (b"", False),
    ],
)
def test_a_fault_and_an_e_stop_are_written_with_the_second_after_them(event: bytes, due: bool) -> None:
    box: BlackBox[str] = BlackBox(10.0)
    box.poll(event, _NOW)
    assert not box.is_due(_NOW + _S - 1)
    assert box.is_due(_NOW + _S) is due
    assert box.reason.endswith("why") is due
    box.empty()
    assert not box.is_due(_NOW + 2 * _S)


def test_messages_are_kept_for_the_stated_time_within_the_stated_memory_and_sorted() -> None:
    box: BlackBox[str] = BlackBox(10.0, max_bytes=100)
    box.keep("b", [(_NOW - 11 * _S, b"old"), (_NOW - 10 * _S, b"first"), (_NOW, b"last")])
    box.keep("a", [(_NOW - 5 * _S, b"middle")])
    box.is_due(_NOW)
    assert [data for _, _, data in box.empty()] == [b"first", b"middle", b"last"]
    for second in range(100):
        box.keep("a", [(_NOW + second, bytes(10))])
    assert [time_ns - _NOW for _, time_ns, _ in box.empty()] == list(range(90, 100))
    assert box.empty() == []


def test_a_black_box_has_the_times_of_arrival() -> None:
    with pytest.raises(ParameterError, match="log time is 'header' with a black box"):
        RecorderOptions(Path("bag"), black_box=10.0, log_time="header")
    with pytest.raises(ParameterError, match=r"black-box is -1.0"):
        RecorderOptions(Path("bag"), black_box=-1.0)


def test_an_e_stop_of_the_emulated_x5_9_leaves_a_bag_whose_path_is_in_diagnostics(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    folder = tmp_path / "stops"
    recorder = processes.start("pendulum_rosbag", "record", "-o", folder, "--black-box", "10", "--regex", "^/lab/")
    limits = {"command_timeout": 0.5, "command_lifetime": 0.5, "feedback_watchdog": 20, "feedback_rate": 25.0}
    plant = graph.bridge("/lab", backend="emulator", **limits)
    processes.start(plant.package, plant.executable, *plant.ros_arguments())
    with closing(PlantPeer("/lab")) as peer:
        peer.patience = 120.0
        applied: list[float] = []
        peer.node.create_subscription(
            JointState, names.APPLIED_EFFORT, lambda message: applied.append(message.effort[0]), qos.STATE
        )
        peer.until(lambda: peer.states, "the plant")
        recorder.wait_for_output("subscribed to /lab/events", 120.0)
        for number in (1, 2):
            peer.torque = None
            # Not while the torque of the round before is fresh.
            arm = SetBool.Request(data=True)
            peer.until(lambda arm=arm: peer.call(SetBool, "bridge/arm", arm).success, "an armed plant")  # type: ignore[misc]
            peer.torque = 1.0
            # Diagnostics report the commander before the first period that applies its torque has been recorded.
            applied.clear()
            # Several, since a busy recorder may lose one of them.
            peer.until(lambda: applied.count(1.0) >= 5, "torque")
            assert peer.call(Trigger, "bridge/e_stop", Trigger.Request()).success
            bags = [folder, folder.with_name("stops_2")][:number]
            recorder.wait_for_output(rf"recorded .* in {bags[-1]}[,;]", 120.0)
            peer.until(lambda b=bags: peer.diagnostics.get("black_box") == str(b[-1]), "its path")  # type: ignore[misc]
            assert peer.call(Trigger, "bridge/e_stop_reset", Trigger.Request()).success
    for path in bags:
        with read_bag(path) as bag:
            assert bag.damage == []
            assert {"/lab/joint_states", "/lab/effort_command", "/lab/applied_effort", "/lab/events"} <= set(bag)
            told = [json.loads(stored.message.data) for stored in bag.messages("/lab/events")]
            assert any(event.get("mode") == "e_stop" and event["reason"] == "e-stop pressed" for event in told)
            assert abs(bag["/lab/applied_effort"]["effort"]).max() == pytest.approx(1.0)
            assert bag["/lab/applied_effort"]["effort"][-1] == 0.0
