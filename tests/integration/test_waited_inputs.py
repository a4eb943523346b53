"""A node waits for an input itself where the middleware tells, and its executor attends to it where it does not."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.ros import arrivals, qos
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.turns import Turns
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer

STATE = encode_joint_state(1, position=1.0, velocity=2.0, effort=3.0)


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("sender", domain=domain_id)
    yield peer
    peer.close()


@pytest.fixture
def node(peer: GraphPeer) -> Iterator[PollingNode]:
    node = PollingNode("answerer", context=peer.context)
    yield node
    node.destroy_node()


def test_what_comes_is_handed_over_by_whoever_serves_the_input(peer: GraphPeer, node: PollingNode) -> None:
    heard: list[bytes] = []
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    source = node.create_waited_input(JointState, "states", qos.COMMAND_INPUT, heard.append)
    assert source.works
    assert source.subscription not in list(node.subscriptions), "no executor attends to it"
    wait_for(lambda: states.get_subscription_count() == 1, 30.0, "the match")
    assert not source.serve(0.0)
    for count in range(1, 4):
        states.publish(STATE)
        assert source.serve(0.5)
        assert heard == [STATE] * count


def test_serving_ends_when_nothing_comes(node: PollingNode) -> None:
    source = node.create_waited_input(JointState, "states", qos.COMMAND_INPUT, lambda _: None)
    began = time.monotonic()
    assert not source.serve(0.05)
    assert 0.05 <= time.monotonic() - began < 10.0


def test_the_executor_hands_over_where_the_middleware_does_not_tell(
    peer: GraphPeer, node: PollingNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrivals, "_count", lambda *_: False)
    heard: list[bytes] = []
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    source = node.create_waited_input(JointState, "states", qos.COMMAND_INPUT, heard.append)
    assert not source.works
    wait_for(lambda: states.get_subscription_count() == 1, 30.0, "the match")
    executor = EventsExecutor(context=peer.context)
    executor.add_node(node)
    try:
        states.publish(STATE)
        wait_for(lambda: executor.spin_once(0.1) or heard, 30.0, "the state")
    finally:
        executor.remove_node(node)
        executor.shutdown()
    assert heard == [STATE]


@pytest.mark.parametrize(("came", "others"), [(True, 3), (False, 1)])
def test_each_slice_is_followed_by_a_few_turns_of_the_executor(came: bool, others: int) -> None:
    slices: list[float] = []

    def serve(longest: float) -> bool:
        slices.append(longest)
        return came

    turns = Turns(serve, 3)
    for count in range(1, 4):
        for _ in range(others):
            assert turns.run_due() == 0.0
        assert len(slices) == count
