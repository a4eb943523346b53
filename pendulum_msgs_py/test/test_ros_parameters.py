"""Parameters of a node while it runs: what is refused leaves no trace, what is accepted acts once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_testing.graph_peer import GraphPeer

_SPECS = (ParameterSpec("gain", 1.0, "N m/rad", "Gain.", minimum=0.0), ParameterSpec("name", "a", "", "Name."))


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("parameters", domain=domain_id)
    yield peer
    peer.close()


def _prepare(values: Mapping[str, Any]) -> str:
    if values["gain"] > 10.0:
        raise ParameterError("too much")
    return f"design for {values['gain']}"


def test_a_change_that_somebody_else_refuses_is_not_applied(peer: GraphPeer) -> None:
    node = peer.node
    applied: list[str] = []
    someone_refuses = False
    settings = NodeParameters(node, _SPECS, _prepare, applied.append)
    # ROS asks the callbacks in the reverse order of their registration: this one is asked after ours.
    ours = node._on_set_parameters_callbacks.pop(0)
    node.add_on_set_parameters_callback(lambda _: SetParametersResult(successful=not someone_refuses, reason="not now"))
    node._on_set_parameters_callbacks.insert(0, ours)

    def change(**values: object) -> bool:
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        return bool(node.set_parameters_atomically(parameters).successful)

    someone_refuses = True
    assert not change(gain=2.0)
    assert (applied, settings["gain"]) == ([], 1.0)
    someone_refuses = False
    assert not change(gain=11.0)
    assert (applied, settings["gain"]) == ([], 1.0)
    assert change(gain=3.0, name="b")
    assert (applied, settings.values) == (["design for 3.0"], {"gain": 3.0, "name": "b"})
    # What changes nothing acts on nothing.
    assert change(gain=3.0)
    assert applied == ["design for 3.0"]


def test_simulated_time_is_chosen_at_the_start_of_a_node(peer: GraphPeer) -> None:
    NodeParameters(peer.node, _SPECS)
    result = peer.node.set_parameters([Parameter("use_sim_time", value=True)])[0]
    assert not result.successful
    assert "expected it at start: -p use_sim_time:=true" in result.reason
    assert peer.node.get_clock().ros_time_is_active is False
    assert peer.node.set_parameters([Parameter("use_sim_time", value=False)])[0].successful
