"""Answers of services that neither wait for a client that has gone nor end the process that serves it.

Where the client's half of a service is not there, rmw_fastrtps waits 100 ms for it before each answer, and rclpy holds
Python's lock all the while: no thread of the process runs, neither an actuator's nor an e-stop's. A client that ended
with a thousand requests unread stopped a plant for 100 s. What rclpy's own services do not understand, such as a
parameter of no known type, leaves their callbacks as an exception, and would end the node of a plant with its e-stop.
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service

from pendulum_msgs_py.ros.requests import send_response

__all__ = ["answer_who_listens"]

_PATIENCE = 1.0
"""Time for which an answer is kept for a client that discovery has not told of yet [s]."""
_LOOK_AGAIN = 0.005
"""Time between two looks for such clients [s]."""
_MOST_KEPT = 100
"""Answers kept for clients at once, for each service."""
_WAITED = 0.09
"""Time from which on the middleware has waited for a client in vain [s]."""
_FARTHEST = 100
"""Largest distance of the numbers of two requests that are taken for one client's."""


def answer_who_listens(node: Node) -> None:
    """Let each service of a node send its answers to clients that are there; call it once all services are made.

    An exception of a service that rclpy makes itself is logged and answered with nothing; one of a node's own service
    is a fault, and ends it as any other.
    """
    for service in node.services:
        service.send_response = _Answers(node, service).send
        if getattr(service.callback, "__module__", "").startswith("rclpy."):
            service.callback = _answer_or_nothing(node, service, service.callback)


def _answer_or_nothing(node: Node, service: Service, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def guarded(request: Any, response: Any) -> Any:
        try:
            return answer(request, response)
        # Of any kind: rclpy converts what it was sent before it looks at it.
        except Exception as error:  # noqa: BLE001
            node.get_logger().error(
                f"request to {service.srv_name} is answered empty: {type(error).__name__}: {error}",
                throttle_duration_sec=1.0,
            )
            return service.srv_type.Response()

    return guarded


class _Answers:
    """What a service sends.

    Args:
        node: Its node.
        service: The service.
    """

    def __init__(self, node: Node, service: Service) -> None:
        self._name = name = service.handle.name
        self._count: Callable[[], int] = lambda: node.count_clients(name)
        self._send: Callable[[Any, Any], bool | None] = functools.partial(send_response, service, service.send_response)
        self._kept: deque[tuple[float, Any, Any]] = deque()
        self._lock = threading.Lock()
        self._gone: int | None = None
        self._gone_ns = 0
        self._gone_guid = b""

    def send(self, response: Any, header: Any) -> None:
        """Send an answer, keep it for a while where no client is known yet, or drop it where the client has gone."""
        if self._count():
            self._send_now(response, header)
            return
        with self._lock:
            if len(self._kept) >= _MOST_KEPT:
                return
            self._kept.append((time.monotonic() + _PATIENCE, response, header))
            if len(self._kept) == 1:
                threading.Thread(target=self._wait, name=f"answers of {self._name}", daemon=True).start()

    def _send_now(self, response: Any, header: Any) -> None:
        if self._follows_gone(header):
            self._gone = header.request_id.sequence_number
            return
        # A client that has gone asked before that; who asks later has been answered, by a thread that was kept waiting.
        began, began_ns = time.monotonic(), time.time_ns()
        gone = self._send(response, header)
        if gone is None:
            gone = time.monotonic() - began > _WAITED
        if gone:
            self._gone, self._gone_ns = header.request_id.sequence_number, began_ns
            self._gone_guid = _guid(header)

    def _follows_gone(self, header: Any) -> bool:
        """Tell whether a request is the next of a client that has just been waited for in vain."""
        if self._gone is None or header.source_timestamp > self._gone_ns or _guid(header) != self._gone_guid:
            return False
        return 0 < header.request_id.sequence_number - self._gone <= _FARTHEST

    def _wait(self) -> None:
        while True:
            time.sleep(_LOOK_AGAIN)
            # A node that is destroyed has nobody to answer any more.
            with contextlib.suppress(rclpy_implementation.InvalidHandle):
                there = self._count() > 0
                while there and self._kept:
                    self._send_now(*self._kept[0][1:])
                    with self._lock:
                        self._kept.popleft()
            with self._lock:
                while self._kept and self._kept[0][0] < time.monotonic():
                    self._kept.popleft()
                if not self._kept:
                    return


def _guid(header: Any) -> bytes:
    """Return who asked; empty where rclpy took the request, which does not tell."""
    return bytes(getattr(header.request_id, "writer_guid", b""))
