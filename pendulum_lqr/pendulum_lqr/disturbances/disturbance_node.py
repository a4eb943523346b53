"""``disturbance``: answer each state of a plant with a disturbance torque."""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # before anything that imports numpy
# isort: on

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from pendulum_lqr.disturbances.compiled_disturbance import CompiledDisturbance
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS, Disturbance, from_bag, make_disturbance
from pendulum_lqr.disturbances.disturbing import DisturbanceLoop
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.plant_specs import COMPILED, REALTIME_PRIORITY
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, read_text
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.compiled_answers import AnsweredInput
from pendulum_msgs_py.ros.convert import event_message, stamp_of_state
from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD, Diagnostics
from pendulum_msgs_py.ros.first_answer import LOCKSTEP_SUBSCRIBERS, FirstAnswer
from pendulum_msgs_py.ros.leaving import wait_until_heard
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.simulated_time import live_by_stamps
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["NODE_SPECS", "DisturbanceNode", "main"]

NODE_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("autostart", False, "", "Start with the first state, without a call of ~/start.", read_only=True),
    ParameterSpec("duration", 0.0, "s", "Duration of the disturbance; 0 until ~/stop.", minimum=0.0),
    ParameterSpec("file", "", "",
        "For from_bag: CSV file with a header line and the columns time since the start [s] and torque [N m]."),
    ParameterSpec("joints", [""], "",
        "Joints to disturb, in the plant's order, each by its own signal with the next seed. "
        "Empty for the joint of a pendulum.", read_only=True),
    ParameterSpec("volts", False, "",
        "The signal is a voltage, on `voltage_disturbance`, for a plant driven in volts.", read_only=True),
    LOCKSTEP_SUBSCRIBERS,
    COMPILED,
    REALTIME_PRIORITY,
)  # fmt: skip
"""Parameters of the node itself, without those of the signal."""


