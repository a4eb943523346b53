"""``procedure``: run one trial of the thesis's two identification experiments on the bridge.

``hand``: the drive has zero torque while a simulated hand turns the link through ``push``, or a person does.
``staircase``: the bridge follows steps of 10 degrees. Phases are recorded as events with exact stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_hw_bridge.nodes.procedure import HandTrial, StaircaseTrial, Trial
from pendulum_hw_bridge.nodes.procedures import hand_trials, staircase
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.plant_specs import REALTIME_PRIORITY
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import event_message, sample_from_bytes, trajectory_to_message
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.simulated_time import live_by_stamps

__all__ = ["SPECS", "ProcedureNode", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("procedure", "hand", "", "Which experiment.", choices=("hand", "staircase"), read_only=True),
    ParameterSpec("trial", 1, "-", "Number of the trial.", minimum=1, maximum=1000, read_only=True),
    ParameterSpec("seed", 1, "-", "`hand`: seed of strokes and tremor.", minimum=0, read_only=True),
    ParameterSpec("person", False, "",
        "`hand`: a person turns the link; this node only holds the drive at zero torque, until `~/finish`.",
        read_only=True),
    ParameterSpec("step", 10.0, "deg", "`staircase`: height of a step.", minimum=1.0, maximum=90.0, read_only=True),
    ParameterSpec("top", 90.0, "deg", "`staircase`: highest angle.", minimum=1.0, maximum=170.0, read_only=True),
    ParameterSpec("hold", 2.0, "s", "`staircase`: time at rest on each step.", minimum=0.5, maximum=60.0,
        read_only=True),
    ParameterSpec("autostart", False, "", "Start with the first state, without a call of ~/start.", read_only=True),
    REALTIME_PRIORITY,
)  # fmt: skip


class ProcedureNode(Node):
    """One trial: responds to each state of the plant until the trial is over, with zero torque before and after.

    In simulated time a staircase ends held on its last step: the time at which zero torque takes over would depend on
    the load of the machine. Events: ``trial_start``, the phases, ``trial_end``, ``trial_failed``.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("procedure")
        self._stop = stop
        self._settings = NodeParameters(self, SPECS)
        values = self._settings.values
        self._trial = make_trial(values, release=not self.get_parameter("use_sim_time").value)
        self._full_name = self.get_fully_qualified_name()
        self._asked_to_start = values["autostart"]
        self._effort = self.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        self._push = self.create_publisher(JointState, names.PUSH, qos.COMMAND)
        self._trajectory = self.create_publisher(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self._events = self.create_publisher(String, names.EVENTS, qos.EVENTS)
        self._newest_ns: int | None = None
        self._answer: tuple[float | None, float | None] = (None, None)
        self.create_subscription(String, names.EVENTS, self._on_event, qos.EVENTS)
        self.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.NEWEST_STATE, raw=True)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/finish", self._on_finish)
        live_by_stamps(self, lambda: self._newest_ns)

    def close(self) -> None:
        """End with zero torque while the context is still valid."""
        if self._newest_ns is not None:
            stamp = encode_joint_state(self._newest_ns + 1, frame_id=self._full_name, effort=0.0)
            self._push.publish(stamp)
            self._effort.publish(stamp)

    def _on_state(self, data: bytes) -> None:
        sample = sample_from_bytes(data)
        if sample is None or (self._newest_ns is not None and sample.stamp_ns < self._newest_ns):
            return
        if sample.stamp_ns == self._newest_ns:
            # A plant in lockstep repeats a state whose command it missed.
            self._send()
            return
        self._newest_ns = sample.stamp_ns
        trial = self._trial
        if self._asked_to_start:
            self._asked_to_start = False
            trial.start(sample)
            if isinstance(trial, StaircaseTrial):
                # The trajectory is the response to this state: a plant in lockstep starts it at this very stamp.
                self._trajectory.publish(trajectory_to_message(trial.trajectory))
        answer = trial.answer(sample)
        for stamp_ns, name, details in answer.events:
            self._events.publish(event_message(stamp_ns, name, **details))
            self.get_logger().info(f"{name} {details}")
        self._answer = (answer.push, answer.effort)
        self._send()

    def _send(self) -> None:
        assert self._newest_ns is not None
        for publisher, torque in zip((self._push, self._effort), self._answer, strict=True):
            if torque is not None:
                publisher.publish(encode_joint_state(self._newest_ns, frame_id=self._full_name, effort=torque))

    def _on_event(self, message: String) -> None:
        failure = self._trial.hear(message.data)
        if failure and self._newest_ns is not None:
            self.get_logger().error(failure)
            self._events.publish(event_message(self._newest_ns, Event.TRIAL_FAILED, reason=failure))

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = not self._trial.started
        response.message = "starts with the next state" if response.success else "has started already"
        self._asked_to_start = response.success
        return response

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._trial.started and not self._trial.finished
        response.message = "ends with the next state" if response.success else "is not running"
        self._trial.finish()
        return response


def make_trial(values: dict[str, Any], *, release: bool = True) -> Trial:
    """Return the trial that the parameters describe; with ``release`` a staircase ends with zero torque, else held.

    Raises:
        ParameterError: They describe none.
    """
    number = values["trial"]
    if values["procedure"] == "staircase":
        phases = list(staircase(number, step=values["step"], top=values["top"], hold=values["hold"]))
        return StaircaseTrial(number, phases, release=release)
    motion = None if values["person"] else hand_trials(values["seed"], trials=number)[-1]
    return HandTrial(number, motion)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the procedure."""
    return run_node(
        ProcedureNode,
        argv,
        program="pendulum_hw_bridge procedure",
        description="Plays one trial of the thesis's identification experiments on the bridge.",
        specs=SPECS,
        example="python -m pendulum_hw_bridge procedure --ros-args -r __ns:=/hw -p procedure:=staircase "
        "-p autostart:=true",
    )
