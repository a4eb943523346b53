"""The graph side of every plant: topics, services, command rules and diagnostics.

A plant (simulator, bridge) owns clock and loop; it calls ``decide`` and publishes what was applied.
"""

from __future__ import annotations

import math
import select
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Protocol

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.cdr_trajectory import decode_joint_trajectory
from pendulum_msgs_py.contract.commands import Refusal
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, Input, Mode
from pendulum_msgs_py.contract.timing import LoopStatistics, Throttle
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.arrivals import ArrivalSignal
from pendulum_msgs_py.ros.commander_watch import CommanderWatch
from pendulum_msgs_py.ros.convert import command_from_bytes, event_message, problem_of_command
from pendulum_msgs_py.ros.diagnostics import DIAGNOSTICS_PERIOD, Diagnostics
from pendulum_msgs_py.ros.e_stop import PRESSED, EStopServer
from pendulum_msgs_py.ros.leaving import wait_until_heard
from pendulum_msgs_py.ros.polled import REST_AFTER_READING, PolledInput, PollingNode
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["PlantInterface"]

_LEAST_BETWEEN_LINES = 1.0
"""Time between two log lines about one mode [s]."""
_DRIFT = 0.01
"""Relative drift of two clocks that is allowed between messages of the hold-to-run switch."""
_POLL = 0.02
"""Poll period of e-stops and trajectories [s]; only the newest trajectory is read."""
TRAJECTORY_AGE_LIMIT = 1.0
"""Largest difference between a trajectory's stamp and the plant's time [s]: an old one must not move a machine."""


class _CommandHook(Protocol):
    def __call__(self, kind: Input, command: JointCommand) -> None: ...


