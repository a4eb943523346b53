"""The common frame of every run over DDS: its programs, their orchestrator, its recorders, and a safe end."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.plant_specs import REALTIME_PRIORITY
from pendulum_msgs_py.errors import BagError, FaultError
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.programs.realtime import NO_REALTIME, may_run_in_real_time

__all__ = [
    "ANSWER_PRIORITY",
    "LOOP_NICENESS",
    "NO_REALTIME",
    "PLANT_PRIORITY",
    "RECORDER_PRIORITY",
    "START_TIMEOUT",
    "Session",
    "conduct",
    "in_real_time",
    "permitted",
    "refuse_existing",
    "start_loop",
]

START_TIMEOUT = 60.0
"""Longest time for all programs to start; the first start on a machine compiles code [s]."""
PLANT_PRIORITY = 50
"""Real-time priority of a plant, if permitted, as of ros2_control's controller manager."""
ANSWER_PRIORITY = PLANT_PRIORITY - 2
"""Real-time priority of nodes that reply to a plant: below its loop, which is one below its process."""
RECORDER_PRIORITY = ANSWER_PRIORITY - 2
"""Real-time priority of a recorder: below nodes with deadlines; without one it would lose messages."""
LOOP_NICENESS = -10
"""Niceness of nodes with deadlines, if permitted."""


@dataclass
class Session:
    """The programs of one run and their orchestrator; made by :func:`conduct`."""

    processes: ProcessSet
    orchestrator: Orchestrator
    logs: Path
    _driven: list[PlantClient] = field(default_factory=list)

    def record(
        self, bag: Path, namespace: str, metadata: Mapping[str, Any], storage: str, *, simulated: bool = False
    ) -> Child:
        """Start the recorder of one plant in a namespace; ``simulated`` time is the plant's."""
        file = self.logs / f"{bag.name}_metadata.json"
        write_json(file, dict(metadata))
        priority = 0 if simulated else permitted(RECORDER_PRIORITY)
        return start_recorder(self.processes, bag, namespace, file, storage, simulated=simulated, priority=priority)

    def close(self, recorder: Child) -> None:
        """End a recorder now; a FaultError if it could not close its bag."""
        if self.processes.finish(recorder) != 0:
            raise FaultError(recorder.last_words(1))

    def close_in_lockstep(
        self, recorder: Child, plant: PlantClient, states: int, published_each_step: Collection[str] = ()
    ) -> None:
        """Close the bag of a run in lockstep when it is complete; a FaultError if messages were lost.

        ``states`` is the number of published states; ``published_each_step`` are relative names of topics with a
        message per step, one fewer than states: what a publisher sends before it has matched the recorder is lost.
        """
        expected = {f"{plant.namespace}/{names.JOINT_STATES}": states, names.CLOCK: states}
        expected |= {f"{plant.namespace}/{topic}": states - 1 for topic in published_each_step}
        RecorderClient(self.orchestrator, plant.namespace).wait_for_all(expected)
        self.close(recorder)

    def drives(self, *plants: PlantClient) -> None:
        """Disarm these plants at once on any abort of the session, before their programs are ended."""
        self._driven += plants

    def leaves(self, plant: PlantClient) -> None:
        """Leave a plant as it is from now on, also on an abort of the session."""
        self._driven = [one for one in self._driven if one is not plant]

    def disarm_all(self) -> None:
        """Disarm what this session drives; a plant without response goes to rest by its own rules."""
        for plant in self._driven:
            plant.disarm_quietly()

    def wait_until_all_hear_each_other(
        self, namespace: str, listeners: Mapping[str, int], *, clock: bool = True
    ) -> None:
        """Wait until every subscription of a run (``listeners`` by relative topic) is on the graph and recorded."""
        orchestrator, node = self.orchestrator, self.orchestrator.node

        def complete() -> bool:
            return all(
                node.count_subscribers(f"{namespace}/{topic}") >= count
                and node.count_publishers(f"{namespace}/{topic}") >= (1 if count else 0)
                for topic, count in listeners.items()
            )

        orchestrator.wait_for("all nodes to hear each other", complete, START_TIMEOUT)
        recorded = {f"{namespace}/{topic}" for topic, count in listeners.items() if count}
        recorded |= {names.CLOCK} if clock else set()
        RecorderClient(orchestrator, namespace).wait_until_heard(recorded, START_TIMEOUT)
        # The two ends of a match complete it a moment apart.
        orchestrator.spin(0.5)


@contextmanager
def conduct(
    logs: Path, domain: int, on_wait: Callable[[], None] = lambda: None, *, hosts: HostPool | None = None
) -> Iterator[Session]:
    """Join the graph for one run, whose phases are the caller's; leaving it ends all programs, recorders last.

    An abort disarms at once what the session drives. ``on_wait`` is called while waiting; a FaultError out of any wait
    if a program ended by itself.
    """
    with (
        ProcessSet(logs, ros_environment(domain, logs), hosts) as processes,
        Orchestrator(domain, watch=processes.check, on_wait=on_wait) as orchestrator,
    ):
        session = Session(processes, orchestrator, logs)
        try:
            yield session
        except BaseException:
            session.disarm_all()
            raise


def start_loop(processes: ProcessSet, program: NodeProgram, priority: int, *, simulated: bool = False) -> Child:
    """Start a node with deadlines, at real-time priority if permitted and time is not ``simulated``."""
    if simulated:
        return processes.start_node(program)
    return processes.start_node(in_real_time(program, priority), niceness=LOOP_NICENESS)


def in_real_time(program: NodeProgram, priority: int) -> NodeProgram:
    """Return a node with its real-time priority, at most a plant's, or unchanged if that is not permitted."""
    if not permitted(priority):
        return program
    return replace(program, parameters={**program.parameters, REALTIME_PRIORITY.name: priority})


def permitted(priority: int) -> int:
    """Return a real-time priority, at most a plant's, or 0 if a plant's is not permitted: nothing may preempt it.

    Also 0 if ``PENDULUM_NO_REALTIME`` is set: several experiments on one computer would block each other.
    """
    if os.environ.get(NO_REALTIME):
        return 0
    return priority if may_run_in_real_time(PLANT_PRIORITY) else 0


def refuse_existing(bag: Path) -> None:
    """Raise a BagError if a bag exists already."""
    if bag.exists():
        raise BagError(f"bag {bag} exists; expected a new folder")
