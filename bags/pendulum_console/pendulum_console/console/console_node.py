"""``console``: a web page on which the plants of a ROS domain are seen live, tuned, armed and stopped."""

from __future__ import annotations

import asyncio
import json
import secrets
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import rclpy
import typer
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from pendulum_console.console.graph import Description
from pendulum_console.console.jobs import Jobs
from pendulum_console.console.joint_values import JointValues
from pendulum_console.console.page import serve
from pendulum_console.console.security import is_loopback, listen
from pendulum_console.console.stop_order import StopOrder
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import fields_from_bytes, stamp_from_message
from pendulum_msgs_py.ros.leaving import leaving_graph
from pendulum_msgs_py.ros.middleware import check_closed, set_middleware_defaults
from pendulum_msgs_py.ros.polled import PolledInput, PollingNode
from pendulum_rosbag.recorder.parameter_reader_node import ParameterReader

__all__ = ["Hub", "main"]

_POLL_PERIOD = 0.3
_SLICE = 0.2
_TIMEOUT = 3.0
"""Longest wait for a response of a node [s]."""
_TORQUES = {"command": names.EFFORT_COMMAND, "disturbance": names.DISTURBANCE, "applied": names.APPLIED_EFFORT}
_SILENT = 2.0
"""Age at which a node's diagnostics are ignored [s]; nodes publish them twice a second."""
_STOP_SERVICE = "/e_stop"
_STOP_TICK = 0.02
_STOP_WAIT = 0.4
"""Longest wait for the plants' responses to a stop before silent plants are reported [s]."""


@dataclass
class _Plant:
    """State of one plant; the drawing code, not an executor, reads ``taps``."""

    namespace: str
    node: str
    taps: dict[str, PolledInput]
    others: list[Any] = field(default_factory=list)
    joints: JointValues = field(default_factory=JointValues)
    mode: str = ""
    reason: str = ""
    mode_stamp_ns: int = 0
    figures: dict[str, str] = field(default_factory=dict)


