"""Service responses that neither wait for an absent client nor end the process.

If the client's half of a service is missing, rmw_fastrtps waits 100 ms before each response while rclpy holds the GIL:
no thread runs, neither an actuator's nor an e-stop's. A client that ended with a thousand unread requests stopped a
plant for 100 s. Exceptions of rclpy's own services, as for a parameter of unknown type, would end the node.
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
"""Time for which a response waits for a client that discovery has not reported yet [s]."""
_LOOK_AGAIN = 0.005
"""Poll period for such clients [s]."""
_MOST_KEPT = 100
"""Most waiting responses of a service."""
_WAITED = 0.09
"""Duration from which on the middleware has waited for a client in vain [s]."""
_FARTHEST = 100
"""Largest distance between numbers of two requests of one client."""


def answer_who_listens(node: Node) -> None:
    """Make each service of a node respond to present clients only; call it once all services exist.

    An exception of rclpy's own services is logged and answered with an empty response; one of a node's own service ends
    it.
    """
    for service in node.services:
        service.send_response = _Answers(node, service).send
        if getattr(service.callback, "__module__", "").startswith("rclpy."):
            service.callback = _answer_or_nothing(node, service, service.callback)


def _answer_or_nothing(node: Node, service: Service, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def guarded(request: Any, response: Any) -> Any:
        try:
            return answer(request, response)
        except Exception as error:  # noqa: BLE001
            node.get_logger().error(
                f"request to {service.srv_name} is answered empty: {type(error).__name__}: {error}",
                throttle_duration_sec=1.0,
            )
            return service.srv_type.Response()

    return guarded


class _Answers:
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
        """Send a response, hold it while no client is known, or drop it if the client has gone."""
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
        began, began_ns = time.monotonic(), time.time_ns()
        gone = self._send(response, header)
        if gone is None:
            gone = time.monotonic() - began > _WAITED
        if gone:
            self._gone, self._gone_ns = header.request_id.sequence_number, began_ns
            self._gone_guid = _guid(header)

    def _follows_gone(self, header: Any) -> bool:
        """Return whether a gone client sent this request after the one that was waited for in vain."""
        if self._gone is None or header.source_timestamp > self._gone_ns or _guid(header) != self._gone_guid:
            return False
        return 0 < header.request_id.sequence_number - self._gone <= _FARTHEST

    def _wait(self) -> None:
        while True:
            time.sleep(_LOOK_AGAIN)
            # The node may have been destroyed.
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
    # Empty for requests taken by rclpy, which hides it.
    return bytes(getattr(header.request_id, "writer_guid", b""))
