"""A picture shows the disturbance that acts on the plant, not the one that somebody asks for."""

from __future__ import annotations

import pytest

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_sim.pictures.shown_torques import ShownTorques

_NOW = 10**18
_MS = 1_000_000


@pytest.mark.parametrize(
    ("mode", "applied", "command", "disturbance", "acting"),
    [
        ("armed_effort", 3.5, 1.0, 2.5, 2.5),
        ("", 3.5, 1.0, 2.5, 2.5),
        ("armed_effort", -3.5, -1.0, -2.5, -2.5),
        # The limit takes some of it away, or all.
        ("armed_effort", 13.0, 12.0, 2.5, 1.0),
        ("armed_effort", 13.0, 20.0, 2.5, 0.0),
        # Nobody commands: zero torque. Not armed, or holding by itself: the plant adds nothing.
        ("armed_effort", 0.0, 1.0, 2.5, 0.0),
        ("disarmed", 0.0, -2.0, 2.5, 0.0),
        ("armed_position", 4.0, 1.0, 2.5, 0.0),
        ("fault", 4.0, 1.0, 2.5, 0.0),
    ],
)
def test_a_disturbance_is_shown_as_far_as_it_acts(
    mode: str, applied: float, command: float, disturbance: float, acting: float
) -> None:
    torques = ShownTorques()
    torques.mode = mode
    for topic, effort in (
        (names.APPLIED_EFFORT, applied),
        (names.EFFORT_COMMAND, command),
        (names.DISTURBANCE, disturbance),
    ):
        torques.note(topic, JointCommand.of_one(_NOW, effort))
    assert torques.acting(names.DISTURBANCE, _NOW) == pytest.approx(acting)
    assert torques.acting(names.APPLIED_EFFORT, _NOW) == applied


def test_a_disturbance_without_a_command_or_of_the_past_is_not_shown() -> None:
    torques = ShownTorques()
    torques.note(names.APPLIED_EFFORT, JointCommand.of_one(_NOW, 3.5))
    torques.note(names.DISTURBANCE, JointCommand.of_one(_NOW, 2.5))
    assert torques.acting(names.DISTURBANCE, _NOW) == 0.0
    torques.note(names.EFFORT_COMMAND, JointCommand.of_one(_NOW - 100 * _MS, 1.0))
    assert torques.acting(names.DISTURBANCE, _NOW) == 0.0
    torques.note(names.EFFORT_COMMAND, JointCommand.of_one(_NOW, 1.0))
    assert torques.acting(names.DISTURBANCE, _NOW) == 2.5
    assert torques.acting(names.DISTURBANCE, _NOW + 600 * _MS) == 0.0


def test_a_push_on_the_link_acts_whatever_the_plant_does() -> None:
    torques = ShownTorques()
    torques.mode = "disarmed"
    torques.note(names.PUSH, JointCommand.of_one(_NOW, 0.7))
    assert torques.acting(names.PUSH, _NOW) == 0.7
    assert torques.acting(names.PUSH, _NOW + 600 * _MS) == 0.0


def test_each_joint_shows_its_own_torque() -> None:
    torques = ShownTorques()
    joints = ("cart", "pole")
    for topic, effort in ((names.APPLIED_EFFORT, 3.5), (names.EFFORT_COMMAND, 1.0), (names.DISTURBANCE, 2.5)):
        torques.note(topic, JointCommand(_NOW, (effort,), joints=("cart",)))
    torques.note(names.PUSH, JointCommand(_NOW, (float("nan"), 0.2), joints=joints))
    assert torques.acting_on(names.DISTURBANCE, _NOW, joints) == {"cart": 2.5}
    assert torques.acting_on(names.PUSH, _NOW, joints) == {"pole": 0.2}
    assert torques.acting(names.APPLIED_EFFORT, _NOW) == 0.0
