"""``trajectory_action``: offer a plant's position control as the action ``FollowJointTrajectory``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from pendulum_lqr.nodes.trajectory_action import End, Outcome, PlantFollowing, goal_problem
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.trajectory import Trajectory, TrajectoryPoint
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import sample_from_bytes, trajectory_to_message
from pendulum_msgs_py.ros.leaving import wait_until_heard
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["NODE_SPECS", "TrajectoryActionNode", "main"]

NODE_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("silence_timeout", 2.0, "s",
        "Time without a state, or an answer to a goal, after which it is given up.", minimum=0.0,
        exclusive_minimum=True, read_only=True),
)  # fmt: skip

_ACTION = "~/follow_joint_trajectory"
_FEEDBACK_PERIOD = 0.05
"""[s]"""
_AT_ONCE = 0.0


class TrajectoryActionNode(Node):
    """Passes goals on to the plant's ``joint_trajectory``, one at a time, and ends them by its ``events``.

    Raises:
        ParameterError: The package that has the action's type is not installed.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("joint_trajectory_controller", enable_logger_service=True)
        self._settings = NodeParameters(self, NODE_SPECS)
        self._action = _action_type()
        self._plant = PlantFollowing()
        self._end: Future | None = None
        self._goal: Any = None
        self._sample: JointSample | None = None
        self._heard = self._asked = time.monotonic()
        self._sent: set[bytes] = set()
        self._publisher = self.create_publisher(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self.create_subscription(JointTrajectory, names.JOINT_TRAJECTORY, self._on_trajectory, qos.TRAJECTORY, raw=True)
        self.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.NEWEST_STATE, raw=True)
        self.create_subscription(String, names.EVENTS, self._on_event, qos.EVENTS)
        self._server: ActionServer | None = None
        self._of_goals = f"{self.resolve_service_name(_ACTION)}/_action/send_goal"
        create_wall_timer(self, _FEEDBACK_PERIOD, self._on_time)

    def close(self) -> None:
        """Hold the plant: it must not follow a trajectory unsupervised."""
        if self._plant.active:
            self._hold()
            wait_until_heard(self._publisher)
        if self._server is not None:
            self._server.destroy()

    def _on_goal(self, goal: Any) -> GoalResponse:
        refusal = ""
        if self._plant.active:
            refusal = "another goal is being followed; expected it cancelled first"
        elif self.count_services(self._of_goals) > 1:
            refusal = "two programs offer this action for one plant; expected one"
        elif self._plant.busy:
            refusal = "the plant follows a trajectory of another sender"
        if refusal:
            self.get_logger().error(f"goal rejected: {refusal}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_cancel(self, handle: Any) -> CancelResponse:
        if not self._plant.active or self._goal is None or handle.goal_id != self._goal.goal_id:
            return CancelResponse.REJECT
        self._plant.cancel()
        self._hold()
        return CancelResponse.ACCEPT

    async def _follow(self, handle: Any) -> Any:
        goal = handle.request
        tolerances = {
            name: len(getattr(goal, name))
            for name in ("path_tolerance", "component_path_tolerance", "goal_tolerance", "component_goal_tolerance")
        }
        end = goal_problem(list(goal.trajectory.joint_names), list(goal.multi_dof_trajectory.joint_names), tolerances)
        if end is None and self._plant.active:
            end = End(Outcome.REFUSED, "another goal came before it; expected it cancelled first")
        if end is None:
            self._goal, self._end = handle, Future(executor=None)
            self._plant.begin()
            self._heard = time.monotonic()
            self._sent.clear()
            self._send(goal.trajectory)
            end = await self._end
            self._goal = None
        result = self._action.Result(error_code=min(end.outcome.value, 0), error_string=end.reason)
        if end.outcome is Outcome.REACHED:
            handle.succeed()
        elif end.outcome is Outcome.CANCELLED:
            handle.canceled()
        else:
            self.get_logger().error(f"goal given up: {end.reason}")
            handle.abort()
        return result

    def _send(self, trajectory: JointTrajectory) -> None:
        self._asked = time.monotonic()
        data = serialize_message(trajectory)
        self._sent.add(data)
        self._publisher.publish(data)

    def _hold(self) -> None:
        """Request the plant to hold its position, under position control."""
        assert self._sample is not None
        here = Trajectory((TrajectoryPoint(_AT_ONCE, self._sample.position[0], 0.0),))
        self._send(trajectory_to_message(here))

    def _on_trajectory(self, data: bytes) -> None:
        if data in self._sent:
            self._sent.discard(data)
        else:
            self._finish(self._plant.on_other_trajectory())

    def _on_state(self, data: bytes) -> None:
        sample = sample_from_bytes(data)
        if sample is None:
            return
        self._sample, self._heard = sample, time.monotonic()
        if self._server is None:
            # A client that waits for the server needs a plant, too.
            self._server = ActionServer(
                self,
                self._action,
                _ACTION,
                execute_callback=self._follow,
                goal_callback=self._on_goal,
                cancel_callback=self._on_cancel,
            )
            self.get_logger().info(f"serving {self.resolve_topic_name(_ACTION)}")

    def _on_event(self, message: String) -> None:
        try:
            event = json.loads(message.data)
        except ValueError:
            return
        if isinstance(event, dict):
            self._finish(self._plant.on_event(event))

    def _on_time(self) -> None:
        now, patience = time.monotonic(), self._settings["silence_timeout"]
        if now - self._heard > patience:
            self._finish(self._plant.on_silence(now - self._heard))
        self._finish(self._plant.on_wait(now - self._asked, patience))
        if self._goal is not None and self._plant.active and self._sample is not None:
            feedback = self._action.Feedback(joint_names=[names.JOINT])
            feedback.header.stamp = self.get_clock().now().to_msg()
            feedback.actual.positions = list(self._sample.position)
            feedback.actual.velocities = list(self._sample.velocity)
            self._goal.publish_feedback(feedback)

    def _finish(self, end: End | None) -> None:
        if end is not None and self._end is not None and not self._end.done():
            self._end.set_result(end)


def _action_type() -> Any:
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError as error:
        raise ParameterError(
            "the type of FollowJointTrajectory is in control_msgs, which cannot be imported here and of which there is "
            "no wheel; expected it from a full ROS (apt install ros-jazzy-control-msgs), or trajectories on the topic "
            f"{names.JOINT_TRAJECTORY} ({error})"
        ) from error
    return FollowJointTrajectory


def main(argv: Sequence[str] | None = None) -> int:
    """Run the action server and return the exit code."""
    return run_node(
        TrajectoryActionNode,
        argv,
        program="pendulum_lqr trajectory_action",
        description="Offers a plant's position control as the action FollowJointTrajectory (needs control_msgs).",
        specs=NODE_SPECS,
        example="python -m pendulum_lqr trajectory_action --ros-args -r __ns:=/sim",
    )
