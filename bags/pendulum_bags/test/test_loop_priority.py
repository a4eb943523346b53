"""Who keeps deadlines in an experiment goes before all else on the machine."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from pendulum_bags.experiments import session
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment
from pendulum_bags.experiments.session import (
    ANSWER_PRIORITY,
    NO_REALTIME,
    PLANT_PRIORITY,
    RECORDER_PRIORITY,
    Session,
    in_real_time,
    start_loop,
)
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.realtime import may_run_in_real_time
from pendulum_testing.fixtures import wait_for
from pendulum_testing.udp_address import free_udp_address

_allowed = pytest.mark.skipif(
    not may_run_in_real_time(PLANT_PRIORITY), reason="this user may have no real-time priority"
)

_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23


@pytest.fixture(autouse=True)
def nothing_forbidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let experiments take the priority, though the tests run beside others that keep time."""
    monkeypatch.delenv(NO_REALTIME, raising=False)


def _policies(child: Child) -> set[tuple[int, int]]:
    threads = [int(task.name) for task in Path(f"/proc/{child.process.pid}/task").iterdir()]
    return {(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in threads}


def _real_time(priority: int) -> set[tuple[int, int]]:
    return {(os.SCHED_FIFO, priority), (os.SCHED_FIFO, priority - 1)}


@_allowed
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
            wait_for(lambda one=child, p=priority: _policies(one) == _real_time(p), 60.0, child.name)  # type: ignore[misc]


@_allowed
def test_a_bridge_and_an_emulated_module_that_somebody_starts_go_before_all_else_unless_that_is_forbidden(
    tmp_path: Path, domain_id: int
) -> None:
    ordinary = {(os.SCHED_OTHER, 0)}
    module = [sys.executable, "-m", "pendulum_hw_bridge", "emulator", "--address", free_udp_address()]
    lockstep = {"clock": "lockstep", "lockstep_inputs": ["effort_command"]}
    with ProcessSet(tmp_path, ros_environment(domain_id, tmp_path)) as processes:
        for name, forbidden in (("may", {}), ("not", {NO_REALTIME: "1"})):
            child = processes.start(f"module_{name}", module, environment=forbidden)
            wait_for(lambda one=child: "listens" in one.log.read_text(), 60.0, child.name)  # type: ignore[misc]
            assert _policies(child) == (ordinary if forbidden else {(os.SCHED_FIFO, PLANT_PRIORITY)})
            processes.finish(child)
            # Forbidden is forbidden, in whatever time.
            for clock, parameters in (("realtime", {}), ("lockstep", lockstep))[: 1 if forbidden else 2]:
                command = graph.bridge(f"/{name}_{clock}", backend="emulator", **parameters).command()  # type: ignore[arg-type]
                child = processes.start(f"bridge_{name}_{clock}", command, environment=forbidden)
                wait_for(lambda one=child: "ready" in one.log.read_text(), 60.0, child.name)  # type: ignore[misc]
                policies = _policies(child)
                # In lockstep the e-stop's threads alone.
                behind = ordinary if clock == "lockstep" else {(os.SCHED_FIFO, PLANT_PRIORITY - 1)}
                assert policies == (ordinary if forbidden else {(os.SCHED_FIFO, PLANT_PRIORITY), *behind})


@_allowed
def test_a_recorder_goes_behind_them_and_before_all_else(tmp_path: Path, domain_id: int) -> None:
    with ProcessSet(tmp_path, ros_environment(domain_id, tmp_path)) as processes:
        run = Session(processes, MagicMock(), tmp_path)
        for simulated, expected in ((False, _real_time(RECORDER_PRIORITY)), (True, {(os.SCHED_OTHER, 0)})):
            child = run.record(tmp_path / f"bag_{simulated}", "/sim", {}, "mcap", simulated=simulated)
            wait_for(lambda one=child: "ready" in one.log.read_text(), 60.0, child.name)  # type: ignore[misc]
            assert _policies(child) == expected


def test_all_threads_of_one_group_go_before_all_of_the_next() -> None:
    assert PLANT_PRIORITY - 1 > ANSWER_PRIORITY > ANSWER_PRIORITY - 1 > RECORDER_PRIORITY > 1


@_allowed
def test_simulated_time_makes_nobody_wait(tmp_path: Path, domain_id: int) -> None:
    node = replace(graph.disturbance("/sim"), name="simulated")
    with ProcessSet(tmp_path, ros_environment(domain_id, tmp_path)) as processes:
        child = start_loop(processes, node, ANSWER_PRIORITY, simulated=True)
        assert "realtime_priority" not in " ".join(Path(f"/proc/{child.process.pid}/cmdline").read_text().split("\0"))
        wait_for(lambda: "ready" in child.log.read_text(), 60.0, "the node")
        assert _policies(child) == {(os.SCHED_OTHER, 0)}


def test_who_shares_the_computer_can_do_without(monkeypatch: pytest.MonkeyPatch) -> None:
    program = graph.controller("/sim", period=0.01)
    assert "realtime_priority" in in_real_time(program, PLANT_PRIORITY).parameters
    monkeypatch.setenv(NO_REALTIME, "1")
    assert in_real_time(program, PLANT_PRIORITY) == program


@pytest.mark.parametrize(("limit", "allowed"), [(0, False), (PLANT_PRIORITY - 1, False), (PLANT_PRIORITY, True)])
def test_who_answers_does_not_go_before_a_plant_that_may_not(
    monkeypatch: pytest.MonkeyPatch, limit: int, allowed: bool
) -> None:
    monkeypatch.setattr(session, "may_run_in_real_time", lambda priority: priority <= limit)
    for priority in (ANSWER_PRIORITY, PLANT_PRIORITY):
        parameters = in_real_time(graph.controller("/sim", period=0.01), priority).parameters
        assert parameters == {"period": 0.01, **({"realtime_priority": priority} if allowed else {})}


def test_a_program_that_may_not_have_what_it_was_given_was_never_ready(tmp_path: Path, domain_id: int) -> None:
    def forbid() -> None:
        ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))

    command = graph.disturbance("/sim", realtime_priority=7).command()
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60.0, check=False, preexec_fn=forbid,
        env={**os.environ, **ros_environment(domain_id, tmp_path)},
    )  # fmt: skip
    assert done.returncode == 2
    assert "error: realtime_priority is 7; this user may have at most 0" in done.stderr
    assert "ready" not in done.stdout + done.stderr
