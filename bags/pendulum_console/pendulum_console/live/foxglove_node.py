"""A node that passes the graph to viewers: topics as on the wire, parameters, and services to call.

Nothing is published: torques come from controllers only. An e-stop latches, and a plant may refuse arming.
"""

from __future__ import annotations

import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import foxglove
from foxglove.websocket import Capability, ServerListener
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from pendulum_console.live.gate import Gate
from pendulum_console.live.handshake import refusal
from pendulum_console.live.live_topic_node import LiveTopic
from pendulum_console.live.schemas import service_text
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import FaultError, PendulumError
from pendulum_msgs_py.ros.convert import class_of
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.timers import create_wall_timer
from pendulum_rosbag.recorder.parameter_reader_node import ParameterReader

__all__ = ["LiveNode", "LiveOptions"]

_TAKE_PERIOD = 0.02
"""Period of polling the middleware [s]: a video frame, long enough to send several messages together."""
_POLL_PERIOD = 0.3
_TIMEOUT = 3.0
"""Longest wait for a response of a node [s]."""
_NO_PLANT_AFTER = 3.0
"""Time after which a missing plant is reported [s]."""
_BACKLOG = 16384
"""Messages queued for a slow client: two seconds of two plants at 500 Hz with all their topics."""
_OF_PARAMETERS = ("rcl_interfaces/", "type_description_interfaces/")
_E_STOP = f"/{names.E_STOP.removeprefix('~/')}"


@dataclass(frozen=True)
class LiveOptions:
    """Listening port (0 for any), and the token of clients (empty on loopback)."""

    host: str = "127.0.0.1"
    port: int = 8765
    token: str = ""
    origins: tuple[str, ...] = ()


