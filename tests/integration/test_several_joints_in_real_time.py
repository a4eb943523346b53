"""What plants of several joints refuse while time goes on, and how they end."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from tests.joints_peer import JointsPeer

JOINTS = ["shoulder", "elbow"]


@pytest.fixture
def peer(domain_id: int) -> Iterator[JointsPeer]:
    with closing(JointsPeer()) as peer:
        yield peer


def _until_counted(peer: JointsPeer, node: str, key: str, before: int) -> None:
    # Diagnostics come twice a second, and to whoever asks for a reset in vain.
    def counted() -> bool:
        peer.call(Trigger, f"{node}/e_stop_reset", Trigger.Request())
        return int(peer.diagnostics.get(key, 0)) > before

    peer.until(counted, f"{peer.answer} refused as {key}")


@pytest.mark.parametrize("node", ["simulator", "bridge"])
def test_commands_for_other_joints_move_nothing_and_are_counted_and_the_e_stop_ends_all(
    peer: JointsPeer, processes, node: str
) -> None:
    if node == "simulator":
        package, settings = "pendulum_sim", ["rate_hz:=100.0", "start_effort_limit:=0.0"]
    else:
        package = "pendulum_hw_bridge"
        settings = ["feedback_rate:=50.0", "feedback_watchdog:=50", "command_lifetime:=2.0"]
        settings += ["start_effort_limit:=0.0", "starvation_limit:=0.0", "velocity_limit:=0.0"]
    settings += ["plant:=double_pendulum", "command_timeout:=0.5"]
    arguments = [item for setting in settings for item in ("-p", setting)]
    processes.start(package, node, "--ros-args", "-r", "__ns:=/sim", *arguments)
    peer.until(lambda: len(peer.states) > 3, "states")
    if node == "bridge":
        armed = peer.call(SetBool, "bridge/arm", SetBool.Request(data=True))
        assert armed.success, armed.message
    assert [list(state.name) for state in peer.states] == [JOINTS] * len(peer.states)
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"name": ["elbow", "shoulder"], "effort": [1.0, 2.0]}, "other_joint"),
        ({"name": ["shoulder", "knee"], "effort": [1.0, 2.0]}, "other_joint"),
        ({"name": ["elbow", "elbow"], "effort": [1.0, 2.0]}, "other_joint"),
        ({"name": ["elbow"], "effort": [1.0]}, "not_one_joint"),
        ({"name": JOINTS, "effort": [1.0]}, "not_one_joint"),
        ({"name": [], "effort": [1.0, 2.0]}, "not_one_joint"),
        ({"name": JOINTS, "effort": [1.0, math.nan]}, "not_finite"),
    ]
    for answer, reason in wrong:
        key = f"effort_command.refused.{reason}"
        before = int(peer.diagnostics.get(key, 0))
        peer.answer = answer
        _until_counted(peer, node, key, before)
    peer.answer = None
    assert all(list(message.name) == JOINTS and list(message.effort) == [0.0, 0.0] for message in peer.applied)

    peer.trajectories.publish(JointTrajectory(joint_names=JOINTS))
    refused = peer.until(lambda: [e for e in peer.events if e["name"] == names.Event.TRAJECTORY_REFUSED], "the refusal")
    assert "follows no trajectory" in refused[0]["reason"]

    peer.answer = {"name": JOINTS, "effort": [1.0, -9.0]}
    peer.until(lambda: list(peer.applied[-1].effort) == [1.0, -6.0], "torque within each joint's limit")
    assert peer.call(Trigger, f"{node}/e_stop", Trigger.Request()).success
    peer.until(lambda: list(peer.applied[-1].effort) == [0.0, 0.0], "no torque")
    count = len(peer.applied)
    peer.until(lambda: len(peer.applied) > count + 20, "more periods")
    assert all(list(message.effort) == [0.0, 0.0] for message in peer.applied[count:])
