"""The e-stop of a plant on a path of its own: a node, an executor and a thread that do nothing else.

A plant's own thread steps or waits for an actuator, and reads whatever others send. The e-stop must not stand in that
queue.
"""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.ros.e_stop_thread import EStopThread

__all__ = ["EStopServer"]


class EStopServer:
    """Serves ``~/e_stop`` of a node from a thread of its own.

    Args:
        owner: The node whose service it is.
        press: Latches the e-stop, with the reason; called in the server's thread, must be quick and wait for nobody.
    """

    def __init__(self, owner: Node, press: Callable[[str], None]) -> None:
        self._press = press
        self._thread = EStopThread(owner, "e_stop", press)
        service = owner.resolve_service_name(names.E_STOP)
        self._thread.node.create_service(Trigger, service, self._on_e_stop)
        self._thread.start()

    def close(self) -> None:
        """Stop to serve."""
        self._thread.close()

    def _on_e_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._press("e-stop pressed")
        response.success, response.message = True, "e-stop latched: zero torque"
        return response
