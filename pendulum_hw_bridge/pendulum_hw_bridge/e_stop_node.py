"""The e-stop on a path of its own: a node, an executor and a thread that do nothing else.

The bridge's own thread waits for the actuator while it arms, and reads whatever others send. The e-stop must not stand
in that queue.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names

__all__ = ["EStopServer"]

_JOIN = 2.0


class EStopServer:
    """Serves ``~/e_stop`` of a node from a thread of its own.

    Args:
        owner: The node whose service it is.
        press: Latches the e-stop; called in the server's thread, must be quick and wait for nobody.
    """

    def __init__(self, owner: Node, press: Callable[[], None]) -> None:
        self._press = press
        # Without the process's remaps: they were for the owner, whose names are resolved here already.
        self._node = Node(
            f"{owner.get_name()}_e_stop",
            context=owner.context,
            namespace=owner.get_namespace(),
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._node.create_service(Trigger, owner.resolve_service_name(names.E_STOP), self._on_e_stop)
        self._executor = SingleThreadedExecutor(context=owner.context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="e_stop", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop to serve."""
        self._executor.shutdown()
        self._thread.join(_JOIN)
        self._node.destroy_node()

    def _on_e_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._press()
        response.success, response.message = True, "e-stop latched: zero torque"
        return response

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return
