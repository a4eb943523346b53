"""``FollowJointTrajectory`` on both plants, where its type can be had: on a full ROS, or built on the wheels."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any

import pytest
from rclpy.action import ActionClient
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.trajectory import Trajectory, TrajectoryPoint
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import trajectory_to_message
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram

_WHY = "control_msgs is not among the wheels; it needs a full ROS installation"
ACTION = pytest.importorskip("control_msgs.action", reason=_WHY).FollowJointTrajectory
JointTolerance = pytest.importorskip("control_msgs.msg", reason=_WHY).JointTolerance
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""``action_msgs/GoalStatus``."""
PLANTS = {"sim": ("pendulum_sim", "simulator"), "hw": ("pendulum_hw_bridge", "bridge")}


class Client(GraphPeer):
    """Sends goals to a plant's action, and hears how they go."""

    def __init__(self, domain: int, side: str) -> None:
        super().__init__("client", namespace=f"/{side}", domain=domain)
        self.plant = PLANTS[side][1]
        self.action = ActionClient(self.node, ACTION, "joint_trajectory_controller/follow_joint_trajectory")
        self.elsewhere = self.node.create_publisher(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self.places: list[float] = []
        self.process: RunningProgram
        self.action_process: RunningProgram

    def send(self, *points: tuple[float, float], joint: str = names.JOINT, stamp: int = 0, **details: Any) -> Any:
        """Send points (time [s], position [rad]) and return the goal's handle."""
        self.until(self.action.server_is_ready, "the action's server")
        goal = ACTION.Goal(trajectory=message(*points), **details)
        goal.trajectory.joint_names, goal.trajectory.header.stamp.sec = [joint], stamp
        self.places.clear()
        sent = self.action.send_goal_async(
            goal, feedback_callback=lambda said: self.places.append(said.feedback.actual.positions[0])
        )
        self.until(sent.done, "an answer to the goal")
        return sent.result()

    def end(self, handle: Any) -> tuple[int, Any]:
        """Return status and result of a goal."""
        result = handle.get_result_async()
        self.until(result.done, "the goal's result")
        return result.result().status, result.result().result

    def arm(self) -> bool:
        """Ask the plant to arm, and return whether it did."""
        return bool(self.call(SetBool, f"{self.plant}/arm", SetBool.Request(data=True)).success)

    def send_away(self) -> Any:
        """Send a goal that takes six seconds, and return its handle once the plant is on its way."""
        handle = self.send((6.0, 1.0))
        assert handle.accepted
        self.until(lambda: self.places and self.places[-1] > 0.03, "a plant on its way")
        return handle


def accepted(handle: Any) -> bool:
    """Tell whether a goal was."""
    return bool(handle.accepted)


def message(*points: tuple[float, float]) -> JointTrajectory:
    """Return a trajectory through points (time [s], position [rad]), at rest in each."""
    return trajectory_to_message(Trajectory(tuple(TrajectoryPoint(t, place, 0.0) for t, place in points)))


@pytest.fixture
def client(request: pytest.FixtureRequest, domain_id: int, processes: ProcessGroup) -> Iterator[Client]:
    """Start a plant with its action, arm it, and bring a client."""
    side: str = getattr(request, "param", "sim")
    in_side = ("--ros-args", "-r", f"__ns:=/{side}")
    client = Client(domain_id, side)
    client.process = processes.start(*PLANTS[side], *in_side)
    action = processes.start("pendulum_lqr", "trajectory_action", *in_side)
    client.action_process = action
    action.wait_for_output("ready", 40.0)
    client.process.wait_for_output("ready", 40.0)
    client.until(client.arm, "an armed plant")
    yield client
    client.close()


@pytest.mark.parametrize("client", PLANTS, indirect=True)
def test_a_goal_is_reached_and_the_plant_tells_where_it_is_on_the_way(client: Client) -> None:
    status, result = client.end(client.send((1.5, 0.2)))
    assert (status, result.error_code) == (SUCCEEDED, ACTION.Result.SUCCESSFUL), result
    assert client.places[0] < 0.05
    assert client.places[-1] == pytest.approx(0.2, abs=0.05)
    assert len({round(place, 2) for place in client.places}) > 5
    # From where it holds, also back.
    status, result = client.end(client.send((0.7, 0.1), (1.5, 0.0)))
    assert status == SUCCEEDED, result
    assert client.places[-1] == pytest.approx(0.0, abs=0.05)


def test_a_goal_that_is_refused_is_aborted_with_the_reason_and_the_next_is_followed(client: Client) -> None:
    tolerance = JointTolerance(name=names.JOINT, position=0.1)
    for details, code, reason in (
        ({"stamp": 1}, ACTION.Result.INVALID_GOAL, "before the plant's time; expected at most"),
        ({"joint": "elbow"}, ACTION.Result.INVALID_JOINTS, "goal is for joints ['elbow']"),
        ({"goal_tolerance": [tolerance]}, ACTION.Result.INVALID_GOAL, "goal has goal_tolerance"),
    ):
        status, result = client.end(client.send((1.0, 0.1), **details))
        assert (status, result.error_code) == (ABORTED, code), result
        assert reason in result.error_string
    assert client.end(client.send((0.5, 0.05)))[0] == SUCCEEDED


def test_a_cancelled_goal_holds_where_it_is_and_until_then_no_other_is_taken(client: Client) -> None:
    handle = client.send_away()
    stopped_at = client.places[-1]
    assert not client.send((1.0, 0.0)).accepted
    cancelled = handle.cancel_goal_async()
    client.until(cancelled.done, "an answer to the cancellation")
    assert client.end(handle)[0] == CANCELED
    status, result = client.end(client.send((0.5, stopped_at)))
    assert status == SUCCEEDED, result
    assert client.places[0] == pytest.approx(stopped_at, abs=0.15)


def test_a_goal_is_given_up_when_somebody_else_sends_a_trajectory(client: Client) -> None:
    handle = client.send_away()
    client.elsewhere.publish(message((1.0, client.places[-1] + 0.2)))
    status, result = client.end(handle)
    assert (status, result.error_string) == (ABORTED, "another sender published a trajectory")
    # Not before the other's has ended.
    handle = client.until(lambda: next(filter(accepted, [client.send((1.0, 0.3))]), None), "the end of the other's")
    assert client.end(handle)[0] == SUCCEEDED


def test_a_goal_is_given_up_when_the_plant_is_stopped_or_falls_silent(client: Client) -> None:
    handle = client.send_away()
    client.call(Trigger, f"{client.plant}/e_stop", Trigger.Request())
    status, result = client.end(handle)
    assert status == ABORTED
    assert result.error_string.startswith("plant is e_stop")
    client.call(Trigger, f"{client.plant}/e_stop_reset", Trigger.Request())
    assert client.arm()
    handle = client.send_away()
    client.process.send_signal(signal.SIGKILL)
    status, result = client.end(handle)
    assert status == ABORTED
    assert "plant has been silent for" in result.error_string


def test_an_action_that_ends_leaves_the_plant_where_it_is(client: Client) -> None:
    client.send_away()
    client.action_process.interrupt()
    assert client.action_process.wait(10.0) == 0
    # Long before the six seconds of the goal.
    client.process.wait_for_output("armed_position: holding the end of a trajectory", 20.0)


def test_of_two_programs_that_offer_the_action_neither_takes_a_goal(client: Client, processes: ProcessGroup) -> None:
    """The client heard "aborted" of the one while the plant followed the goal of the other."""
    again = processes.start("pendulum_lqr", "trajectory_action", "--ros-args", "-r", "__ns:=/sim")
    again.wait_for_output("serving", 40.0)
    service = "/sim/joint_trajectory_controller/follow_joint_trajectory/_action/send_goal"
    client.until(lambda: client.node.count_services(service) == 2, "both of them")
    assert not client.send((1.0, 0.2)).accepted
    again.send_signal(signal.SIGINT)
    client.until(lambda: client.node.count_services(service) == 1, "one of them alone")
    assert client.end(client.send((1.0, 0.2)))[0] == SUCCEEDED


def test_a_goal_is_not_reached_by_a_plant_that_starts_again_on_the_way(client: Client, processes: ProcessGroup) -> None:
    handle = client.send_away()
    client.process.send_signal(signal.SIGKILL)
    client.process.wait(10.0)
    # Armed at its start, and so ready for torques before anybody can take it for silent.
    processes.start(*PLANTS["sim"], "--ros-args", "-r", "__ns:=/sim")
    status, result = client.end(handle)
    assert status == ABORTED, result
