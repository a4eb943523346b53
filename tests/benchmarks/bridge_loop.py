"""Measures bridge, on the emulated actuator in its own thread, and controller as two processes over DDS."""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool

from pendulum_bags.experiment.domain import reserve_domain
from pendulum_msgs_py import graph, names
from tests.processes import ProcessGroup

__all__ = ["BridgeLoopFigures", "loop_figures"]

_ROOT = Path(__file__).parents[2]
_TIMEOUT = 60.0
_WARM_UP = 3.0
_NICENESS = -10


@dataclass(frozen=True)
class BridgeLoopFigures:
    """What a run showed.

    Attributes:
        rate: States per second [Hz].
        jitter_p50: Median of a state's distance from its raster [us].
        jitter_p99: 99th percentile [us].
        jitter_max: Largest [us].
        latency_p50: Median of the round trip from state to command [us].
        latency_p99: 99th percentile [us].
        overruns: Share of cycles late by a period or more [%].
        cpu: CPU of bridge and controller [% of a core].
        faults: How often the bridge faulted [-].
    """

    rate: float
    jitter_p50: float
    jitter_p99: float
    jitter_max: float
    latency_p50: float
    latency_p99: float
    overruns: float
    cpu: float
    faults: float


def loop_figures(rate: float, duration: float) -> BridgeLoopFigures:
    """Run bridge and controller in regulation and return their figures.

    Args:
        rate: Feedback records per second [Hz].
        duration: Length of the measurement [s].
    """
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node("bench_listener", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        diagnostics: list[dict[str, str]] = []

        def on_diagnostics(message: DiagnosticArray) -> None:
            diagnostics.extend(
                {pair.key: pair.value for pair in status.values}
                for status in message.status
                if status.name.endswith("bridge: plant")
            )

        node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, on_diagnostics, 10)
        arm = node.create_client(SetBool, "/hw/bridge/arm")

        def listen(seconds: float) -> None:
            deadline = time.monotonic() + seconds
            while (left := deadline - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=left)

        environment = {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        }
        # What a desktop's scheduler may sleep, 25 ms, is many cycles at a high rate.
        watchdog = max(3, math.ceil(0.025 * rate))
        bridge = graph.bridge("/hw", feedback_rate=rate, initial_position=math.pi, feedback_watchdog=watchdog)
        controller = graph.controller("/hw")
        try:
            programs = [
                group.start(p.package, p.executable, *p.ros_arguments(), env=environment)
                for p in (bridge, controller)
            ]
            deadline = time.monotonic() + _TIMEOUT
            while not (
                diagnostics and math.isfinite(float(diagnostics[-1].get("command_latency_p50_us", "nan")))
            ):
                if arm.service_is_ready():
                    # Refused until states flow; asking again is harmless.
                    future = arm.call_async(SetBool.Request(data=True))
                    executor.spin_until_future_complete(future, 2.0)
                listen(0.5)
                if time.monotonic() > deadline:
                    raise TimeoutError(f"the loop did not close within {_TIMEOUT:g} s: {programs[0].output}")
            processes = [psutil.Process(program.pid) for program in programs]
            _give_priority(processes)
            listen(_WARM_UP)
            diagnostics.clear()
            listen(1.0)
            first, wall, busy = diagnostics[-1], time.monotonic(), _cpu(processes)
            diagnostics.clear()
            listen(duration)
            cpu = 100.0 * (_cpu(processes) - busy) / (time.monotonic() - wall)
            last = diagnostics[-1]
            cycles = int(last["cycles"]) - int(first["cycles"])
            return BridgeLoopFigures(
                rate=statistics.mean(float(row["rate_hz"]) for row in diagnostics),
                jitter_p50=_median(diagnostics, "jitter_p50_us"),
                jitter_p99=_median(diagnostics, "jitter_p99_us"),
                jitter_max=max(float(row["jitter_max_us"]) for row in diagnostics),
                latency_p50=_median(diagnostics, "command_latency_p50_us"),
                latency_p99=_median(diagnostics, "command_latency_p99_us"),
                overruns=100.0 * (int(last["overruns"]) - int(first["overruns"])) / max(1, cycles),
                cpu=cpu,
                # From the start: a loop that faulted before would be measured without torque.
                faults=sum(int(value) for key, value in last.items() if key.startswith("faults.")),
            )
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
            group.close()


def _median(rows: list[dict[str, str]], key: str) -> float:
    return statistics.median(float(row[key]) for row in rows)


def _give_priority(processes: list[psutil.Process]) -> None:
    """Let both go before whatever else the machine does, where we may."""
    for process in processes:
        try:
            process.nice(_NICENESS)
        except psutil.AccessDenied:
            return


def _cpu(processes: list[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)