class Hub:
    """The console's end of the graph; requests raise FaultError with the reason of a refusal."""

    def __init__(self) -> None:
        set_middleware_defaults()
        self._context = Context()
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = PollingNode("console", context=self._context)
        check_closed(self._context.get_domain_id())
        self._lock = threading.Lock()
        self._plants: dict[str, _Plant] = {}
        self._clients: dict[str, Any] = {}
        self._said: dict[str, tuple[str, float]] = {}
        self._described: dict[tuple[str, ...], dict[str, Description]] = {}
        self._reader = ParameterReader(self._node, lambda _values, _changed: None)
        self._node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        self._node.create_timer(_POLL_PERIOD, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._done = Future(executor=None)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        self._order = StopOrder()
        self._order_lock = threading.Lock()
        self._order_changed = threading.Event()
        self._stop_clients: dict[str, Any] = {}
        self._stop_calls: dict[str, list[tuple[float, Any]]] = {}
        self._leaving = threading.Event()
        self._stopper = threading.Thread(target=self._keep_stopping, name="stop", daemon=True)
        self._stopper.start()

    def close(self) -> None:
        """Leave the graph."""
        self._leaving.set()
        self._order_changed.set()
        self._stopper.join(2.0)
        self._done.set_result(None)
        self._executor.wake()
        self._thread.join(2.0)
        with leaving_graph():
            self._executor.shutdown()
            self._node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Current parameters of all nodes: node -> name -> value."""
        return self._reader.values

    def frame(self) -> dict[str, Any]:
        """Return the newest values to draw, by namespace."""
        with self._lock:
            return {plant.namespace: self._read(plant) for plant in self._plants.values()}

    def plants(self) -> dict[str, str]:
        """Return the plants on the graph: namespace -> full node name."""
        with self._lock:
            return {plant.namespace: plant.node for plant in self._plants.values()}

    async def e_stop(self, nodes: Sequence[str] = ()) -> dict[str, Any] | None:
        """Order these plants, or all, to stop until the operator acknowledges it; return the order's state."""
        with self._order_lock:
            for node in nodes:
                self._order.press_one(node, time.monotonic())
            if not nodes:
                self._order.press(self.plants().values(), time.monotonic())
        self._order_changed.set()
        deadline = time.monotonic() + _STOP_WAIT
        while time.monotonic() < deadline:
            state = self.stop_state()
            if state is None or all(row["state"] == "stopped" for row in state["rows"].values()):
                break
            await asyncio.sleep(0.01)
        return self.stop_state()

    def stop_state(self) -> dict[str, Any] | None:
        """Return each plant's response to the stop in force; None without one."""
        with self._order_lock:
            return self._order.state(time.monotonic())

    def acknowledge_stop(self) -> list[str]:
        """End the order for stopped plants; return those without response, for which it stays."""
        with self._order_lock:
            return self._order.acknowledge(time.monotonic())

    def release_stop(self, node: str) -> None:
        """End the requests to one plant: its e-stop is reset, or it is given up."""
        with self._order_lock:
            self._order.release(node)

    async def reset(self, node: str) -> str:
        """Reset a plant's e-stop and end the order for it; a FaultError if another stop came later."""
        self.release_stop(node)
        # A pending request would stop the plant again after its reset.
        deadline = time.monotonic() + _TIMEOUT
        while self._is_asked_to_stop(node) and time.monotonic() < deadline:
            await asyncio.sleep(0.01)
        with self._order_lock:
            if self._order.holds(node):
                raise FaultError(f"{node} got another stop meanwhile: its e-stop is not reset")
        return await self.trigger(f"{node}/e_stop_reset")

    def _keep_stopping(self) -> None:
        """Repeat requests in a thread of its own: neither page nor server may delay a stop."""
        while not self._leaving.is_set():
            with self._order_lock:
                now = time.monotonic()
                due = self._order.due(self.plants().values(), now)
                idle = not self._order.in_force
            for node in due:
                try:
                    self._ask_to_stop(node, now)
                # One plant's service must not end the stop of all others.
                except Exception as error:  # noqa: BLE001
                    with self._order_lock:
                        self._order.problem(node, f"cannot be asked: {type(error).__name__}: {error}")
            if idle:
                self._order_changed.wait()
                self._order_changed.clear()
            else:
                self._leaving.wait(_STOP_TICK)

    def _stop_client(self, node: str) -> Any:
        with self._lock:
            client = self._stop_clients.get(node)
            if client is None:
                service = f"{node}{_STOP_SERVICE}"
                client = self._stop_clients[node] = self._node.create_client(Trigger, service)
            return client

    def _ask_to_stop(self, node: str, now: float) -> None:
        client = self._stop_client(node)
        # A later response is from a blocked plant; the request has been repeated since.
        calls = self._stop_calls.setdefault(node, [])
        for _, call in [entry for entry in calls if now - entry[0] > _TIMEOUT]:
            client.remove_pending_request(call)
        calls[:] = [entry for entry in calls if now - entry[0] <= _TIMEOUT and not entry[1].done()]
        if not client.service_is_ready():
            with self._order_lock:
                self._order.problem(node, "out of reach; it is asked as soon as it is back")
            return

        def take(future: Any) -> None:
            response = future.result() if future.exception() is None and not future.cancelled() else None
            with self._order_lock:
                if response is not None and response.success:
                    self._order.answer(node, response.message, time.monotonic())
                elif response is not None:
                    self._order.problem(node, f"refuses: {response.message}")

        with self._order_lock:
            if not self._order.holds(node):
                return
            call = client.call_async(Trigger.Request())
            calls.append((now, call))
        call.add_done_callback(take)

    def _is_asked_to_stop(self, node: str) -> bool:
        # A request to a plant that ended before its response never completes.
        since = time.monotonic() - _TIMEOUT
        with self._order_lock:
            return any(asked > since and not call.done() for asked, call in self._stop_calls.get(node, ()))

    async def trigger(self, service: str) -> str:
        """Call a service without arguments."""
        return _accepted(service, await self._call(Trigger, service, Trigger.Request()))

    async def arm(self, node: str, *, on: bool) -> str:
        """Arm or disarm a plant."""
        return _accepted(node, await self._call(SetBool, f"{node}/arm", SetBool.Request(data=on)))

    def has_node(self, node: str) -> bool:
        """Return whether a node is on the graph, by its full name."""
        found = self._node.get_node_names_and_namespaces()
        return any(names.full_name(space, name) == node for name, space in found)

    def said(self, node: str) -> str:
        """Return a node's latest diagnostics; empty once it is silent."""
        with self._lock:
            text, heard = self._said.get(node, ("", 0.0))
        return text if time.monotonic() - heard < _SILENT else ""

    async def activate(self, node: str, *, on: bool) -> str:
        """Activate or deactivate a controller."""
        label, number = (
            ("activate", Transition.TRANSITION_ACTIVATE) if on else ("deactivate", Transition.TRANSITION_DEACTIVATE)
        )
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        if not (await self._call(ChangeState, f"{node}/change_state", request)).success:
            raise FaultError(f"{node} does not {label}: it says {self.said(node) or 'nothing'!r}; see its log")
        return f"{node}: {label}d"

    async def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter."""
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        result = (await self._call(SetParameters, f"{node}/set_parameters", request)).results[0]
        if not result.successful:
            raise FaultError(f"{node} refuses {name} = {value}: {result.reason}")

    async def describe(self, node: str) -> dict[str, Description]:
        """Return a node's parameter descriptions, requested once for each set of names."""
        wanted = sorted(self.parameters.get(node, {}))
        key = (node, *wanted)
        if key not in self._described:
            request = DescribeParameters.Request(names=wanted)
            answer = await self._call(DescribeParameters, f"{node}/describe_parameters", request)
            self._described[key] = {
                it.name: Description(it.description, it.additional_constraints, it.read_only)
                for it in answer.descriptors
            }
        return self._described[key]

    async def _call(self, kind: Any, service: str, request: Any) -> Any:
        with self._lock:
            client = self._clients.get(service)
            if client is None:
                client = self._clients[service] = self._node.create_client(kind, service)
        deadline = time.monotonic() + _TIMEOUT
        while not client.service_is_ready():
            if time.monotonic() > deadline:
                raise FaultError(f"{service} is not there; is its node running?")
            await asyncio.sleep(0.01)
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[Any] = loop.create_future()

        def settle(answer: Any) -> None:
            if not answered.done():
                answered.set_result(answer)

        def hand_over(future: Any) -> None:
            loop.call_soon_threadsafe(settle, future.result())

        client.call_async(request).add_done_callback(hand_over)
        try:
            return await asyncio.wait_for(answered, _TIMEOUT)
        except asyncio.TimeoutError:
            raise FaultError(f"{service} does not respond within {_TIMEOUT:g} s") from None

    def _spin(self) -> None:
        while not self._done.done():
            try:
                self._executor.spin_until_future_complete(self._done, _SLICE)
            # A callback that failed on one message must not block the responses to a stop.
            except Exception as error:  # noqa: BLE001
                self._node.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=1.0)

    def _poll(self) -> None:
        self._reader.poll(forget=True)
        found = {
            name.removesuffix(_STOP_SERVICE)
            for name, types in self._node.get_service_names_and_types()
            if name.endswith(_STOP_SERVICE)
            and "std_srvs/srv/Trigger" in types
            # A name stays listed while any node, this one included, has a client.
            and self._node.count_services(name)
        }
        with self._lock:
            known = dict(self._plants)
        for node in found - known.keys():
            plant = self._meet(node)
            with self._lock:
                self._plants[node] = plant
        for node in known.keys() - found:
            with self._lock:
                gone = self._plants.pop(node)
                stale = [name for name in self._clients if name.startswith(f"{gone.namespace}/")]
                clients = [self._clients.pop(name) for name in stale]
            for tap in gone.taps.values():
                self._node.destroy_polled_input(tap)
            for subscription in gone.others:
                self._node.destroy_subscription(subscription)
            for client in clients:
                self._node.destroy_client(client)

    def _meet(self, node: str) -> _Plant:
        space = node.rpartition("/")[0]
        topics = {"state": names.JOINT_STATES, **_TORQUES}
        taps = {
            key: self._node.create_polled_input(JointState, f"{space}/{topic}", qos.NEWEST_STATE)
            for key, topic in topics.items()
        }
        plant = _Plant(space, node, taps)
        plant.others.append(
            self._node.create_subscription(
                String, f"{space}/{names.EVENTS}", lambda message: _on_event(plant, message), qos.EVENTS
            )
        )
        # Created now: a stop must not wait for a client to discover its service.
        self._stop_client(node)
        return plant

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        with self._lock:
            for status in message.status:
                self._said[status.name.partition(":")[0]] = (status.message, time.monotonic())
                plant = self._plants.get(status.name.partition(":")[0])
                if plant is not None:
                    plant.figures = {pair.key: pair.value for pair in status.values}
                    # For late joiners; a mode older than the newest event would revert it.
                    if stamp_from_message(message.header.stamp) > plant.mode_stamp_ns:
                        plant.mode, plant.reason = plant.figures.get("mode", plant.mode), status.message

    def _read(self, plant: _Plant) -> dict[str, Any]:
        now = time.monotonic()
        for key, tap in plant.taps.items():
            for data, _ in tap.messages():
                fields = fields_from_bytes(data)
                if fields is not None and key == "state":
                    plant.joints.take_state(fields)
                elif fields is not None:
                    plant.joints.take_effort(key, fields, now)
        return {
            **plant.joints.picture(now),
            "stamp_ns": str(plant.joints.stamp_ns),
            "node": plant.node,
            "mode": plant.mode,
            "reason": plant.reason,
            "mode_ms": plant.mode_stamp_ns / 1e6,
            "rate": plant.figures.get("rate_hz", ""),
            "jitter": plant.figures.get("jitter_p99_us", ""),
        }


