"""The e-stop of a plant: a participant, node, executor and thread of its own.

The plant's thread steps or waits for an actuator, and reads what others send. A participant has one socket and one
thread that empties it: behind a flood of requests or trajectories an e-stop would wait, or be lost and repeated by DDS.
An error in this thread is an e-stop.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.node import Node, NodeNameNonExistentError
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.programs.realtime import run_ahead, thread_numbers
from pendulum_msgs_py.ros.answers import answer_who_listens
from pendulum_msgs_py.ros.arrivals import ArrivalSignal
from pendulum_msgs_py.ros.leaving import leaving_graph

__all__ = ["PRESSED", "EStopServer", "EStopThread"]

PRESSED = "e-stop pressed"

_JOIN = 2.0
_DISCOVERY = 0.5
"""Longest wait until the owner is discovered here, usually 0.1 s after its start [s]."""
_LOOK = 0.002
_SWITCH = 0.001
"""Switch interval of the GIL [s]; the default is 5 ms."""
_PAUSE = 0.01
"""Pause after an error [s]."""


class EStopThread:
    """A node alongside another one, served by its own thread.

    ``press`` latches the owner's e-stop with a reason; it is called in the thread and must not wait. Create the
    services of ``node``, then :meth:`start`.
    """

    def __init__(self, owner: Node, suffix: str, press: Callable[[str], None]) -> None:
        self._press = press
        self._owner = owner
        self._context = rclpy.Context()
        others = thread_numbers()
        # With the process's arguments, which may name a security enclave.
        rclpy.init(args=sys.argv, context=self._context, domain_id=owner.context.get_domain_id())
        # Without the process's remaps: the owner's names are resolved already.
        self.node = Node(
            f"{owner.get_name()}_{suffix}",
            context=self._context,
            namespace=owner.get_namespace(),
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._middleware = thread_numbers() - others
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=suffix, daemon=True)
        # An owner whose construction failed is not closed, and a spinning thread ends no process cleanly.
        owner.context.on_shutdown(self.close)

    def start(self) -> None:
        """Start to serve."""
        answer_who_listens(self.node)
        sys.setswitchinterval(min(_SWITCH, sys.getswitchinterval()))
        self._thread.start()
        # On a busy machine an ordinary thread may wait for tens of milliseconds.
        run_ahead({*self._middleware, self._thread.native_id or 0})

    def close(self) -> None:
        """Stop to serve, at the latest when the owner's context ends."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._executor.shutdown()
        if self._thread.is_alive():
            self._thread.join(_JOIN)
        # A node that ends at once: its participant is just discovering the owner's entities.
        entities, deadline = self._entities_of_owner(self._owner), time.monotonic() + _DISCOVERY
        while entities and self._entities_of_owner(self.node) != entities and time.monotonic() < deadline:
            time.sleep(_LOOK)
        with leaving_graph():
            self.node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    def _entities_of_owner(self, seen_by: Node) -> list[Any]:
        try:
            owner = (self._owner.get_name(), self._owner.get_namespace())
            return [
                seen_by.get_publisher_names_and_types_by_node(*owner),
                seen_by.get_subscriber_names_and_types_by_node(*owner),
                seen_by.get_service_names_and_types_by_node(*owner),
            ]
        except (NodeNameNonExistentError, implementation.InvalidHandle, implementation.RCLError):
            return []

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._executor.spin()
            except ExternalShutdownException:
                return
            # Also a response that cannot be sent: the e-stop must stay available.
            except Exception as error:  # noqa: BLE001
                self._fail(error)
                self._closing.wait(_PAUSE)
            else:
                return

    def _fail(self, error: Exception) -> None:
        if self._closing.is_set():
            return
        reason = f"e-stop itself failed: {type(error).__name__}: {error}"
        self.node.get_logger().error(reason)
        try:
            self._press(reason)
        except Exception as second:  # noqa: BLE001
            self.node.get_logger().error(f"e-stop could not be latched: {type(second).__name__}: {second}")


class EStopServer:
    """Serves ``~/e_stop`` of a node from its own thread, as :class:`EStopThread`.

    The middleware's thread counts requests in ``arrivals`` without the GIL. The plant reads that counter before each
    decision, and so stops before this thread has run.
    """

    def __init__(self, owner: Node, press: Callable[[str], None]) -> None:
        self._press = press
        self._thread = EStopThread(owner, "e_stop", press)
        service = owner.resolve_service_name(names.E_STOP)
        self.arrivals = ArrivalSignal([self._thread.node.create_service(Trigger, service, self._on_e_stop)])
        self._thread.start()

    def close(self) -> None:
        """Stop to serve."""
        self._thread.close()

    def _on_e_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.arrivals.counted()
        self._press(PRESSED)
        response.success, response.message = True, "e-stop latched: zero torque"
        return response
