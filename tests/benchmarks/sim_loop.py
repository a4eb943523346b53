"""Measures plant and controller as two processes over DDS: round trips, missed deadlines, CPU and memory."""

from __future__ import annotations

import json
import math
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.benchmarks.limit_loop import build_limit
from tests.benchmarks.plant_listener import PlantListener, cpu_time, domain_environment, missed_share

__all__ = [
    "LimitFigures",
    "LoopFigures",
    "limit_figures",
    "limit_lockstep_speed",
    "lockstep_speed",
    "peer_cpu",
    "realtime_figures",
]

_ROOT = Path(__file__).parents[2]
_WARM_UP = 6.0
_SIMULATOR = "/sim/simulator"
_WINDOW = 4096
"""Round trips that the simulator's percentiles are of; the limit's are of as many."""


@dataclass(frozen=True)
class LoopFigures:
    """What a realtime run showed.

    Attributes:
        p50: Median of the round trip from state to command [us].
        p99: 99th percentile [us].
        missed: Share of deadlines missed by a period or more [%].
        unanswered: Share of periods without an answer [%].
        cpu: CPU of simulator and controller together [% of a core].
        memory: Largest resident memory of the simulator [MB].
        growth: Growth of it during the run [MB].
    """

    p50: float
    p99: float
    missed: float
    unanswered: float
    cpu: float
    memory: float
    growth: float


@dataclass(frozen=True)
class LimitFigures:
    """What the same loop in C showed.

    Attributes:
        p50: Median of the round trip from state to answer [us].
        p99: 99th percentile [us].
        missed: Share of deadlines missed by a period or more [%].
        unanswered: Share of states without an answer within nine tenths of a period [%].
        cpu: CPU of both processes together [% of a core].
    """

    p50: float
    p99: float
    missed: float
    unanswered: float
    cpu: float


def limit_figures(duration: float, *, rate: float = 1000.0, cores: Sequence[int] | None = None) -> LimitFigures:
    """Run a plant and a controller in C on ``rcl`` and return what they cost.

    Args:
        duration: Length of the measurement [s].
        rate: States per second [Hz].
        cores: Cores that both are pinned to; None leaves them to the scheduler.

    Raises:
        FileNotFoundError: They cannot be compiled here.
        RuntimeError: None of the states of some seconds was answered.
    """
    states = round((duration + _WARM_UP) * rate)
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        try:
            programs = _start_limit(group, domain, build_limit(Path(folder)), rate, states, 1)
            time.sleep(_WARM_UP)
            processes = [psutil.Process(program.pid) for program in programs]
            if cores is not None:
                for process in processes:
                    _pin(process, cores)
            busy, wall = cpu_time(processes), time.monotonic()
            # Less than the plant has left, which began a little later.
            time.sleep(duration - 2.0)
            cpu = 100.0 * (cpu_time(processes) - busy) / (time.monotonic() - wall)
            told = _told_by_limit(programs[0])
            trips = np.array(told["round_trips_ns"][round(_WARM_UP * rate) :]) / 1e3
            windows = [window[window > 0.0] for window in np.array_split(trips, max(1, len(trips) // _WINDOW))]
            if not all(window.size for window in windows):
                raise RuntimeError("the machine was so busy that no state was answered for seconds")
            return LimitFigures(
                p50=statistics.median(float(np.percentile(window, 50)) for window in windows),
                p99=statistics.median(float(np.percentile(window, 99)) for window in windows),
                missed=100.0 * told["missed"] / states,
                unanswered=100.0 * float((trips == 0.0).mean()),
                cpu=cpu,
            )
        finally:
            group.close()


def limit_lockstep_speed(states: int = 20_000, *, rate: float = 500.0) -> float:
    """Return simulated time per wall time of a plant and two answerers in C, in lockstep [-].

    Args:
        states: How many states to publish.
        rate: States per simulated second [Hz].

    Raises:
        FileNotFoundError: They cannot be compiled here.
    """
    with tempfile.TemporaryDirectory() as folder, reserve_domain(None) as domain:
        group = ProcessGroup(Path(folder), _ROOT)
        try:
            programs = _start_limit(group, domain, build_limit(Path(folder)), 0.0, states, 2)
            trips = np.array(_told_by_limit(programs[0])["round_trips_ns"][states // 10 :]) / 1e9
            return float((trips > 0.0).sum() / rate / trips.sum())
        finally:
            group.close()


def _start_limit(
    group: ProcessGroup, domain: int, library: Path, rate: float, states: int, answerers: int
) -> list[RunningProgram]:
    """Start plant and answerers; return them once the plant is about to run, the plant first."""
    roles = [("plant", str(rate), str(states), str(answerers))]
    roles += [("answerer", str(index), "", "") for index in range(answerers)]
    module, environment = "tests.benchmarks.limit_loop", domain_environment(domain)
    programs = [group.start(module, str(library), *role, env=environment) for role in roles]
    programs[0].wait_for_output("running", 30.0)
    return programs


def _told_by_limit(plant: RunningProgram) -> dict[str, Any]:
    found = plant.wait_for_output(r"^\{.*\}$", 120.0)
    told: dict[str, Any] = json.loads(found.group(0))
    return told


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
                _start(
                    group,
                    domain,
                    graph.simulator("/sim", rate_hz=rate, initial_theta=math.pi - 0.1, start_effort_limit=0.0),
                ),
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
            listener.let_run(duration)
            cpu = 100.0 * (cpu_time(processes) - busy) / (time.monotonic() - wall)
            return LoopFigures(
                p50=statistics.median(float(row["command_latency_p50_us"]) for row in said),
                p99=statistics.median(float(row["command_latency_p99_us"]) for row in said),
                missed=missed_share(said[0], said[-1], rate),
                unanswered=_unanswered(said[0], said[-1]),
                cpu=cpu,
                memory=processes[0].memory_info().rss / 1e6,
                growth=(processes[0].memory_info().rss - memory) / 1e6,
            )
        finally:
            listener.close()
            group.close()


def _unanswered(first: dict[str, str], last: dict[str, str]) -> float:
    answered, cycles = (int(last[key]) - int(first[key]) for key in ("effort_command.accepted", "cycles"))
    return 100.0 * max(0.0, 1.0 - answered / cycles)


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
