"""Who keeps deadlines in an experiment goes before all else on the machine."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment
from pendulum_bags.experiments.session import ANSWER_PRIORITY, PLANT_PRIORITY, start_loop
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.realtime import may_run_in_real_time
from tests.fixtures import wait_for

pytestmark = pytest.mark.skipif(
    not may_run_in_real_time(PLANT_PRIORITY), reason="this user may have no real-time priority"
)


def _policies(child: Child) -> set[tuple[int, int]]:
    threads = [int(task.name) for task in Path(f"/proc/{child.process.pid}/task").iterdir()]
    return {(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in threads}


def test_plants_go_before_those_who_answer_them_and_both_before_all_else(tmp_path: Path, domain_id: int) -> None:
    others = {
        ANSWER_PRIORITY: (
            graph.controller("/sim"),
            graph.disturbance("/sim"),
            graph.NodeProgram("pendulum_hw_bridge", "procedure", "/hw"),
        ),
        PLANT_PRIORITY: (graph.simulator("/sim"), graph.bridge("/hw", backend="emulator")),
    }
    with ProcessSet(tmp_path, ros_environment(domain_id, tmp_path)) as processes:
        started = [
            (start_loop(processes, program, priority), priority)
            for priority, programs in others.items()
            for program in programs
        ]
        for child, priority in started:
            wait_for(lambda one=child, p=priority: _policies(one) == {(os.SCHED_FIFO, p)}, 60.0, child.name)  # type: ignore[misc]


def test_simulated_time_makes_nobody_wait(tmp_path: Path, domain_id: int) -> None:
    node = replace(graph.disturbance("/sim"), name="simulated")
    with ProcessSet(tmp_path, ros_environment(domain_id, tmp_path)) as processes:
        child = start_loop(processes, node, ANSWER_PRIORITY, simulated=True)
        assert "realtime_priority" not in " ".join(Path(f"/proc/{child.process.pid}/cmdline").read_text().split("\0"))
        wait_for(lambda: "ready" in child.log.read_text(), 60.0, "the node")
        assert _policies(child) == {(os.SCHED_OTHER, 0)}