class DisturbanceNode(PollingNode):
    """Publishes the disturbance for each new stamp of ``joint_states``.

    Before the start and after the end it publishes zero, so that a plant in lockstep gets its reply and a plant in real
    time never holds an old torque. Events ``noise_start`` and ``noise_end`` mark the first and last disturbed state.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("disturbance", enable_logger_service=True)
        self._settings = NodeParameters(self, DISTURBANCE_SPECS + NODE_SPECS, self._prepare, self._swap)
        self._now = SteadyWallClock()
        self._full_name = self.get_fully_qualified_name()
        self._simulated_time = bool(self.get_parameter("use_sim_time").value)
        self._joints = _joints(self._settings.values)
        # One per joint; all get the same states, so they start and end together.
        self._loops = [
            DisturbanceLoop(
                signal,
                self._settings["duration"],
                simulated_time=self._simulated_time,
                autostart=self._settings["autostart"],
            )
            for signal in _signals(self._settings.values)
        ]
        self._loop = self._loops[0]
        self._logged_others = False
        topics = names.VOLTAGE_TOPICS if self._settings["volts"] else names.EFFORT_TOPICS
        self._torque_publisher = self.create_publisher(JointState, topics.disturbance, qos.COMMAND)
        self._first_answer = FirstAnswer(self, self._torque_publisher, self._settings["lockstep_subscribers"])
        self._event_publisher = self.create_publisher(String, names.EVENTS, qos.EVENTS)
        self._diagnostics = Diagnostics(self, "disturbance")
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        source = self.create_waited_input(JointState, names.JOINT_STATES, qos.NEWEST_STATE, self._on_state)
        answerer = CompiledDisturbance(
            self._loops,
            lambda: self._first_answer.gone or not self._simulated_time,
            "" if self._settings["compiled"] else "compiled is false",
        )
        self._answers = AnsweredInput(source, self._on_state, answerer, lambda: self.request_descriptor)
        self._answers.compile(self._torque_publisher, sender=self._full_name, joint=self._joints[0], ahead_ns=0)
        create_wall_timer(self, DIAGNOSTICS_PERIOD, self._publish_diagnostics)
        live_by_stamps(self, lambda: self._loop.newest_stamp_ns)

    def run_due(self) -> float | None:
        """Process states for some milliseconds, or yield to others; return when it is due again [s]."""
        return self._answers.run_due()

    def close(self) -> None:
        """End with zero torque while the context is still valid."""
        if self._loop.running:
            self._tell(Event.NOISE_END, self._loop.newest_stamp_ns or self._now(), reason="stopped by a signal")
        newest = self._loop.newest_stamp_ns
        after = 0 if newest is None else newest + 1
        if newest is not None:
            stamp = after if self._simulated_time else max(after, self._now())
            nothing = (0.0,) * len(self._joints)
            self._torque_publisher.publish(encode_joints(stamp, self._full_name, self._joints, (), (), nothing))
            wait_until_heard(self._torque_publisher)
        for loop in self._loops:
            loop.stop()
        self._publish_diagnostics()

    def _on_state(self, data: bytes) -> None:
        stamp_ns, names_of_state = stamp_of_state(data, self._joints)
        if stamp_ns is None:
            self._tell_others(names_of_state)
            return
        if self._simulated_time and not self._first_answer.may_go():
            return
        answers = [answer for loop in self._loops if (answer := loop.answer(stamp_ns)) is not None]
        if not answers:
            return
        torques = tuple(answer.torque for answer in answers)
        self._torque_publisher.publish(encode_joints(stamp_ns, self._full_name, self._joints, (), (), torques))
        if answers[0].event:
            self._tell(answers[0].event, stamp_ns)

    def _tell_others(self, found: tuple[str, ...]) -> None:
        """Log once that the states are of other joints, because then no disturbance acts."""
        if found and not self._logged_others:
            self._logged_others = True
            self.get_logger().error(
                f"states of {', '.join(found)}; expected {', '.join(self._joints)} among them: say which to disturb "
                f"with -p joints:='[{found[-1]}]'"
            )

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        started = [loop.start() for loop in self._loops]
        response.success = all(started)
        response.message = (
            "starts with the next state" if response.success else "already running; expected ~/stop first"
        )
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        stopped = [loop.stop() for loop in self._loops]
        response.success = all(stopped)
        response.message = "ends with zero torque" if response.success else "was not running"
        return response

    def _prepare(self, values: Mapping[str, Any]) -> tuple[tuple[Disturbance, ...], float]:
        signals = _signals(values)
        if self._loop.running:
            raise ParameterError(
                "the disturbance is running; expected ~/stop before a change, so that a run has one signal"
            )
        return signals, values["duration"]

    def _swap(self, prepared: tuple[tuple[Disturbance, ...], float]) -> None:
        signals, duration = prepared
        for loop, signal in zip(self._loops, signals, strict=True):
            loop.replace(signal, duration)

    def _tell(self, name: str, stamp_ns: int, **more: object) -> None:
        details = {spec.name: self._settings[spec.name] for spec in DISTURBANCE_SPECS}
        if self._joints != (names.JOINT,):
            details["joints"] = list(self._joints)
        self._event_publisher.publish(
            event_message(stamp_ns, name, disturbance=details, duration=self._settings["duration"], **more)
        )
        self.get_logger().info(f"{name} at stamp {stamp_ns} ns")

    def _publish_diagnostics(self) -> None:
        values: dict[str, object] = {spec.name: self._settings[spec.name] for spec in DISTURBANCE_SPECS}
        values["loop"] = self._answers.loop
        values.update(self._loop.summary(time.monotonic_ns()))
        for joint, loop in zip(self._joints[1:], self._loops[1:], strict=True):
            values[f"torque.{joint}"] = loop.last_torque
        text = "disturbing" if self._loop.running else "zero torque"
        self._diagnostics.publish(self._now(), DiagnosticStatus.OK, text, values)


def _joints(values: Mapping[str, Any]) -> tuple[str, ...]:
    joints = tuple(values["joints"])
    if joints in {(), ("",)}:
        return (names.JOINT,)
    if len(set(joints)) < len(joints) or "" in joints:
        raise ParameterError(f"joints is {list(joints)}; expected names, each once")
    return joints


def _signals(values: Mapping[str, Any]) -> tuple[Disturbance, ...]:
    own = {spec.name: values[spec.name] for spec in DISTURBANCE_SPECS}
    joints = _joints(values)
    if values["kind"] != "from_bag":
        return tuple(make_disturbance({**own, "seed": own["seed"] + k}) for k in range(len(joints)))
    if len(joints) > 1:
        raise ParameterError(f"kind is 'from_bag' for {', '.join(joints)}; expected one joint, as the file does")
    return (make_disturbance(own, _read_recording(values["file"], volts=values["volts"])),)


def _read_recording(file: str, *, volts: bool) -> Disturbance:
    if not file:
        raise ParameterError("kind is 'from_bag' without a file; expected -p file:=PATH of a CSV with time and torque")
    header, *rows = read_text(Path(file).expanduser(), "recorded disturbance", limit=200_000_000).splitlines() or [""]
    if ("volt" in header.lower() or "[V]" in header) != volts:
        raise DataError(
            f"recorded disturbance {file} has the header {header!r}, and volts is {volts}; expected a header with"
            f"{'' if volts else 'out'} voltage"
        )
    try:
        table = np.array([[float(cell) for cell in row.split(",")[:2]] for row in rows if row.strip()])
        times, torques = table[:, 0], table[:, 1]
    except (ValueError, IndexError) as error:
        raise DataError(
            f"recorded disturbance {file}: {error}; expected the columns time [s], "
            f"{'voltage [V]' if volts else 'torque [N m]'}"
        ) from error
    return from_bag(np.round(times * NANOSECONDS).astype(np.int64), torques)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the disturbance node and return the exit code."""
    return run_node(
        DisturbanceNode,
        argv,
        program="pendulum_lqr disturbance",
        description="Answers each joint state with a disturbance torque, a pure function of seed and time.",
        specs=DISTURBANCE_SPECS + NODE_SPECS,
        example="python -m pendulum_lqr disturbance --ros-args -r __ns:=/sim -p seed:=1 -p autostart:=true",
    )
