"""One run of the nodes over DDS: in lockstep as fast as they reply, or in real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.joint_run import JointSettings
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.session import (
    ANSWER_PRIORITY,
    PLANT_PRIORITY,
    START_TIMEOUT,
    Session,
    conduct,
    refuse_existing,
    start_loop,
)
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.runs.run_data import END_EVENT, START_EVENT
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import FaultError

__all__ = ["longest_run", "record_run", "run_lockstep"]

_LAST_WORDS = 0.2
"""Time for the recorder to receive the end of a run in real time [s]."""
_SLOWEST = 60.0
"""Slowest expected pace of a lockstep run, wall time per simulated time: 45 occurred on two cores with ten other
programs."""
_PATIENCE = START_TIMEOUT
"""Time between two checks of the progress of a run in lockstep [s]."""
_ALIVE = 10
"""States that must arrive between two checks; fewer means a run that has stopped."""
_LISTENERS = 3
"""Subscribers of the plant's states: controller, disturbance, recorder. The orchestrator makes one more."""
_RUN_LISTENERS = {"command": 2, "disturbance": 2, "applied": 1}
"""Subscribers of a plant's commands: the plant and the recorder."""


def run_lockstep(
    bag: Path,
    settings: RegulationSettings | JointSettings,
    *,
    side: str = "sim",
    domain: int | None = None,
    on_wait: Callable[[], None] = lambda: None,
    hosts: HostPool | None = None,
) -> Path:
    """Run and record one side of an experiment in lockstep under noise, as :func:`record_run`."""
    return record_run(bag, settings.run(side), domain=domain, on_wait=on_wait, hosts=hosts)


def longest_run(duration: float) -> float:
    """Return the longest time [s] for a run of a duration [s]: starting, discovery, arming, lockstep."""
    return 4.0 * START_TIMEOUT + _SLOWEST * duration


def record_run(
    bag: Path,
    spec: RunSpec,
    *,
    domain: int | None = None,
    on_wait: Callable[[], None] = lambda: None,
    hosts: HostPool | None = None,
) -> Path:
    """Carry out one run over DDS, in lockstep or in real time, and record it into a new bag.

    ``domain`` is None for any free one; ``on_wait`` is called while waiting; ``hosts`` run the programs of lockstep
    runs. A FaultError if a program ended or did not respond, or the plant faulted.
    """
    refuse_existing(bag)
    namespace, simulated = spec.namespace, spec.simulated_time
    with (
        reserve_domain(domain) as reserved,
        conduct(bag.parent / "logs" / bag.name, reserved, on_wait, hosts=hosts if simulated else None) as session,
    ):
        recorder = session.record(bag, namespace, spec.metadata(), spec.storage, simulated=simulated)
        program = spec.plant_program(_LISTENERS + 1)
        answering = (
            spec.controller_program(_RUN_LISTENERS["command"]),
            spec.disturbance_program(_RUN_LISTENERS["disturbance"]),
        )
        for node, priority in (*((each, ANSWER_PRIORITY) for each in answering), (program, PLANT_PRIORITY)):
            start_loop(session.processes, node, priority, simulated=simulated)
        plant = PlantClient(session.orchestrator, namespace, program.node_name, watch=False)
        session.wait_until_all_hear_each_other(
            namespace,
            # Of events the recorder and the orchestrator.
            {
                names.JOINT_STATES: _LISTENERS,
                **{getattr(spec.topics, kind): count for kind, count in _RUN_LISTENERS.items()},
                names.EVENTS: 2,
            },
            clock=simulated,
        )
        session.drives(plant)
        if not simulated:
            _keep_time(session, plant, spec)
            session.close(recorder)
            return bag
        if spec.has_bridge:
            plant.arm(START_TIMEOUT)
        plant.watch()
        if not spec.has_bridge:
            plant.resume(START_TIMEOUT)
        _wait_for_end(session.orchestrator, plant, spec.duration)
        session.close_in_lockstep(recorder, plant, spec.steps + 1, spec.topics)
    return bag


def _keep_time(session: Session, plant: PlantClient, spec: RunSpec) -> None:
    orchestrator = session.orchestrator
    plant.watch()
    if spec.has_bridge:
        plant.arm(START_TIMEOUT)
    else:
        plant.resume(START_TIMEOUT)
    orchestrator.wait_for("states", lambda: plant.sample is not None, START_TIMEOUT)
    assert plant.sample is not None
    plant.mark(START_EVENT)
    end_ns = plant.sample.stamp_ns + round(spec.duration * NANOSECONDS)
    orchestrator.wait_for(
        f"{spec.duration:g} s of real time", lambda: _has_reached(plant, end_ns), START_TIMEOUT + spec.duration
    )
    plant.mark(END_EVENT)
    orchestrator.spin(_LAST_WORDS)
    session.disarm_all()


def _has_reached(plant: PlantClient, end_ns: int) -> bool:
    plant.check_mode()
    return plant.sample is not None and plant.sample.stamp_ns >= end_ns


def _wait_for_end(orchestrator: Orchestrator, plant: PlantClient, duration: float) -> None:
    """Wait for the end of a run in lockstep, as long as it progresses."""
    orchestrator.wait_for("the first state", lambda: plant.is_heard or _is_finished(plant), START_TIMEOUT)
    plant.stop_watching()
    recorder, received = RecorderClient(orchestrator, plant.namespace), 0
    states = f"{plant.namespace}/{names.JOINT_STATES}"
    while not _is_finished(plant):
        ends = time.monotonic() + _PATIENCE
        orchestrator.wait_for(
            f"the end of a run of {duration:g} s of simulated time",
            lambda ends=ends: _is_finished(plant) or time.monotonic() >= ends,  # type: ignore[misc]
            2.0 * _PATIENCE,
        )
        before, received = received, recorder.received(states)
        if received < before + _ALIVE and not _is_finished(plant):
            raise FaultError(
                f"waited {_PATIENCE:g} s for {_ALIVE} more states of a run of {duration:g} s of simulated time, in vain"
            )


def _is_finished(plant: PlantClient) -> bool:
    plant.check_mode()
    return plant.newest_event(Event.LOCKSTEP_FINISHED) is not None
