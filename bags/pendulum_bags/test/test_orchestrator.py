"""What an experiment's node knows of a plant from its events."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient
from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.names import RECORDER, Event
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.errors import FaultError, PlantStoppedError
from pendulum_msgs_py.ros import qos


def test_of_several_events_of_a_name_the_newest_counts() -> None:
    # (without the graph: only what it has heard)
    plant = PlantClient.__new__(PlantClient)
    plant.events, plant.namespace = [], "/hw"
    assert plant.newest_event(Event.PLANT_MODE) is None
    assert plant.newest_mode() == ""
    plant.check_mode()
    for event in (
        {"name": Event.PLANT_MODE, "mode": Mode.EFFORT.value, "reason": "armed"},
        {"name": Event.PLANT_MODE, "mode": "fault", "reason": "velocity_limit"},
        {"name": Event.NOISE_END},
    ):
        assert plant.is_armed() == (len(plant.events) == 1)
        plant._on_event(String(data=json.dumps(event)))
    assert plant.newest_event(Event.NOISE_START) is None
    assert plant.newest_event(Event.NOISE_END) == {"name": Event.NOISE_END}
    assert plant.newest_mode() == "fault"
    with pytest.raises(PlantStoppedError, match="velocity_limit"):
        plant.check_mode()


@contextmanager
def _listener(
    domain: int, name: str, moves: list[JointTrajectory], profile: QoSProfile = qos.TRAJECTORY
) -> Iterator[None]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node(name, namespace="/hw", context=context)
    node.create_subscription(JointTrajectory, "joint_trajectory", moves.append, profile)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_a_move_is_asked_for_when_it_reaches_the_recorder_too(domain_id: int) -> None:
    seen: list[JointTrajectory] = []
    recorded: list[JointTrajectory] = []
    with Orchestrator(domain_id) as orchestrator:
        plant = PlantClient(orchestrator, "/hw", "plant", watch=False)
        with _listener(domain_id, "plant", seen):
            # Who listens is not who records.
            orchestrator.wait_for("the plant", lambda: plant._trajectory.get_subscription_count() == 1, 10.0)
            with pytest.raises(FaultError, match="recorder on /hw/joint_trajectory"):
                plant.wait_until_moves_are_recorded(0.2)
            # Who asks for old moves gets none at all, and keeps nobody waiting for long.
            wants_old = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            with _listener(domain_id, "late", [], wants_old), _listener(domain_id, RECORDER, recorded):
                plant.wait_until_moves_are_recorded(10.0)
                plant.follow(thesis_ramp(0.0, 0.1), "ramp_up")
                orchestrator.wait_for("the move to arrive", lambda: seen and recorded, 10.0)
