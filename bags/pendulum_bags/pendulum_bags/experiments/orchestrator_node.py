"""The node that orchestrates an experiment: it arms plants, moves them, switches controllers and disturbances."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping
from types import TracebackType
from typing import Any, TypeVar

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.client import Client
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.drive import Mode
from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.trajectory import Trajectory
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.errors import FaultError, PlantStoppedError
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import event_message, sample_from_bytes, stamp_of_state, trajectory_to_message
from pendulum_msgs_py.ros.leaving import leaving_graph
from pendulum_msgs_py.ros.middleware import check_closed, set_middleware_defaults
from pendulum_msgs_py.ros.polled import PolledInput, PollingNode

__all__ = ["Orchestrator", "PlantClient", "RecorderClient"]

_SLICE = 0.05
_QUIET_POLLS = 3
_SILENCE = 5.0
"""Time of listening without a state after which a plant in real time counts as gone [s]."""
_MATCHING = 1.0
"""Longest wait for subscribers on the graph to match a publisher [s]."""
_T = TypeVar("_T")


class Orchestrator:
    """An rclpy context and node, spun only while waiting; Ctrl-C ends any wait, a timeout is a FaultError.

    Args:
        watch: Called between two slices of waiting; raises to end the experiment (a process has died).

    Attributes:
        listened: Total time of spinning [s], without pauses of this program.
    """

    def __init__(
        self, domain: int, *, watch: Callable[[], None] = lambda: None, on_wait: Callable[[], None] = lambda: None
    ) -> None:
        self.domain = domain
        self.watch = watch
        self.on_wait = on_wait
        self.listened = 0.0
        self.after_listening: list[Callable[[], None]] = []

    def __enter__(self) -> Orchestrator:
        """Join the graph."""
        set_middleware_defaults()
        self.context = Context()
        rclpy.init(context=self.context, domain_id=self.domain, signal_handler_options=SignalHandlerOptions.NO, args=[])
        self.node = PollingNode("conductor", context=self.context, start_parameter_services=False)
        check_closed(self.domain)
        self._executor = EventsExecutor(context=self.context)
        self._executor.add_node(self.node)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        with leaving_graph():
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.context)

    def spin(self, duration: float) -> None:
        """Only listen for a while [s]."""
        deadline = time.monotonic() + duration
        while (left := deadline - time.monotonic()) > 0:
            self._slice(min(_SLICE, left))

    def wait_for(self, what: str, predicate: Callable[[], _T], timeout: float, *, until: Future | None = None) -> _T:
        """Wait, at most ``timeout`` [s], until a predicate holds; return its value. ``until`` ends a slice early."""
        deadline = time.monotonic() + timeout
        while not (value := predicate()):
            if time.monotonic() > deadline:
                raise FaultError(f"waited {timeout:g} s for {what}, in vain")
            self._slice(_SLICE, until)
        return value

    def call(self, client: Client, request: Any, what: str, timeout: float = 10.0) -> Any:
        """Call a service and return its response."""
        self.wait_for_service(client, timeout)
        future = client.call_async(request)
        self.wait_for(what, future.done, timeout, until=future)
        return future.result()

    def wait_for_service(self, client: Client, timeout: float) -> None:
        """Wait until a service is available, at most ``timeout`` [s]."""
        what = f"service {client.srv_name} (of a program that does not run, or stands still)"
        self.wait_for(what, client.service_is_ready, timeout)

    def listen(self, duration: float, until: Future | None = None) -> None:
        """Handle what arrives within a duration [s], or until a future is done, without further checks."""
        began = time.monotonic()
        self._executor.spin_until_future_complete(Future(executor=None) if until is None else until, duration)
        self.listened += min(duration, time.monotonic() - began)
        for check in self.after_listening:
            check()

    def _slice(self, duration: float, until: Future | None = None) -> None:
        self.listen(duration, until)
        self.watch()
        self.on_wait()


class PlantClient:
    """One plant with its controller and its disturbance, as the orchestrator sees them.

    Methods raise FaultError if a service is missing, refuses (with its reason) or does not respond in time.

    Args:
        namespace: Namespace of the plant's topics, such as ``/sim``.
        controller, disturbance: Names of their nodes, empty for none.
        watch: Subscribe to its states now; a plant in lockstep waits for its last listener, which may be this one.
        joints: Names of its joints.
    """

    def __init__(
        self,
        orchestrator: Orchestrator,
        namespace: str,
        plant: str,
        *,
        controller: str = "controller",
        disturbance: str = "disturbance",
        watch: bool = True,
        joints: tuple[str, ...] = ONE_JOINT.names,
    ) -> None:
        node = orchestrator.node
        self._joints = joints
        self.orchestrator = orchestrator
        self.namespace = namespace = namespace.rstrip("/")
        self.sample: JointSample | None = None
        self._foreign_joints: tuple[str, ...] = ()
        self._heard = orchestrator.listened
        self.events: list[dict[str, Any]] = []
        self._arm = node.create_client(SetBool, f"{namespace}/{plant}/arm")
        self._pause = node.create_client(SetBool, f"{namespace}/{plant}/pause")
        self._e_stop = node.create_client(Trigger, f"{namespace}/{plant}/e_stop")
        self._change_state = node.create_client(ChangeState, f"{namespace}/{controller}/change_state")
        self._get_state = node.create_client(GetState, f"{namespace}/{controller}/get_state")
        self._start = node.create_client(Trigger, f"{namespace}/{disturbance}/start")
        self._trajectory = node.create_publisher(
            JointTrajectory, f"{namespace}/{names.JOINT_TRAJECTORY}", qos.TRAJECTORY
        )
        self._events = node.create_publisher(String, f"{namespace}/{names.EVENTS}", qos.EVENTS)
        node.create_subscription(String, f"{namespace}/{names.EVENTS}", self._on_event, qos.EVENTS)
        self._watching: PolledInput | None = None
        if watch:
            self.watch()

    @property
    def is_heard(self) -> bool:
        """Whether any of its states has arrived, of any joints."""
        return self.sample is not None or bool(self._foreign_joints)

    def watch(self) -> None:
        """Subscribe to the plant's states and poll the newest, without a callback for each."""
        self._watching = self.orchestrator.node.create_polled_input(
            JointState, f"{self.namespace}/{names.JOINT_STATES}", qos.NEWEST_STATE
        )
        self.orchestrator.after_listening.append(self._poll)

    def stop_watching(self) -> None:
        """Unsubscribe from its states: receiving them costs a tenth of a run in lockstep."""
        if self._watching is not None:
            self.orchestrator.after_listening.remove(self._poll)
            self.orchestrator.node.destroy_polled_input(self._watching)
            self._watching = None

    def _poll(self) -> None:
        if self._watching is not None:
            self._watching.take(self._on_state)

    def wait_until_ready(self, timeout: float, *, controller: bool = True, disturbance: bool = True) -> None:
        """Wait until states of the right joints arrive and all services and the trajectory topic are there."""
        wait = self.orchestrator.wait_for
        wait(f"states on {self.namespace}/{names.JOINT_STATES}", self._has_state, timeout)
        clients = [self._arm, self._e_stop]
        clients += [self._change_state] if controller else []
        clients += [self._start] if disturbance else []
        for client in clients:
            self.orchestrator.wait_for_service(client, timeout)
        wait(
            f"a plant on {self.namespace}/{names.JOINT_TRAJECTORY}",
            lambda: self._trajectory.get_subscription_count() > 0,
            timeout,
        )

    def wait_until_moves_are_recorded(self, timeout: float) -> None:
        """Wait until a recorder is matched with the trajectory publisher, at both ends, at most ``timeout`` [s]."""
        topic, node = f"{self.namespace}/{names.JOINT_TRAJECTORY}", self.orchestrator.node

        def listeners() -> list[tuple[str, str]]:
            return [(each.node_namespace, each.node_name) for each in node.get_subscriptions_info_by_topic(topic)]

        self.orchestrator.wait_for(
            f"a recorder on {topic}", lambda: (self.namespace or "/", names.RECORDER) in listeners(), timeout
        )
        # Subscribers with other QoS never match.
        deadline = time.monotonic() + _MATCHING
        while self._trajectory.get_subscription_count() < len(listeners()) and time.monotonic() < deadline:
            self.orchestrator.spin(_SLICE)

    def _has_state(self) -> bool:
        if self.sample is None and self._foreign_joints:
            found, ours = ", ".join(self._foreign_joints), ", ".join(self._joints)
            expected = "the one of a pendulum" if len(self._joints) == 1 else "those of the plant"
            raise FaultError(
                f"{self.namespace} has the joint{'s' * (len(self._foreign_joints) > 1)} {found}; expected {expected}, "
                f"{ours}"
            )
        return self.sample is not None

    def arm(self, timeout: float = 10.0) -> None:
        """Arm the plant; a bridge offers the service before it is connected, so ``timeout`` [s] may be long."""
        response = self.orchestrator.call(self._arm, SetBool.Request(data=True), f"{self.namespace} to arm", timeout)
        if not response.success:
            raise FaultError(f"{self.namespace} does not arm: {response.message}")

    def disarm(self) -> None:
        """Disarm the plant."""
        self.orchestrator.call(self._arm, SetBool.Request(data=False), f"{self.namespace} to disarm")

    def call(self, service: str) -> None:
        """Call a Trigger service of another node in the plant's namespace, such as ``procedure/start``."""
        client = self.orchestrator.node.create_client(Trigger, f"{self.namespace}/{service}")
        response = self.orchestrator.call(client, Trigger.Request(), f"{self.namespace}/{service}")
        if not response.success:
            raise FaultError(f"{self.namespace}/{service} refuses: {response.message}")

    def resume(self, timeout: float) -> None:
        """Resume a paused plant."""
        self.orchestrator.call(self._pause, SetBool.Request(data=False), f"{self.namespace} to resume", timeout)

    def disarm_quietly(self) -> None:
        """Disarm on the way out; a plant without response must not prevent others from being disarmed."""
        if not self._arm.service_is_ready():
            return
        future = self._arm.call_async(SetBool.Request(data=False))
        deadline = time.monotonic() + 1.0
        while not future.done() and time.monotonic() < deadline:
            self.orchestrator.listen(_SLICE)

    def follow(self, trajectory: Trajectory, phase: str, **details: Any) -> None:
        """Start a move under position control, and record it as a phase."""
        self.mark(phase, **details)
        self._finished_before = len(self.events)
        self._trajectory.publish(trajectory_to_message(trajectory))

    def is_following(self) -> bool:
        """Return whether the plant has started the last requested move; raises as :meth:`trajectory_finished`."""
        return self.trajectory_finished() or any(
            event["name"] == Event.PLANT_MODE and event.get("mode") == "armed_position"
            for event in self.events[self._finished_before :]
        )

    def trajectory_finished(self) -> bool:
        """Return whether the last requested move has ended; PlantStoppedError, or FaultError if refused or silent."""
        self.check_alive()
        for event in self.events[self._finished_before :]:
            if event["name"] == Event.TRAJECTORY_REFUSED:
                # A plant that stopped just before the request refuses the move: the stop is the cause.
                self.check_mode()
                raise FaultError(f"{self.namespace} refused the trajectory: {event.get('reason')}")
            if event["name"] == Event.PLANT_MODE and event.get("mode") in {"fault", "e_stop", "disarmed"}:
                raise PlantStoppedError(self.namespace, str(event["mode"]), str(event.get("reason")))
            if event["name"] == Event.TRAJECTORY_FINISHED:
                return True
        return False

    def configure_controller(self) -> None:
        """Let the controller compute its design, so that activating it takes no time."""
        self._transition(Transition.TRANSITION_CONFIGURE, "configure")

    def switch_controller(self, *, on: bool) -> None:
        """Activate or deactivate the controller."""
        if on:
            self._transition(Transition.TRANSITION_ACTIVATE, "activate")
        else:
            self._transition(Transition.TRANSITION_DEACTIVATE, "deactivate")

    def _transition(self, transition: int, what: str) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        if not self.orchestrator.call(self._change_state, request, f"{self.namespace} controller to {what}").success:
            raise FaultError(f"{self.namespace} controller does not {what}; see its log")

    def start_disturbance(self) -> Future:
        """Request the disturbance to start with the next state; returns at once."""
        return self._start.call_async(Trigger.Request())

    def mark(self, name: str, **details: Any) -> None:
        """Record a phase change at the plant's newest time."""
        stamp_ns = self.sample.stamp_ns if self.sample else 0
        self._events.publish(event_message(stamp_ns, name, **details))

    def newest_event(self, name: str) -> Mapping[str, Any] | None:
        """Return the newest event of a name, or None."""
        return next((event for event in reversed(self.events) if event["name"] == name), None)

    def newest_mode(self) -> str:
        """Return the plant's mode by its newest event; empty before the first."""
        event = self.newest_event(Event.PLANT_MODE)
        return "" if event is None else str(event.get("mode"))

    def is_armed(self) -> bool:
        """Return whether torque may flow."""
        return self.newest_mode() in {Mode.EFFORT.value, Mode.POSITION.value}

    def has_controller(self) -> bool:
        """Return whether a controller is on the graph."""
        return bool(self._get_state.service_is_ready() and self._change_state.service_is_ready())

    def controller_is_active(self) -> bool:
        """Query the controller's lifecycle."""
        state = self.orchestrator.call(self._get_state, GetState.Request(), f"{self.namespace} controller's state")
        return bool(state.current_state.id == State.PRIMARY_STATE_ACTIVE)

    def check_mode(self) -> None:
        """Raise a PlantStoppedError if the plant has faulted or been stopped."""
        mode = self.newest_event(Event.PLANT_MODE)
        if mode is not None and mode.get("mode") in {"fault", "e_stop"}:
            raise PlantStoppedError(self.namespace, str(mode["mode"]), str(mode.get("reason")))

    def check_alive(self) -> None:
        """Raise a FaultError if a plant in real time is silent: one that runs already can end without notice."""
        silent = self.orchestrator.listened - self._heard
        if silent > _SILENCE:
            raise FaultError(
                f"{self.namespace} has sent no state for {silent:.0f} s: its program has ended or hangs. If it moves "
                "something real, cut the motor's supply: a torque that it was sent last may still act"
            )

    def _on_event(self, message: String) -> None:
        try:
            event = json.loads(message.data)
        except json.JSONDecodeError:
            return
        if isinstance(event, dict) and "name" in event:
            self.events.append(event)

    def _on_state(self, data: bytes, _received_ns: int) -> None:
        sample = sample_from_bytes(data, self._joints)
        if sample is None:
            self._foreign_joints = stamp_of_state(data, self._joints)[1]
        else:
            self.sample = sample
            self._heard = self.orchestrator.listened