class PlantInterface:
    """Topics, services and diagnostics of one plant.

    Args:
        node: The plant's node.
        supervisor: Its rules and state.
        clock: The plant's time [ns], wall or simulated; also called by the e-stop's thread.
        push: Whether the plant accepts a torque on the link itself.
        polled: Whether torque inputs wait for :meth:`take_inputs` instead of waking the node.
        statistics: The loop's figures, shown in diagnostics.
        more_diagnostics: Further values for diagnostics.
        on_command: Called after each accepted command of any torque input.
        motor_efforts: For a plant in volts, its efforts under m voltages at n velocities, published as
            ``applied_effort`` alongside ``applied_voltage``.

    Attributes:
        sample: Newest published state.
        published_ns: Its system time, the clock of DDS's arrival stamps [ns].
        arrived_ns: Arrival of the message being handled, in system time, for polled inputs [ns].
    """

    def __init__(
        self,
        node: PollingNode,
        supervisor: SharedSupervisor,
        clock: Callable[[], int],
        *,
        push: bool = True,
        polled: bool = False,
        statistics: LoopStatistics | None = None,
        more_diagnostics: Callable[[], Mapping[str, object]] = dict,
        on_command: _CommandHook | None = None,
        motor_efforts: Callable[[Vector, Vector], Vector] | None = None,
    ) -> None:
        self.node = node
        self.supervisor = supervisor
        self.clock = clock
        self.statistics = statistics
        self.sample: JointSample | None = None
        self._decided: JointSample | None = None
        self.published_ns = 0
        self._armed_at = self._pressed_at = -math.inf
        self.arrived_ns = 0
        self.on_command = on_command
        self.polled = polled
        self.hardware_id = "none"
        self.refused_trajectories: Counter[str] = Counter()
        self._joints = supervisor.coordinates.names
        self._driven = supervisor.coordinates.driven_names
        self._more_diagnostics = more_diagnostics
        self._reported_mode: tuple[Mode, bool, bool] | None = None
        self._mode_lines = Throttle(_LEAST_BETWEEN_LINES)
        self._reported_refusals = 0
        self.commander_watch = CommanderWatch(node, supervisor)
        self._seconds_at_check = 0
        self._second_commander = False
        self._stopping = False
        self._called: select.epoll | None = None
        self.state_publisher = node.create_publisher(JointState, names.JOINT_STATES, qos.STATE)
        topics = supervisor.coordinates.topics
        self.applied_publisher = node.create_publisher(JointState, topics.applied, qos.STATE)
        self._motor_efforts = motor_efforts
        if motor_efforts is not None:
            self._effort_publisher = node.create_publisher(JointState, names.APPLIED_EFFORT, qos.STATE)
        self._events = node.create_publisher(String, names.EVENTS, qos.EVENTS)
        self._diagnostics = Diagnostics(node, "plant")
        inputs = [Input.EFFORT_COMMAND, Input.DISTURBANCE] + ([Input.PUSH] if push else [])
        self._polled: list[tuple[PolledInput, Callable[..., None]]] = []
        self._torques: ArrivalSignal | None = None
        self._accepted: dict[Input, bytes] = {}
        self.inputs = {}
        self._topics = {
            Input.EFFORT_COMMAND: topics.command, Input.DISTURBANCE: topics.disturbance, Input.PUSH: names.PUSH
        }  # fmt: skip
        self._receivers = {kind: self._receiver(kind) for kind in inputs}
        for kind in inputs:
            receive = self._receivers[kind]
            if polled:
                source = node.create_polled_input(JointState, self._topics[kind], qos.COMMAND_INPUT)
                self._polled.append((source, receive))
                self.inputs[kind] = source.subscription
            else:
                self.inputs[kind] = node.create_subscription(
                    JointState, self._topics[kind], receive, qos.COMMAND_INPUT, raw=True
                )
        self._trajectories = node.create_polled_input(JointTrajectory, names.JOINT_TRAJECTORY, qos.TRAJECTORY)
        self._trajectories.watch()
        self._next_trajectory = 0.0
        create_wall_timer(node, _POLL, self._on_poll)
        node.create_service(SetBool, names.ARM, self._on_arm)
        node.create_service(Trigger, names.E_STOP_RESET, self._on_e_stop_reset)
        # Steady time: it must run while simulated time stands still, or the system clock is set back.
        create_wall_timer(node, DIAGNOSTICS_PERIOD, self._on_housekeeping)
        self._pressed = threading.Event()
        self._e_stop = EStopServer(node, self.e_stop)
        supervisor.watch_for_presses(self._unread_press)
        self._enable: PolledInput | None = None
        self._enable_spoke_ns, self._enable_lag, self._enable_waited = 0, math.inf, 0.0
        if math.isfinite(supervisor.limits.enable_timeout):
            self._enable = node.create_polled_input(Bool, names.ENABLE_INPUT, qos.COMMAND_INPUT)
            self._enable.watch()
        if math.isinf(supervisor.limits.start_effort):
            node.get_logger().warning("start_effort_limit is 0: a commander may begin with any torque")

    # --- the plant's loop calls these ----------------------------------------------------------------------

    def take_inputs(self) -> None:
        """Take new torques of polled inputs."""
        for source, receive in self._polled:
            source.take(receive)

    def watch_inputs(self) -> ArrivalSignal:
        """Return the arrival signal of polled torque inputs."""
        if self._torques is None:
            self._torques = ArrivalSignal([source.subscription for source, _ in self._polled])
        return self._torques

    def wait_for_inputs(self, timeout: float) -> None:
        """Take new torques, or wait at most a time [s]; after :meth:`watch_inputs`."""
        assert self._torques is not None, "inputs are not watched"
        if self._torques.wait(timeout):
            self.take_inputs()

    @property
    def calls(self) -> tuple[int, int]:
        """Descriptors that end a slice of compiled code: requests and trajectories; -1 for none."""
        if self._called is None and self.node.request_descriptor >= 0:
            # Readable when one of these is: an e-stop need not wait for its thread.
            self._called = select.epoll()
            for counter in {self.node.request_descriptor, self._e_stop.arrivals.descriptor} - {-1}:
                self._called.register(counter, select.EPOLLIN)
        return -1 if self._called is None else self._called.fileno(), self._trajectories.descriptor

    def receive(self, kind: Input, data: bytes, arrived_ns: int) -> None:
        """Receive a torque that compiled code has taken from a polled input."""
        self._receivers[kind](data, arrived_ns)

    def pop_accepted(self) -> dict[Input, bytes]:
        """Return the newest accepted message of each input since the last call."""
        accepted, self._accepted = self._accepted, {}
        return accepted

    def publish_state(self, sample: JointSample) -> None:
        """Publish the newest state."""
        self.sample = sample
        self.commander_watch.note_state(sample.stamp_ns)
        stamp_ns, position, velocity, effort = sample
        data = encode_joints(stamp_ns, "", self._joints, position, velocity, effort)
        self.published_ns = time.time_ns()
        self.state_publisher.publish(data)

    def decide(self, now_ns: int | None = None) -> Drive:
        """Return the supervisor's decision, and log changes."""
        if self._enable is not None and self._enable.came():
            self._receive_enable()
        self._decided = self.sample
        drive = self.supervisor.decide(self.clock() if now_ns is None else now_ns, self.sample)
        report = (self.supervisor.mode, drive.starved, self.supervisor.trajectory_finished)
        if report != self._reported_mode:
            self._report_change(drive)
            self._reported_mode = report
        return drive

    def publish_applied(self, stamp_ns: int, effort: Vector) -> None:
        """Publish the commands applied from the state with this stamp on."""
        self.supervisor.report_applied(effort)
        if (
            self._motor_efforts is not None
            and (state := self._decided or self.sample) is not None
            and self._effort_publisher.get_subscription_count()
        ):
            torques = self._motor_efforts(effort, state.velocity)
            self._effort_publisher.publish(encode_joints(stamp_ns, "", self._driven, (), (), torques))
        # Publishing without a subscriber would take a tenth of the loop.
        if self.applied_publisher.get_subscription_count():
            self.applied_publisher.publish(encode_joints(stamp_ns, "", self._driven, (), (), effort))
        # Wait for the last zero only: any other torque must still be ended.
        if self._stopping and not any(effort):
            wait_until_heard(self.applied_publisher)

    def publish_event(self, name: str, **details: object) -> None:
        """Publish an event."""
        self._events.publish(event_message(self.clock(), name, **details))

    # --- graph ---------------------------------------------------------------------------------------------

    @property
    def state_subscribers(self) -> int:
        """Number of matched subscriptions to ``joint_states``."""
        return self.state_publisher.get_subscription_count()

    def commanders(self, kind: Input) -> int:
        """Return the number of publishers matched with an input."""
        return self.inputs[kind].get_publisher_count()

    def e_stop(self, reason: str) -> None:
        """Latch the e-stop, from any thread, without waiting."""
        # Waiting compiled code holds the supervisor, and polls nothing but its counters.
        self.node.wake()
        self._pressed_at = time.monotonic_ns()
        self.supervisor.e_stop(self.clock(), reason)
        self._pressed.set()

    def _unread_press(self) -> tuple[int, str] | None:
        """Return an e-stop that has reached this process but not yet the e-stop's thread."""
        if not self._e_stop.arrivals.counted():
            return None
        self._pressed_at = time.monotonic_ns()
        return self.clock(), PRESSED

    def _is_outdated(self) -> bool:
        """Return whether the request being answered arrived before the last e-stop."""
        return _came_before(self.node.request_ns, self._pressed_at)

    def measured(self) -> tuple[int, JointSample | None]:
        """Return time and newest state after a preparation, during which the hold-to-run switch was not read."""
        self._receive_enable()
        return self.clock(), self.sample

    def safe_stop(self, reason: str) -> None:
        """Disarm and publish that; the plant then applies and publishes zero torque."""
        self.supervisor.disarm(self.clock(), reason)
        self.publish_diagnostics()
        wait_until_heard(self._diagnostics.publisher)
        self._stopping = True

    def close(self) -> None:
        """Stop to serve the e-stop: the plant is safe."""
        self._e_stop.close()

    def publish_diagnostics(self) -> None:
        """Publish the plant's status."""
        supervisor = self.supervisor
        values: dict[str, object] = {
            "mode": supervisor.mode.value,
            "reason": supervisor.reason,
            "commander": supervisor.gates[Input.EFFORT_COMMAND].commander,
            "refused_commander": supervisor.gates[Input.EFFORT_COMMAND].refused_commander,
            "starved_periods": supervisor.starved_periods,
            "saturated_periods": supervisor.saturated_periods,
            "start_effort_limit": supervisor.limits.start_effort,
            "requests": "reported by the middleware" if self.node.notified_of_requests else "polled",
        }
        for kind in self.inputs:
            gate = supervisor.gates[kind]
            topic = self._topics[kind]
            values[f"{topic}.accepted"] = gate.accepted
            for refusal, count in sorted(gate.refused.items()):
                values[f"{topic}.refused.{refusal.value}"] = count
                values[f"{topic}.newest_refused.{refusal.value}"] = gate.problems.get(refusal, "")
        if self.commander_watch.in_other_unit:
            values["commands_without_effect"] = self.commander_watch.in_other_unit
        for reason, count in self.refused_trajectories.items():
            values[f"joint_trajectory.refused.{reason}"] = count
        if self.statistics is not None:
            values.update(self.statistics.summary(self.clock()))
        values.update(self._more_diagnostics())
        text = f"{supervisor.mode.value}: {supervisor.reason}"
        self._diagnostics.publish(self.clock(), self._level(), text, values, hardware_id=self.hardware_id)

    # --- callbacks -----------------------------------------------------------------------------------------

    def _receiver(self, kind: Input) -> Callable[..., None]:
        supervisor = self.supervisor

        def receive(data: bytes, arrived_ns: int = 0) -> None:
            self.arrived_ns = arrived_ns
            command = command_from_bytes(data)
            problem = problem_of_command(data) if command is None else ""
            refusal = supervisor.offer(kind, command, self.clock(), problem)
            if refusal is None:
                self._accepted[kind] = data
            if refusal is Refusal.DUPLICATE and kind is Input.EFFORT_COMMAND and command is not None:
                self.commander_watch.suspect_twins(command, self.clock())
            if refusal is None and kind is Input.EFFORT_COMMAND and command is not None:
                self.commander_watch.suspect_second_plant(command)
                self._note_round_trip(command)
            if refusal is None and self.on_command is not None and command is not None:
                self.on_command(kind, command)

        return receive

    def _note_round_trip(self, command: JointCommand) -> None:
        """Measure until the reply reached this process, without its wait to be polled.

        Both times are system time; a clock step within this fraction of a period is unlikely.
        """
        answers = self.sample is not None and command.stamp_ns == self.sample.stamp_ns
        if answers and self.arrived_ns and self.statistics is not None:
            self.statistics.round_trip(self.arrived_ns - self.published_ns)

    def _on_poll(self) -> None:
        if self._pressed.is_set():
            self._pressed.clear()
            self.publish_diagnostics()
        self._look_for_trajectory()

    def _look_for_trajectory(self) -> None:
        """Take the newest trajectory, then pause: reading holds the GIL, and many may come."""
        if time.monotonic() < self._next_trajectory or not self._trajectories.came():
            return
        began = time.thread_time()
        self._trajectories.take(self._on_trajectory)
        spent = time.thread_time() - began
        self._next_trajectory = time.monotonic() + REST_AFTER_READING * spent

    def _on_trajectory(self, data: bytes, arrived_ns: int) -> None:
        try:
            if self.supervisor.mode.armed and _came_before(arrived_ns, self._armed_at):
                raise ParameterError("it came before the plant was armed; expected it after: send it again")
            if self.supervisor.no_trajectories:
                raise ParameterError(self.supervisor.no_trajectories)
            stamp_ns, trajectory = decode_joint_trajectory(data)
            if self.sample is None:
                raise ParameterError("no measurement yet")
            age = (self.clock() - stamp_ns) / NANOSECONDS
            if stamp_ns != 0 and abs(age) > TRAJECTORY_AGE_LIMIT:
                raise ParameterError(
                    f"trajectory is stamped {age:.3f} s before the plant's time; expected at most "
                    f"{TRAJECTORY_AGE_LIMIT:g} s either way, or a stamp of 0 for now"
                )
            refusal = self.supervisor.accept_trajectory(trajectory, self.clock(), self.sample)
            if refusal:
                raise ParameterError(refusal)
        except ParameterError as error:
            kind = self.supervisor.mode.value if not self.supervisor.mode.armed else "invalid"
            self.refused_trajectories[kind] += 1
            self.node.get_logger().error(f"joint_trajectory refused: {error}")
            self.publish_event(Event.TRAJECTORY_REFUSED, reason=str(error))
            return
        self.node.get_logger().info(
            f"following a trajectory from {trajectory.start:.3f} to {trajectory.goal:.3f} rad in "
            f"{trajectory.duration:.2f} s"
        )

    def _on_arm(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and self._is_outdated():
            response.success, response.message = False, "asked for before the e-stop was pressed; ask again"
        elif request.data:
            self.commander_watch.check()
            was_armed = self.supervisor.mode.armed
            refusal = self.supervisor.arm(self.clock(), self.sample)
            if not was_armed:
                # A trajectory that waited during arming was not meant for an armed plant.
                self._armed_at = time.monotonic_ns()
                self._trajectories.take(self._on_trajectory)
            response.success, response.message = not refusal, refusal or self.supervisor.mode.value
        else:
            self.supervisor.disarm(self.clock())
            response.success = self.supervisor.mode is Mode.DISARMED
            response.message = self.supervisor.mode.value
        self.publish_diagnostics()
        return response

    def _receive_enable(self) -> None:
        if self._enable is not None:
            with self.supervisor.alone():
                # Bounded, since e-stop and actuator wait meanwhile.
                for data, info in islice(self._enable.messages(), self._enable.depth):
                    self._on_enable(data, info)

    def _on_enable(self, data: bytes, info: Mapping[str, int]) -> None:
        """Read the hold-to-run switch as of its message's time: what waited for a stalled process is old.

        A message has no stamp, and hosts' clocks differ; but a message that waited is later than those before it.
        """
        assert self._enable is not None
        timeout_ns = NANOSECONDS * self.supervisor.limits.enable_timeout
        spoke_ns = info["source_timestamp"] or info["received_timestamp"]
        apart, lag = spoke_ns - self._enable_spoke_ns, time.time_ns() - spoke_ns
        later = lag - self._enable_lag - _DRIFT * min(apart, timeout_ns)
        # Of waiting messages each is less late than the one before; otherwise a clock was set. Not assumed while armed:
        # it would excuse a link with growing delay.
        was_set = lag >= self._enable_lag and self._enable_waited > timeout_ns and not self.supervisor.mode.armed
        self._enable_spoke_ns, self._enable_lag = spoke_ns, lag
        self._enable_waited = 0.0 if was_set else max(0.0, self._enable_waited + later)
        # A second switch would hide that the first is released or silent.
        alone = self._enable.subscription.get_publisher_count() == 1
        held = data[4:5] == b"\x01"
        self.supervisor.receive_enable(self.clock() - round(self._enable_waited), held=held and alone)

    def _on_e_stop_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        refusal = "asked for before the e-stop was pressed; reset it once more"
        if not self._is_outdated():
            refusal = self.supervisor.e_stop_reset(self.clock())
        response.success, response.message = not refusal, refusal or "disarmed"
        self.publish_diagnostics()
        return response

    def _on_housekeeping(self) -> None:
        self.commander_watch.check()
        self.commander_watch.look_for_other_unit()
        seconds = sum(gate.refused[Refusal.SECOND_COMMANDER] for gate in self.supervisor.gates.values())
        self._second_commander = seconds > self._seconds_at_check
        self._seconds_at_check = seconds
        self._report_refusals()
        self._report_suppressed()
        self.publish_diagnostics()

    def _report_change(self, drive: Drive) -> None:
        supervisor = self.supervisor
        logger = self.node.get_logger()
        text = f"{supervisor.mode.value}: {supervisor.reason}"
        same_mode = self._reported_mode is not None and self._reported_mode[0] is supervisor.mode
        # Commands slower than their timeout start and starve the plant each time.
        left_out = self._mode_lines.ask(time.monotonic(), urgent=not same_mode)
        timeout = supervisor.limits.command_timeout
        if left_out is None:
            pass
        elif supervisor.mode in {Mode.FAULT, Mode.E_STOP}:
            logger.error(text)
        elif left_out:
            many = f"{left_out} changes since the last line: do commands come more slowly than every {timeout:g} s?"
            logger.warning(f"{text}; {many}")  # noqa: G004  # ROS's logger formats nothing
        elif drive.starved and self._reported_mode is not None:
            logger.warning(text)
        else:
            logger.info(text)
        if supervisor.trajectory_finished:
            self.publish_event(Event.TRAJECTORY_FINISHED, reason=supervisor.reason)
        else:
            self.publish_event(Event.PLANT_MODE, mode=supervisor.mode.value, reason=supervisor.reason)

    def _report_refusals(self) -> None:
        gates = {kind: self.supervisor.gates[kind] for kind in self.inputs}
        refused = sum(sum(gate.refused.values()) for gate in gates.values())
        if refused > self._reported_refusals:
            details = ", ".join(
                f"{self._topics[kind]} {refusal.value} {count} ({gate.problems.get(refusal, '')})"
                for kind, gate in gates.items()
                for refusal, count in sorted(gate.refused.items())
            )
            self.node.get_logger().warning(f"commands refused so far: {details}")
            self._reported_refusals = refused

    def _report_suppressed(self) -> None:
        left_out = self._mode_lines.flush(time.monotonic())
        if left_out:
            supervisor = self.supervisor
            text = f"{supervisor.mode.value}: {supervisor.reason}"
            self.node.get_logger().info(f"{text}; {left_out} changes since the last line")

    def _level(self) -> bytes:
        mode = self.supervisor.mode
        if mode in {Mode.FAULT, Mode.E_STOP}:
            return DiagnosticStatus.ERROR
        starved = self._reported_mode is not None and self._reported_mode[1]
        conflict = bool(self.supervisor.commander_conflict)
        warn = starved or conflict or self._second_commander or bool(self.commander_watch.in_other_unit)
        return DiagnosticStatus.WARN if warn else DiagnosticStatus.OK


def _came_before(arrived_ns: int, happened_at: float) -> bool:
    """Return whether an arrival in system time [ns], 0 if unknown, was before a steady time [ns].

    By their ages: the system clock may have been set since, and the process may have stalled.
    """
    return arrived_ns > 0 and time.time_ns() - arrived_ns > time.monotonic_ns() - happened_at