def _on_event(plant: _Plant, message: String) -> None:
    try:
        event = json.loads(message.data)
    except json.JSONDecodeError:
        return
    if not isinstance(event, dict) or event.get("name") != Event.PLANT_MODE:
        return
    stamp_ns = event.get("stamp_ns", 0)
    if isinstance(stamp_ns, int):
        plant.mode, plant.reason = str(event.get("mode", "")), str(event.get("reason", ""))
        plant.mode_stamp_ns = stamp_ns


def _accepted(who: str, response: Any) -> str:
    if not response.success:
        raise FaultError(f"{who} refuses: {response.message}")
    return str(response.message)


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m pendulum_console console --port 8090. The ROS domain is that of ROS_DOMAIN_ID.")
def console(
    host: Annotated[
        str, typer.Option(help="Address to listen on; beyond this machine a token is needed.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8090,
    runs: Annotated[Path, typer.Option(help="Folder of what is recorded or run from the page.")] = Path("bags/runs"),
) -> int:
    """Serve the console until Ctrl-C."""
    token = "" if is_loopback(host) else secrets.token_urlsafe(16)
    if runs.exists() and not runs.is_dir():
        raise ParameterError(f"runs is {runs}, a file; expected a folder")
    # Refuse an unavailable address before anything starts.
    listen(host, port).close()
    hub, jobs = Hub(), Jobs(runs.resolve())
    address = f"http://{'localhost' if is_loopback(host) else host}:{port}/" + (f"?token={token}" if token else "")
    try:
        serve(hub, jobs, host=host, port=port, token=token, ready=lambda: print(f"console at {address}", flush=True))
    finally:
        jobs.close()
        hub.close()
    return 0


def main(argv: list[str] | None = None) -> int:
    """Run the console."""
    return cli_main(app, list(sys.argv[1:] if argv is None else argv), name="python -m pendulum_console console")