class RecorderClient:
    """The recorder of the plant in a namespace."""

    def __init__(self, orchestrator: Orchestrator, namespace: str) -> None:
        self._orchestrator = orchestrator
        self._status = orchestrator.node.create_client(Trigger, f"{namespace}/recorder/status")

    def heard(self) -> set[str]:
        """Return the topics whose publishers the recorder is matched with."""
        return set(self._ask().get("matched", []))

    def wait_until_heard(self, topics: Collection[str], timeout: float) -> None:
        """Wait until matched with a publisher of each topic: earlier messages are in no bag; or FaultError."""
        deadline = time.monotonic() + timeout
        while missing := set(topics) - self.heard():
            if time.monotonic() > deadline:
                unheard = ", ".join(sorted(missing))
                raise FaultError(
                    f"the recorder has met no publisher of {unheard} in {timeout:g} s; expected one of each topic"
                )
            self._orchestrator.spin(_SLICE)

    def received(self, topic: str) -> int:
        """Return how many messages of a topic it has."""
        return self._counts().get(topic, 0)

    def wait_for_all(self, expected: Mapping[str, int], timeout: float = 60.0) -> None:
        """Wait for the expected messages (topic -> number), perhaps seconds late; a FaultError if some are missing."""
        counts: dict[str, int] = {}
        quiet = 0
        deadline = time.monotonic() + timeout
        while quiet < _QUIET_POLLS or any(counts.get(topic, 0) < count for topic, count in expected.items()):
            if time.monotonic() > deadline:
                behind = min(expected, key=lambda topic: counts.get(topic, 0) - expected[topic])
                raise FaultError(
                    f"the recorder has {counts.get(behind, 0)} of {expected[behind]} messages of {behind} after "
                    f"{timeout:g} s"
                )
            self._orchestrator.spin(_SLICE)
            before, counts = counts, self._counts()
            quiet = quiet + 1 if counts == before else 0

    def _counts(self) -> dict[str, int]:
        return {name: entry["received"] for name, entry in self._ask().get("topics", {}).items()}

    def _ask(self) -> dict[str, Any]:
        response = self._orchestrator.call(self._status, Trigger.Request(), "the recorder's status", 30.0)
        status: dict[str, Any] = json.loads(response.message)
        return status
