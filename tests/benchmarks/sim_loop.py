"""Measures plant and controller as two processes over DDS: round trips, missed deadlines, CPU and memory."""

from __future__ import annotations

import math
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from tests.benchmarks.plant_listener import PlantListener, cpu_time, domain_environment
from tests.processes import ProcessGroup, RunningProgram

__all__ = ["LoopFigures", "lockstep_speed", "peer_cpu", "realtime_figures"]

_ROOT = Path(__file__).parents[2]
_WARM_UP = 6.0
_DIAGNOSTICS_PERIOD = 0.5
_SIMULATOR = "/sim/simulator"


@dataclass(frozen=True)
class LoopFigures:
    """What a realtime run showed.

    Attributes:
        p50: Median of the round trip from state to command [us].
        p99: 99th percentile [us].
        missed: Share of deadlines missed by a period or more [%].
        cpu: CPU of simulator and controller together [% of a core].
        memory: Largest resident memory of the simulator [MB].
        growth: Growth of it during the run [MB].
    """

    p50: float
    p99: float
    missed: float
    cpu: float
    memory: float
    growth: float


def realtime_figures(duration: float, *, rate: float = 1000.0, cores: Sequence[int] | None = None) -> LoopFigures:
    """Run simulator and controller in real time and return what they cost.

    Args:
        duration: Length of the measurement [s].
        rate: States per second [Hz].
        cores: Cores that both are pinned to; None leaves them to the scheduler.
    """
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        listener = PlantListener(domain, _SIMULATOR)
        said = listener.rows[_SIMULATOR]
        try:
            programs = [
                _start(group, domain, graph.simulator("/sim", rate_hz=rate, initial_theta=math.pi - 0.1)),
                _start(group, domain, graph.controller("/sim")),
            ]
            listener.wait_for_loops()
            processes = [psutil.Process(program.pid) for program in programs]
            for process in processes:
                if cores is not None:
                    _pin(process, cores)
            listener.spin(_WARM_UP)
            memory = processes[0].memory_info().rss
            said.clear()
            busy, wall = cpu_time(processes), time.monotonic()
            listener.spin(duration)
            elapsed = time.monotonic() - wall
            cpu = 100.0 * (cpu_time(processes) - busy) / elapsed
            after = said[-1]
            expected = (len(said) - 1) * _DIAGNOSTICS_PERIOD * rate
            cycles = int(after["cycles"]) - int(said[0]["cycles"])
            # Periods that a late timer stepped through in one go are no cycles of their own.
            missed = max(expected - cycles, int(after["overruns"]) - int(said[0]["overruns"]))
            return LoopFigures(
                p50=statistics.median(float(row["command_latency_p50_us"]) for row in said),
                p99=statistics.median(float(row["command_latency_p99_us"]) for row in said),
                missed=100.0 * max(0.0, missed) / expected,
                cpu=cpu,
                memory=processes[0].memory_info().rss / 1e6,
                growth=(processes[0].memory_info().rss - memory) / 1e6,
            )
        finally:
            listener.close()
            group.close()


def peer_cpu(module: str, duration: float, *, rate: float = 1000.0) -> float:
    """Return the CPU of a loop to compare with, plant and controller together [% of a core].

    Args:
        module: ``tests.benchmarks`` module that runs either, by a first argument of ``plant`` or ``controller``.
        duration: Length of the measurement [s].
        rate: States per second [Hz].
    """
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        try:
            programs = [
                group.start(f"tests.benchmarks.{module}", role, str(rate), env=domain_environment(domain))
                for role in ("plant", "controller")
            ]
            time.sleep(_WARM_UP)
            processes = [psutil.Process(program.pid) for program in programs]
            busy, wall = cpu_time(processes), time.monotonic()
            time.sleep(duration)
            return 100.0 * (cpu_time(processes) - busy) / (time.monotonic() - wall)
        finally:
            group.close()


def lockstep_speed(duration: float, *, rate: float = 500.0) -> float:
    """Return simulated time per wall time of a lockstep run with controller and disturbance as processes [-].

    Args:
        duration: Simulated time [s].
        rate: States per second [Hz].
    """
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        listener = PlantListener(domain, _SIMULATOR)
        said = listener.rows[_SIMULATOR]
        try:
            _start(group, domain, graph.controller("/sim", use_sim_time=True))
            _start(group, domain, graph.disturbance("/sim", autostart=True, duration=duration, use_sim_time=True))
            plant = graph.simulator(
                "/sim",
                clock="lockstep",
                rate_hz=rate,
                initial_theta=math.pi,
                lockstep_inputs=["effort_command", "disturbance"],
                lockstep_subscribers=2,
            )
            _start(group, domain, plant)
            listener.until(
                lambda: bool(said) and int(said[-1].get("lockstep_steps", 0)) > 200, "the start of the lockstep run"
            )
            said.clear()
            listener.spin(1.0)
            first, start = int(said[-1]["lockstep_steps"]), time.monotonic()
            end = start + duration / 3.0
            while time.monotonic() < end:
                listener.spin(0.5)
            count = len(said)
            while len(said) == count:
                listener.spin(0.01)
            steps = int(said[-1]["lockstep_steps"]) - first
            return steps / rate / (time.monotonic() - start)
        finally:
            listener.close()
            group.close()


def _start(group: ProcessGroup, domain: int, program: NodeProgram) -> RunningProgram:
    return group.start(program.package, program.executable, *program.ros_arguments(), env=domain_environment(domain))


def _pin(process: psutil.Process, cores: Sequence[int]) -> None:
    """Pin all threads of a process; its own affinity is only that of the first."""
    for thread in process.threads():
        os.sched_setaffinity(thread.id, cores)
