"""Ways of the bridge's node on which nothing but itself switches the drive off, in simulated time."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.lifecycle import TransitionCallbackReturn

from pendulum_hw_bridge.port.actuator import Strategy
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.errors import ParameterError
from tests.tools.faults.node_rig import NodeRig, ros_of_its_own


@pytest.fixture
def rig(domain_id: int) -> Iterator[NodeRig]:
    with ros_of_its_own(domain_id), NodeRig(start=0.0) as rig:
        rig.run(0.1)
        assert rig.arm() == ""
        assert rig.actuator.strategy is not Strategy.OFF
        yield rig


def recorded(rig: NodeRig, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return what the node says from now on."""
    said: list[str] = []
    monkeypatch.setattr(rig.node, "_tell_pending_stop", lambda: said.append("pending stop"))
    monkeypatch.setattr(rig.node._interface, "publish_diagnostics", lambda: said.append("diagnostics"))
    return said


@pytest.mark.parametrize("with_loop", [True, False])
def test_a_bridge_that_lets_its_actuator_go_has_switched_it_off_with_a_thread_and_without(
    rig: NodeRig, monkeypatch: pytest.MonkeyPatch, with_loop: bool
) -> None:
    said = recorded(rig, monkeypatch)
    lockstep: Any = SimpleNamespace(paused=False)
    rig.node._lockstep_loop = lockstep
    if not with_loop:
        rig.node._loop = None
    rig.node.release_actuator()
    rig.node._lockstep_loop = None
    assert rig.actuator.strategy is Strategy.OFF
    assert (rig.node._active, rig.node._loop, rig.node._bridge) == (False, None, None)
    assert lockstep.paused
    assert said == ["pending stop"]


def test_a_bridge_that_is_deactivated_has_switched_its_drive_off_before_it_replies(
    rig: NodeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command lifetime that runs out ends torque, and leaves the strategy in force."""
    said = recorded(rig, monkeypatch)
    lockstep: Any = SimpleNamespace(paused=False)
    rig.node._lockstep_loop = lockstep
    rig.node._quieten("deactivated")
    rig.node._lockstep_loop = None
    assert said == ["pending stop", "diagnostics"]
    assert lockstep.paused
    assert rig.actuator.strategy is Strategy.OFF
    assert rig.actuator.lifetime_expiries == 0
    assert not rig.loop.active
    assert not rig.node._active
    assert rig.supervisor.mode is Mode.DISARMED
    assert "not active" in rig.arm()


@pytest.mark.parametrize(
    ("error", "told"),
    [(ParameterError("too little"), "too little"), (ValueError("x"), "on_deactivate: ValueError: x")],
    ids=["known", "unknown"],
)
def test_a_transition_that_fails_releases_the_actuator_and_says_why(
    rig: NodeRig, monkeypatch: pytest.MonkeyPatch, error: Exception, told: str
) -> None:
    def fail(_reason: str) -> None:
        raise error

    said: list[str] = []
    monkeypatch.setattr(rig.node, "_quieten", fail)
    monkeypatch.setattr(rig.node.get_logger(), "error", lambda text, **_: said.append(text))
    assert rig.node.on_deactivate(None) is TransitionCallbackReturn.FAILURE
    assert rig.actuator.strategy is Strategy.OFF
    assert rig.node.failure is error
    assert (rig.node._loop, rig.node._bridge) == (None, None)
    assert said == [told]
