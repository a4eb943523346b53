"""What the measurements of running loops share: the plants' diagnostics, the environment of a domain, CPU time."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterable

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool

from pendulum_msgs_py import names
from pendulum_msgs_py.ros.middleware import set_middleware_defaults

__all__ = ["PlantListener", "cpu_time", "domain_environment"]

_START_TIMEOUT = 60.0


class PlantListener:
    """Hears the diagnostics of plants, as they come.

    Args:
        domain: ROS domain of the plants.
        *plants: Full names of their nodes.

    Attributes:
        rows: What each plant said, oldest first.
    """

    def __init__(self, domain: int, *plants: str) -> None:
        set_middleware_defaults()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("bench_listener", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_message, 10)
        self.rows: dict[str, list[dict[str, str]]] = {plant: [] for plant in plants}

    def _on_message(self, message: DiagnosticArray) -> None:
        for status in message.status:
            rows = self.rows.get(status.name.partition(":")[0])
            if rows is not None:
                rows.append({pair.key: pair.value for pair in status.values})

    def clear(self) -> None:
        """Forget what was said so far."""
        for rows in self.rows.values():
            rows.clear()

    def listen(self, duration: float) -> None:
        """Listen for some time [s]."""
        deadline = time.monotonic() + duration
        while (left := deadline - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def wait_until(self, holds: Callable[[], bool], what: str) -> None:
        """Listen until something holds.

        Raises:
            TimeoutError: It does not within a minute.
        """
        deadline = time.monotonic() + _START_TIMEOUT
        while not holds():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} did not happen within {_START_TIMEOUT:g} s")
            self.listen(0.1)

    def wait_for_loops(self) -> None:
        """Listen until commands answer the states of every plant."""
        self.wait_until(
            lambda: all(
                rows and math.isfinite(float(rows[-1].get("command_latency_p50_us", "nan")))
                for rows in self.rows.values()
            ),
            f"the loop of {', '.join(self.rows)}",
        )

    def arm(self, plant: str) -> None:
        """Arm a plant; it refuses until its states flow, and asking again is harmless.

        Raises:
            TimeoutError: It stays disarmed.
        """
        client = self._node.create_client(SetBool, f"{plant}/arm")

        def armed() -> bool:
            if not client.service_is_ready():
                return False
            asked = client.call_async(SetBool.Request(data=True))
            self._executor.spin_until_future_complete(asked, 2.0)
            return bool(asked.done() and asked.result().success)

        self.wait_until(armed, f"the arming of {plant}")

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


def domain_environment(domain: int) -> dict[str, str]:
    """Return the variables of programs in a domain of their own."""
    return {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        "PYTHONSAFEPATH": "",
    }


def cpu_time(processes: Iterable[psutil.Process]) -> float:
    """Return the time that processes have been computing, as user and in the kernel [s]; one that ended counts as 0."""
    total = 0.0
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            total += sum(process.cpu_times()[:2])
    return total
