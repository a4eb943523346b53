"""Ways of the bridge's node on which nothing but itself switches the drive off, in simulated time."""

from __future__ import annotations

from collections.abc import Iterator

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


def test_a_bridge_that_is_deactivated_has_switched_its_drive_off_before_it_replies(rig: NodeRig) -> None:
    """No time passes: neither the command lifetime nor a later cycle does it."""
    before_ns = rig.clock.now_ns()
    rig.node._quieten("deactivated")
    assert rig.actuator.strategy is Strategy.OFF
    assert rig.clock.now_ns() == before_ns
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
    assert rig.node.on_deactivate(None) is TransitionCallbackReturn.FAILURE  # type: ignore[arg-type]
    assert rig.actuator.strategy is Strategy.OFF
    assert rig.node.failure is error
    assert (rig.node._loop, rig.node._bridge) == (None, None)
    assert said == [told]
