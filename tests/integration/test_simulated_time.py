"""Nodes that answer states live by their stamps and leave ``/clock`` to others; by real DDS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.first_answer import FirstAnswer
from pendulum_msgs_py.ros.simulated_time import live_by_stamps
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer


@pytest.fixture
def make(domain_id: int) -> Iterator[Callable[[bool], Node]]:
    nodes: list[Node] = []
    with closing(GraphPeer("plant", domain=domain_id)) as peer:

        def make(simulated: bool) -> Node:
            given = [Parameter("use_sim_time", value=simulated)]
            node = Node("answers", context=peer.context, parameter_overrides=given)
            node.create_subscription(JointState, "states", lambda _: None, qos.STATE)
            nodes.append(node)
            return node

        yield make
        for node in nodes:
            node.destroy_node()


def test_its_time_is_the_newest_stamp_and_no_clock_wakes_it_up(make: Callable[[bool], Node]) -> None:
    node, stamps = make(True), [7_250_000_000]
    live_by_stamps(node, lambda: stamps[-1] if len(stamps) > 1 else None)
    assert [each.topic_name for each in node.subscriptions] == ["/states"]
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        executor.spin_once(1.0)
        assert node.get_clock().now().nanoseconds == 0
        stamps.append(8_000_000_000)

        def known() -> bool:
            executor.spin_once(0.1)
            return bool(node.get_clock().now().nanoseconds == stamps[-1])

        wait_for(known, 30.0, "the time")
    finally:
        executor.shutdown()


def test_in_real_time_a_node_is_left_as_it_is(make: Callable[[bool], Node]) -> None:
    node = make(False)
    live_by_stamps(node, lambda: 5)
    assert list(node.timers) == []
    assert node.get_clock().now().nanoseconds > 1_500_000_000_000_000_000


def test_the_first_reply_waits_for_a_recorder_that_its_own_graph_does_not_show_yet(domain_id: int) -> None:
    with closing(GraphPeer("controller", domain=domain_id)) as peer:
        publisher = peer.node.create_publisher(JointState, "effort_command", qos.COMMAND)
        waiting, trusting = FirstAnswer(peer.node, publisher, 2), FirstAnswer(peer.node, publisher, 0)
        peer.node.create_subscription(JointState, "effort_command", lambda _: None, qos.COMMAND)  # the plant
        wait_for(lambda: publisher.get_subscription_count() == 1, 30.0, "the plant's match")
        assert trusting.may_go()
        assert not waiting.may_go()
        peer.node.create_subscription(JointState, "effort_command", lambda _: None, qos.COMMAND)  # the recorder
        wait_for(lambda: publisher.get_subscription_count() == 2, 30.0, "the recorder's match")
        assert waiting.may_go()
