"""What a plant makes of requests and trajectories, on a real node; the graph and the clock are the test's."""

from __future__ import annotations

import select
import time
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract.names import EFFORT_COMMAND
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Mode, PlantLimits
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_to_message, trajectory_to_message
from pendulum_msgs_py.ros.plant_interface import TRAJECTORY_AGE_LIMIT, PlantInterface
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_testing.trajectories import from_points

NOW = 100 * NANOSECONDS


class Plant:
    """The interface of a plant that rests at its zero."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = PollingNode("plant", context=self.context)
        self.supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
        self.interface = PlantInterface(self.node, self.supervisor, lambda: NOW, polled=True)
        self.node.poll_services(timer=False)
        self.interface.sample = JointSample.of_one(NOW, 0.0, 0.0)
        self.said: list[str] = []
        self.interface.publish_diagnostics = lambda: self.said.append("diagnostics")  # type: ignore[method-assign]
        self.interface.publish_event = lambda name, **details: self.said.append(f"{name}: {details}")  # type: ignore[method-assign]
        logger = self.node.get_logger()
        for level in ("info", "error"):
            setattr(logger, level, lambda text, level=level, **_: self.said.append(f"{level}: {text}"))

    def arm(self, wanted: bool = True) -> str:
        answer = self.interface._on_arm(SetBool.Request(data=wanted), SetBool.Response())
        return "" if answer.success else str(answer.message)

    def follow(self, stamped_after: float = 0.0, arrived_ns: int = 0) -> bool:
        """Let a trajectory come; return whether the plant follows it."""
        message: JointTrajectory = trajectory_to_message(from_points([0.0, 1.0], [0.0, 0.1], [0.0, 0.0]))
        message.header.stamp = stamp_to_message(NOW + round(stamped_after * NANOSECONDS))
        self.interface._on_trajectory(serialize_message(message), arrived_ns)
        return self.supervisor.mode is Mode.POSITION

    def close(self) -> None:
        self.interface.close()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def plant(domain_id: int) -> Iterator[Plant]:
    made = Plant(domain_id)
    yield made
    made.close()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_trajectory_from_the_future_moves_nothing_just_as_one_of_the_past(plant: Plant, side: float) -> None:
    assert plant.arm() == ""
    assert not plant.follow(side * (TRAJECTORY_AGE_LIMIT + 0.01))
    assert plant.interface.refused_trajectories == {"invalid": 1}
    assert plant.follow(side * (TRAJECTORY_AGE_LIMIT - 0.01))


def test_a_trajectory_that_came_before_the_plant_was_armed_was_not_meant_for_an_armed_one(plant: Plant) -> None:
    came_ns = time.time_ns()
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.arm() == ""
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.arm() == ""  # once more changes nothing
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.follow(arrived_ns=time.time_ns())


@pytest.mark.parametrize(
    ("waited", "followed"), [(0, True), (1, False), (10 * NANOSECONDS - 1, False), (10 * NANOSECONDS, True)]
)
def test_a_trajectory_waited_if_it_came_before_arming_and_no_clock_was_set_back(
    plant: Plant, waited: int, followed: bool
) -> None:
    assert plant.arm() == ""
    assert plant.follow(arrived_ns=plant.interface._armed_ns - waited) is followed
    told = "info: following a trajectory" if followed else "error: joint_trajectory refused: it came before the plant"
    assert plant.said[1].startswith(told)
    assert followed or plant.said[2].startswith("trajectory_refused: {'reason': 'it came before the plant was armed")


@pytest.mark.parametrize("stamped_after", [-TRAJECTORY_AGE_LIMIT, TRAJECTORY_AGE_LIMIT, -NOW / NANOSECONDS])
def test_a_trajectory_as_old_as_the_limit_and_one_without_a_stamp_are_followed(
    plant: Plant, stamped_after: float
) -> None:
    assert plant.arm() == ""
    assert plant.follow(stamped_after)


def test_a_trajectory_that_the_rules_refuse_is_counted_with_its_reason(plant: Plant) -> None:
    assert plant.arm() == ""
    plant.interface.sample = None
    assert not plant.follow()
    plant.interface.sample = JointSample.of_one(NOW, 3.0, 0.0)
    assert not plant.follow()
    assert plant.interface.refused_trajectories == {"invalid": 2}
    assert "no measurement yet" in plant.said[1]
    assert "trajectory starts at" in plant.said[3]


def test_each_request_is_answered_with_the_mode_and_shown_in_diagnostics_and_what_waited_is_read(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[object] = []
    monkeypatch.setattr(plant.interface._trajectories, "take", read.append)
    for wanted, mode in ((True, "armed_effort"), (True, "armed_effort"), (False, "disarmed")):
        answer = plant.interface._on_arm(SetBool.Request(data=wanted), SetBool.Response())
        assert (answer.success, answer.message) == (True, mode)
    # By the first, which made it ready; each of the others found it so, or ended it.
    assert read == [plant.interface._on_trajectory]
    plant.interface.e_stop("pressed")
    answer = plant.interface._on_e_stop_reset(Trigger.Request(), Trigger.Response())
    assert (answer.success, answer.message) == (True, "disarmed")
    assert plant.said == ["diagnostics"] * 4


def test_arming_looks_for_two_commanders_itself_and_does_not_wait_for_the_next_look(plant: Plant) -> None:
    twins = [rclpy.create_node("twin", context=plant.context, start_parameter_services=False) for _ in range(2)]
    for twin in twins:
        twin.create_publisher(JointState, EFFORT_COMMAND, qos.COMMAND)
    deadline = time.monotonic() + 30.0
    topic = plant.node.resolve_topic_name(EFFORT_COMMAND)
    while [info.node_name for info in plant.node.get_publishers_info_by_topic(topic)] != ["twin", "twin"]:
        assert time.monotonic() < deadline, "twins were not discovered"
        time.sleep(0.005)
    assert "2 commanders named /twin" in plant.arm()
    assert plant.supervisor.mode is Mode.DISARMED
    for twin in twins:
        twin.destroy_node()


def test_a_press_ends_what_compiled_code_does_though_it_sees_nothing_but_its_counters(plant: Plant) -> None:
    called = plant.interface.calls[0]
    plant.node._requests.came()  # type: ignore[union-attr]
    assert not select.select([called], [], [], 0.0)[0]
    plant.interface.e_stop("pressed")
    assert select.select([called], [], [], 0.0)[0]
    assert (plant.supervisor.mode, plant.supervisor.reason) == (Mode.E_STOP, "pressed")
    assert plant.interface._pressed.is_set()


@pytest.mark.parametrize("waited", [0, 1, 10 * NANOSECONDS - 1, 10 * NANOSECONDS])
def test_a_request_counts_for_nothing_that_waited_while_the_e_stop_was_pressed(plant: Plant, waited: int) -> None:
    outdated = 0 < waited < 10 * NANOSECONDS
    before_ns = time.time_ns()
    plant.interface.e_stop("pressed")
    assert before_ns <= plant.interface._pressed_ns <= time.time_ns()
    plant.node.request_ns = plant.interface._pressed_ns - waited
    answer = plant.interface._on_e_stop_reset(Trigger.Request(), Trigger.Response())
    assert answer.success is not outdated
    assert ("before the e-stop was pressed" in answer.message) is outdated
    plant.supervisor.e_stop_reset(NOW)
    assert ("before the e-stop was pressed" in plant.arm()) is outdated
    # To disarm is never outdated, nor is what is not known to have waited.
    assert plant.arm(wanted=False) == ""
    plant.node.request_ns = 0
    assert plant.arm() == ""


def test_a_press_that_was_counted_is_read_once_and_makes_earlier_requests_outdated(plant: Plant) -> None:
    assert plant.interface._unread_press() is None
    plant.interface._e_stop.arrivals.wake()
    before_ns = time.time_ns()
    assert plant.interface._unread_press() == (NOW, "e-stop pressed")
    assert before_ns <= plant.interface._pressed_ns <= time.time_ns()
    assert plant.interface._unread_press() is None
    plant.node.request_ns = plant.interface._pressed_ns - 1
    assert "before the e-stop was pressed" in plant.arm()
