"""Nodes that answer states look at ``/clock`` now and then; by real DDS."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from pendulum_lqr.controller_node import ControllerNode
from pendulum_lqr.disturbance_node import DisturbanceNode
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_clock
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.simulated_time import AnsweringNode
from tests.fixtures import wait_for
from tests.graph_peer import GraphPeer


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("plant", domain=domain_id)
    yield peer
    peer.close()


def test_simulated_time_wakes_nobody_up_and_is_known_all_the_same(peer: GraphPeer) -> None:
    simulated = [Parameter("use_sim_time", value=True)]
    node = AnsweringNode("answers", context=peer.context, parameter_overrides=simulated)
    node.create_subscription(JointState, "states", lambda _: None, qos.STATE)
    clock = peer.node.create_publisher(Clock, names.CLOCK, qos.CLOCK)
    executor = SingleThreadedExecutor(context=peer.context)
    executor.add_node(node)
    try:
        assert [each.topic_name for each in node.subscriptions] == ["/states"]
        wait_for(lambda: clock.get_subscription_count() == 1, 30.0, "the match")
        node.look_at_clock_seldom()

        def known() -> bool:
            clock.publish(encode_clock(7_250_000_000))
            executor.spin_once(0.05)
            return bool(node.get_clock().now().nanoseconds == 7_250_000_000)

        wait_for(known, 30.0, "the time")
    finally:
        executor.shutdown()
        node.destroy_node()


@pytest.mark.parametrize("kind", [ControllerNode, DisturbanceNode])
def test_who_answers_each_step_of_a_plant_is_such_a_node(kind: type) -> None:
    assert issubclass(kind, AnsweringNode)


def test_in_real_time_nobody_looks(peer: GraphPeer) -> None:
    node = AnsweringNode("answers", context=peer.context)
    node.look_at_clock_seldom()
    assert list(node.timers) == []
    node.destroy_node()