class LiveNode(PollingNode):
    """Serves the graph over the Foxglove WebSocket protocol; a ParameterError if the port is not available."""

    def __init__(self, options: LiveOptions, stop: Callable[[], None]) -> None:
        super().__init__("foxglove")
        self._context_of_viewers = foxglove.Context()
        self._topics: dict[str, LiveTopic] = {}
        self._callable: dict[str, Any] = {}
        self._sent = self._lost = 0
        self._unknown: set[str] = set()
        self._plants: set[str] = set()
        self._log_lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._began = time.monotonic()
        self._no_plant_reported = False
        self._reader = ParameterReader(self, self._on_values)
        self._setters: dict[str, Any] = {}
        self._setters_lock = threading.Lock()
        listener = _Listener(self._shown, self._set_all)
        self._server, server_host = _start_server(listener, self.context.get_domain_id(), self._context_of_viewers)
        try:
            self._gate = Gate(
                options.host,
                options.port,
                (server_host, self._server.port),
                lambda request: refusal(request, options.token, options.origins),
                self._log_lines.put,
            )
        except PendulumError:
            self._server.stop()
            raise
        self.port = self._gate.port
        self._poll()
        create_wall_timer(self, _POLL_PERIOD, self._poll)
        create_wall_timer(self, _TAKE_PERIOD, self._take)

    def close(self) -> None:
        """Disconnect all clients."""
        for topic in self._topics.values():
            self._leave(topic)
        self._topics.clear()
        self._server.stop()
        self._gate.close()
        self._print_log_lines()
        print(f"handed on {self._sent} messages; {self._lost} were lost on the way from their publishers", flush=True)

    def _print_log_lines(self) -> None:
        """Print the gate's lines in this thread, so that they do not mix."""
        while not self._log_lines.empty():
            print(self._log_lines.get(), flush=True)

    def _take(self) -> None:
        self._print_log_lines()
        for topic in self._topics.values():
            topic.take()

    def _leave(self, topic: LiveTopic) -> None:
        topic.close()
        self._sent += topic.sent
        self._lost += topic.lost

    def _poll(self) -> None:
        self._reader.poll()
        there = {name: types for name, types in self.get_topic_names_and_types() if self.count_publishers(name)}
        for name, types in there.items():
            if name in self._topics or name in self._unknown:
                continue
            try:
                if len(types) != 1:
                    raise FaultError(f"it has the types {', '.join(types)}; expected one")
                self._topics[name] = LiveTopic(self, name, types[0], self._context_of_viewers)
            except (FaultError, ImportError) as error:
                self._unknown.add(name)
                self.get_logger().warning(f"{name} is not shown: {error}")
        for name in self._topics.keys() - there.keys():
            self._leave(self._topics.pop(name))
        for topic in self._topics.values():
            topic.poll()
        self._find_services()
        self._find_plants()

    def _find_plants(self) -> None:
        plants = {name.removesuffix(_E_STOP) for name in self._callable if name.endswith(_E_STOP)}
        for plant in sorted(plants - self._plants):
            print(f"plant {plant}", flush=True)
        for plant in sorted(self._plants - plants):
            print(f"plant {plant} has gone", flush=True)
        self._plants = plants
        if plants:
            self._server.remove_status(["no plant"])
        elif time.monotonic() - self._began > _NO_PLANT_AFTER:
            text = (
                f"no plant on ROS domain {self.context.get_domain_id()}; start one, such as python -m pendulum_sim "
                "simulator --ros-args -r __ns:=/sim, or choose another domain (ROS_DOMAIN_ID)"
            )
            if not self._no_plant_reported:
                print(text, flush=True)
            self._no_plant_reported = True
            self._server.publish_status(text, foxglove.StatusLevel.Warning, "no plant")

    def _find_services(self) -> None:
        own = f"{self.get_fully_qualified_name()}/"
        there = {
            name: types[0]
            for name, types in self.get_service_names_and_types()
            if not (name.startswith(own) or types[0].startswith(_OF_PARAMETERS) or "/_" in name)
            # A name stays listed while any node, this one included, has a client.
            and self.count_services(name)
        }
        for name in self._callable.keys() - there.keys():
            self._server.remove_services([name])
            self.destroy_client(self._callable.pop(name))
        for name in there.keys() - self._callable.keys() - self._unknown:
            try:
                kind = class_of(there[name])
                offered = self._as_service(name, there[name], kind)
            except (PendulumError, ImportError) as error:
                self._unknown.add(name)
                self.get_logger().warning(f"{name} cannot be called from a viewer: {error}")
                continue
            # Created now: a stop must not wait for a client to discover its service.
            self._callable[name] = self.create_client(kind, name)
            self._server.add_services([offered])

    def _as_service(self, name: str, type_name: str, kind: Any) -> Any:
        def half(suffix: str, message: Any) -> Any:
            text = service_text(message).encode()
            schema = foxglove.Schema(name=f"{type_name}_{suffix}", encoding="ros2msg", data=text)
            return foxglove.MessageSchema(encoding="cdr", schema=schema)

        def answer(request: Any) -> bytes:
            # Viewers encode empty requests in several ways, not all of which ROS reads.
            empty = not kind.Request.get_fields_and_field_types()
            asked = kind.Request() if empty else deserialize_message(request.payload, kind.Request)
            answered = self._call(self._callable[name], name, asked)
            print(f"{name} was called: {_in_words(answered)}", flush=True)
            return bytes(serialize_message(answered))

        schema = foxglove.ServiceSchema(
            type_name, request=half("Request", kind.Request), response=half("Response", kind.Response)
        )
        return foxglove.Service(name, schema=schema, handler=answer)

    def _call(self, client: Any, name: str, request: Any) -> Any:
        deadline = time.monotonic() + _TIMEOUT
        while not client.service_is_ready():
            if time.monotonic() > deadline:
                raise FaultError(f"{name} is not there; is its node running?")
            time.sleep(0.01)
        answered = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(_TIMEOUT):
            client.remove_pending_request(future)
            raise FaultError(f"{name} does not respond within {_TIMEOUT:g} s")
        return future.result()

    def _on_values(self, values: Mapping[str, Mapping[str, Any]], changed: str) -> None:
        if changed:
            self._server.publish_parameter_values(
                [foxglove.Parameter(f"{changed}.{name}", value=value) for name, value in values[changed].items()]
            )

    def _shown(self, wanted: Sequence[str]) -> list[Any]:
        """Return parameters such as ``/sim/simulator.effort_limit``; all if none is named."""
        known = {
            f"{node}.{name}": value
            for node, values in sorted(self._reader.values.items())
            for name, value in sorted(values.items())
        }
        chosen = known if not wanted else {name: known[name] for name in wanted if name in known}
        return [foxglove.Parameter(name, value=value) for name, value in chosen.items()]

    def _set_all(self, asked: Sequence[Any]) -> None:
        """Set parameters for a viewer, in a thread of the server; show refusals with their reason."""
        for parameter in asked:
            try:
                self._set(parameter.name, parameter.get_value())
            except PendulumError as error:
                print(f"refused: {error}", flush=True)
                self._server.publish_status(str(error), foxglove.StatusLevel.Error)

    def _set(self, full: str, value: Any) -> None:
        node, _, name = full.partition(".")
        known = self._reader.values.get(node, {})
        if name not in known:
            raise FaultError(f"{full} is no parameter of a node that runs")
        service = f"{node}/set_parameters"
        with self._setters_lock:
            client = self._setters.get(service) or self.create_client(SetParameters, service)
            self._setters[service] = client
        message = Parameter(name, value=_like(value, known[name])).to_parameter_msg()
        result = self._call(client, service, SetParameters.Request(parameters=[message])).results[0]
        if not result.successful:
            raise FaultError(f"{node} refuses {name} = {value}: {result.reason}")
        self._reader.values[node][name] = _like(value, known[name])
        print(f"{full} was set to {value}", flush=True)


class _Listener(ServerListener):
    def __init__(self, shown: Callable[[Sequence[str]], list[Any]], set_all: Callable[[Sequence[Any]], None]) -> None:
        self._shown = shown
        self._set_all = set_all

    def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> list[Any]:
        """Return parameters to a viewer."""
        return self._shown(param_names)

    def on_set_parameters(self, client: Any, parameters: list[Any], request_id: str | None = None) -> list[Any]:
        """Set parameters for a viewer and return their values."""
        self._set_all(parameters)
        return self._shown([parameter.name for parameter in parameters])


def _start_server(listener: Any, domain: int, context: Any) -> tuple[Any, str]:
    def start(host: str) -> Any:
        return foxglove.start_server(
            name=f"pendulum, ROS domain {domain}",
            host=host,
            port=0,
            capabilities=[Capability.Parameters, Capability.Services],
            server_listener=listener,
            supported_encodings=["cdr"],
            context=context,
            message_backlog_size=_BACKLOG,
        )

    # No page in a browser can guess it. If loopback has only one address, that is used.
    host = "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))
    try:
        return start(host), host
    except RuntimeError:
        return start("127.0.0.1"), "127.0.0.1"


def _in_words(answer: Any) -> str:
    if not hasattr(answer, "success"):
        return "answered"
    return f"{'done' if answer.success else 'refused'}{': ' * bool(answer.message)}{answer.message}"


def _like(value: Any, known: Any) -> Any:
    """Return a value as the type of the present one: a viewer writes 2 for 2.0."""
    if isinstance(known, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(known, list) and isinstance(value, list) and known and value:
        return [_like(each, known[0]) for each in value]
    return value
