"""Measures bridge, on the emulated actuator in its own thread, and controller as two processes over DDS."""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_msgs_py.programs import graph
from pendulum_testing.processes import ProcessGroup
from tests.benchmarks.plant_listener import PlantListener, cpu_time, domain_environment
from tests.benchmarks.two_plants import patient_watchdog

__all__ = ["BridgeLoopFigures", "loop_figures"]

_ROOT = Path(__file__).parents[2]
_BRIDGE = "/hw/bridge"
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
        age_p50: Median of the age of a record when its answer is taken [us].
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
    age_p50: float
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
        listener = PlantListener(domain, _BRIDGE)
        said = listener.rows[_BRIDGE]
        watchdog = patient_watchdog(rate)
        bridge = graph.bridge("/hw", feedback_rate=rate, initial_position=math.pi, feedback_watchdog=watchdog)
        controller = graph.controller("/hw")
        try:
            programs = [
                group.start(p.package, p.executable, *p.ros_arguments(), env=domain_environment(domain))
                for p in (bridge, controller)
            ]
            listener.arm(_BRIDGE)
            listener.wait_for_loops()
            processes = [psutil.Process(program.pid) for program in programs]
            _give_priority(processes)
            listener.spin(_WARM_UP)
            said.clear()
            listener.spin(1.0)
            first, wall, busy = said[-1], time.monotonic(), cpu_time(processes)
            said.clear()
            listener.let_run(duration)
            cpu = 100.0 * (cpu_time(processes) - busy) / (time.monotonic() - wall)
            last = said[-1]
            cycles = int(last["cycles"]) - int(first["cycles"])
            return BridgeLoopFigures(
                rate=statistics.mean(float(row["rate_hz"]) for row in said),
                jitter_p50=_median(said, "jitter_p50_us"),
                jitter_p99=_median(said, "jitter_p99_us"),
                jitter_max=max(float(row["jitter_max_us"]) for row in said),
                latency_p50=_median(said, "command_latency_p50_us"),
                latency_p99=_median(said, "command_latency_p99_us"),
                age_p50=_median(said, "answered_age_p50_us"),
                overruns=100.0 * (int(last["overruns"]) - int(first["overruns"])) / max(1, cycles),
                cpu=cpu,
                # From the start: a loop that faulted before would be measured without torque.
                faults=sum(int(value) for key, value in last.items() if key.startswith("faults.")),
            )
        finally:
            listener.close()
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
