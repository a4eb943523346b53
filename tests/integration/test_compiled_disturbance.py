"""A disturbance that answers compiled and one that does not: the same torques and events, over real DDS."""

from __future__ import annotations

import json
from contextlib import closing

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup

_SPACES = ("/a", "/b")
_MS = 1_000_000
_NOW = 1_000 * _MS
_DURATION = 0.4


def _stamps() -> list[int]:
    """Return the stamps of states that jitter about 5 ms: the middle interval changes, and states are lost."""
    stamps = [_NOW]
    for k in range(1, 130):
        stamps.append(stamps[-1] + 5 * _MS + (k * 7919 % 11 - 5) * 100_000 + (5 * _MS if k % 17 == 0 else 0))
    return stamps


def test_torques_and_events_are_the_same_compiled_and_interpreted(processes: ProcessGroup, domain_id: int) -> None:
    torques: tuple[list[bytes], list[bytes]] = ([], [])
    events: tuple[list[str], list[str]] = ([], [])
    said: dict[str, dict[str, str]] = {}

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            said[status.name[:2]] = {pair.key: pair.value for pair in status.values}

    with closing(GraphPeer("plant")) as peer:
        states = [peer.node.create_publisher(JointState, f"{space}/joint_states", qos.STATE) for space in _SPACES]
        for space, heard, told in zip(_SPACES, torques, events, strict=True):
            peer.node.create_subscription(JointState, f"{space}/disturbance", heard.append, qos.COMMAND, raw=True)
            peer.node.create_subscription(
                String, f"{space}/events", lambda message, told=told: told.append(message.data), qos.EVENTS
            )
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, qos.DIAGNOSTICS)
        for space, compiled in zip(_SPACES, ("true", "false"), strict=True):
            processes.start(
                "pendulum_lqr", "disturbance", "--ros-args", "-r", f"__ns:={space}", "-p", "autostart:=true",
                "-p", f"duration:={_DURATION}", "-p", "seed:=7", "-p", f"compiled:={compiled}",
            )  # fmt: skip
        peer.until(lambda: all(each.get_subscription_count() for each in states) and len(said) == 2, "both", 120.0)
        peer.until(lambda: all(peer.node.count_publishers(f"{space}/disturbance") for space in _SPACES), "publishers")
        peer.spin(0.5)
        assert [said[space]["loop"] for space in _SPACES] == ["compiled", "interpreted: compiled is false"]

        def send(stamp_ns: int, answers: int) -> None:
            counts = [len(heard) + answers for heard in torques]
            data = encode_joint_state(stamp_ns, position=1.0, velocity=0.0, effort=0.0)
            for each in states:
                each.publish(data)
            if answers:
                peer.until(lambda: [len(heard) for heard in torques] >= counts, "answers of both")
            else:
                peer.spin(0.1)
                # One that stood still meanwhile would find the next in its place, and refuse one state less.
                for space in _SPACES:
                    asked = GetParameters.Request(names=["compiled"])
                    peer.call(GetParameters, f"{space}/disturbance/get_parameters", asked)
            assert [len(heard) for heard in torques] == counts

        for k, stamp_ns in enumerate(_stamps()):
            send(stamp_ns, 1)
            if k == 40:
                send(stamp_ns, 0)
                send(stamp_ns - _MS, 0)
        peer.until(lambda: all(len(told) == 2 for told in events), "beginning and end")
        peer.until(lambda: all(each.get("refused") == "2" for each in said.values()), "what was refused")

    fields = [[decode_joint_state(data) for data in heard] for heard in torques]
    for compiled, interpreted in zip(*fields, strict=True):
        assert compiled is not None
        assert interpreted is not None
        assert compiled[2:] == interpreted[2:]
        assert compiled.stamp_ns == interpreted.stamp_ns
    efforts = [each.effort[0] for each in fields[0] if each is not None]
    assert len(set(efforts)) > 30
    assert efforts[-1] == 0.0
    assert [json.loads(told)["name"] for told in events[0]] == ["noise_start", "noise_end"]
    assert [json.loads(told) for told in events[0]] == [json.loads(told) for told in events[1]]
