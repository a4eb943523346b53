"""Who looks at the graph for twins in two threads at once tells what was seen last, on real DDS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from rclpy.node import Node
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import PlantLimits
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.commander_watch import CommanderWatch
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer

_PATIENCE = 30.0


class SlowToCount(Node):
    """Counts the publishers of a topic, and in one thread tells what it has counted only when it is let to."""

    def __init__(self, **options: Any) -> None:
        super().__init__("plant", **options)
        self.slow: int | None = None
        self.has_counted, self.may_tell = threading.Event(), threading.Event()

    def count_publishers(self, topic_name: str) -> int:
        count = super().count_publishers(topic_name)
        if threading.get_ident() == self.slow:
            self.has_counted.set()
            assert self.may_tell.wait(_PATIENCE)
        return int(count)


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("peer", domain=domain_id)
    yield peer
    peer.close()


def test_who_looked_before_twins_came_does_not_tell_afterwards_that_nothing_is_wrong(peer: GraphPeer) -> None:
    plant = SlowToCount(context=peer.context)
    supervisor = SharedSupervisor(PlantLimits(effort=(1.0,)))
    watch = CommanderWatch(plant, supervisor)

    def look_slowly() -> None:
        plant.slow = threading.get_ident()
        watch.check()

    early = threading.Thread(target=look_slowly)
    late = threading.Thread(target=watch.check)
    try:
        early.start()
        assert plant.has_counted.wait(_PATIENCE)
        for _ in range(2):
            twin = peer.add_node("twin")
            twin.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        wait_for(
            lambda: (
                [each.node_name for each in plant.get_publishers_info_by_topic(names.EFFORT_COMMAND)] == ["twin"] * 2
            ),
            _PATIENCE,
            "the twins",
        )
        late.start()
        # Without a turn for each, the later look is over before the earlier one tells.
        late.join(0.2)
        plant.may_tell.set()
        for thread in (early, late):
            thread.join(_PATIENCE)
        assert "2 commanders named /twin" in supervisor.commander_conflict
    finally:
        plant.may_tell.set()
        plant.destroy_node()
