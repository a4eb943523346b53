"""A node of this very process, through which tests and measurements see the graph and drive it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

__all__ = ["GraphPeer"]

_T = TypeVar("_T")


class GraphPeer:
    """Joins a domain with a node that is spun by whoever waits for something.

    Args:
        name: Of the node.
        namespace: Of the node.
        domain: ROS domain; by default that of the environment.
        make_executor: Class of the executor.

    Attributes:
        context: Of its own, so that several can be in one process.
        node: The node.
        executor: What spins it.
        patience: Time that is waited for anything [s].
    """

    patience = 30.0

    def __init__(
        self,
        name: str = "peer",
        *,
        namespace: str = "",
        domain: int | None = None,
        make_executor: Callable[..., Executor] = SingleThreadedExecutor,
    ) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.executor = make_executor(context=self.context)
        self._nodes: list[Node] = []
        self.node = self.add_node(name, namespace=namespace)

    def add_node(self, name: str, **options: Any) -> Node:
        """Return one more node, spun with the first."""
        node = rclpy.create_node(name, context=self.context, **options)
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def spin_once(self, timeout: float = 0.02) -> None:
        """Attend to one event, or let some time pass [s]."""
        self.executor.spin_once(timeout_sec=timeout)

    def spin(self, seconds: float) -> None:
        """Attend to whatever comes for some time [s]."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0.0:
            self.spin_once(min(left, 0.02))

    def until(self, predicate: Callable[[], _T], what: str, timeout: float | None = None) -> _T:
        """Attend to whatever comes until a predicate returns something true, and return that.

        Raises:
            TimeoutError: It does not in time; with what was waited for.
        """
        timeout = self.patience if timeout is None else timeout
        deadline = time.monotonic() + timeout
        while not (value := predicate()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {timeout:g} s for {what}{self.known()}")
            self.spin_once()
        return value

    def known(self) -> str:
        """Return what to add to the message about something that did not happen."""
        return ""

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service, once it is there, and return its response."""
        client = self.node.create_client(kind, service)
        try:
            self.until(client.service_is_ready, f"service {service}")
            future = client.call_async(request)
            self.until(future.done, f"the answer of {service}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)
