"""Parameters of all nodes, for the bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterEvent, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import qos_profile_parameter_events

from pendulum_msgs_py.contract.names import full_name

if TYPE_CHECKING:
    from rclpy.client import Client
    from rclpy.node import Node

__all__ = ["ParameterReader"]

_PATIENCE = 50  # graph polls after which a node that does not respond is given up


class ParameterReader:
    """Requests the parameters of each node that appears, and follows their changes.

    ``on_values`` is called with all values (node -> parameter -> value) and the node with a change, or "".
    """

    def __init__(self, node: Node, on_values: Callable[[Mapping[str, Mapping[str, Any]], str], None]) -> None:
        self._node = node
        self._on_values = on_values
        self.values: dict[str, dict[str, Any]] = {}
        self._waiting: dict[str, int] = {}
        self._known: set[str] = {node.get_fully_qualified_name()}
        self._clients: list[Client] = []
        self._finished: list[Client] = []
        node.create_subscription(ParameterEvent, "/parameter_events", self._on_event, qos_profile_parameter_events)

    def poll(self, *, forget: bool = False) -> None:
        """Send requests to new nodes with services; ``forget`` drops the values of nodes that are gone."""
        for client in self._finished:
            self._node.destroy_client(client)
        self._finished.clear()
        found = {full_name(space, name): name for name, space in self._node.get_node_names_and_namespaces()}
        for full in [full for full in self._known if forget and full not in found]:
            self._known.discard(full)
            self.values.pop(full, None)
            self._waiting.pop(full, None)
        for full, name in found.items():
            if full not in self._known and not name.startswith("_"):
                self._known.add(full)
                self._waiting[full] = 0
        for full in list(self._waiting):
            self._waiting[full] += 1
            if self._ask(full) or self._waiting[full] > _PATIENCE:
                del self._waiting[full]

    def _client(self, kind: Any, full: str, service: str) -> Client:
        return self._node.create_client(kind, f"{full}/{service}")

    def _offers(self, full: str) -> bool:
        """Return whether the graph shows a node's parameter services: needless clients load discovery."""
        space, _, name = full.rpartition("/")
        try:
            offered = self._node.get_service_names_and_types_by_node(name, space or "/")
        except NodeNameNonExistentError:
            return False
        return {f"{full}/list_parameters", f"{full}/get_parameters"} <= {service for service, _ in offered}

    def _ask(self, full: str) -> bool:
        if not self._offers(full):
            return False
        lister = self._client(ListParameters, full, "list_parameters")
        getter = self._client(GetParameters, full, "get_parameters")
        if not (lister.service_is_ready() and getter.service_is_ready()):
            self._finished += [lister, getter]
            return False

        def on_names(future: Any) -> None:
            self._finished.append(lister)
            answer = future.result()
            if answer is None or not answer.result.names:
                self._finished.append(getter)
                return
            names = list(answer.result.names)
            asked = getter.call_async(GetParameters.Request(names=names))
            asked.add_done_callback(lambda values: on_values(names, values))

        def on_values(names: list[str], future: Any) -> None:
            self._finished.append(getter)
            answer = future.result()
            if answer is None:
                return
            self.values[full] = {
                name: _plain(value)
                for name, value in zip(names, answer.values, strict=False)
                if name != "use_sim_time" or value.bool_value
            }
            self._on_values(self.values, "")

        lister.call_async(ListParameters.Request()).add_done_callback(on_names)
        return True

    def _on_event(self, event: ParameterEvent) -> None:
        values = self.values.get(event.node)
        if values is None:
            return
        changed = {p.name: _plain(p.value) for p in [*event.new_parameters, *event.changed_parameters]}
        if any(values.get(name, self) != value for name, value in changed.items()):
            values.update(changed)
            self._on_values(self.values, event.node)


def _plain(value: ParameterValue) -> Any:
    plain = parameter_value_to_python(value)
    if plain is None or isinstance(plain, (bool, int, float, str)):
        return plain
    return list(plain)
