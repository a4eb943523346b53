"""What the measurements of running loops share: the plants' diagnostics, the environment of a domain, CPU time."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Iterable

import psutil
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.ros.convert import stamp_from_message
from pendulum_msgs_py.ros.middleware import set_middleware_defaults
from pendulum_testing.graph_peer import GraphPeer

__all__ = ["PlantListener", "cpu_time", "domain_environment", "missed_share"]


_MOST_UNREAD = 2000
"""Diagnostics that a listener who is not listening keeps: those of a dozen programs for a minute, and more."""


class PlantListener(GraphPeer):
    """Hears the diagnostics of plants, as they come.

    Args:
        domain: ROS domain of the plants.
        *plants: Full names of their nodes.

    Attributes:
        rows: What each plant said, oldest first, with its ``stamp_ns``.
    """

    patience = 60.0

    def __init__(self, domain: int, *plants: str) -> None:
        set_middleware_defaults()
        super().__init__("bench_listener", domain=domain)
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_message, _MOST_UNREAD)
        self.rows: dict[str, list[dict[str, str]]] = {plant: [] for plant in plants}

    def _on_message(self, message: DiagnosticArray) -> None:
        for status in message.status:
            rows = self.rows.get(status.name.partition(":")[0])
            if rows is not None:
                stamp = {"stamp_ns": str(stamp_from_message(message.header.stamp))}
                rows.append(stamp | {pair.key: pair.value for pair in status.values})

    def let_run(self, duration: float) -> None:
        """Let the plants run for a time [s], and hear afterwards what they said meanwhile.

        Who listens takes a core from those whom it measures, for milliseconds at each message.
        """
        time.sleep(duration)
        heard = -1
        while heard != (heard := sum(map(len, self.rows.values()))):
            self.spin(0.05)

    def clear(self) -> None:
        """Forget what was said so far."""
        for rows in self.rows.values():
            rows.clear()

    def wait_for_loops(self) -> None:
        """Listen until commands answer the states of every plant."""
        self.until(
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
        self.until(
            lambda: self.call(SetBool, f"{plant}/arm", SetBool.Request(data=True)).success, f"the arming of {plant}"
        )


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


def missed_share(first: dict[str, str], last: dict[str, str], rate: float) -> float:
    """Return the share of a plant's periods that it missed between two rows, by its own stamps [%].

    A pause is one overrun, however long, and what a late plant steps through at once are no cycles of their own; so the
    larger of both counts.

    Args:
        first: What it said first.
        last: What it said last.
        rate: Periods per second [Hz].
    """
    past = {key: int(last[key]) - int(first[key]) for key in ("stamp_ns", "cycles", "overruns")}
    periods = past["stamp_ns"] / NANOSECONDS * rate
    # The row is written within a period of its stamp.
    missed = max(past["overruns"], periods - past["cycles"] - 1.0)
    return 100.0 * missed / periods
