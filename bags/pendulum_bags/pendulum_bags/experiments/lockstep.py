"""One run of the nodes over DDS: in step with each other as fast as they answer, or in step with the wall."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from pendulum_bags.experiments.conductor_node import Conductor, PlantClient, RecorderClient
from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.runs.run_data import END_EVENT, START_EVENT
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import BagError, FaultError
from pendulum_msgs_py.programs.graph import NodeProgram

__all__ = [
    "GraphRun", "finish_recording", "lockstep_spec", "longest_run", "record_run", "run_lockstep",
    "wait_until_all_hear_each_other",
]  # fmt: skip

_START_TIMEOUT = 60.0
_LOOP_NICENESS = -10
_LAST_WORDS = 0.2
"""Time in which the recorder hears the end of a run in real time [s]."""
_SLOWEST = 60.0
"""Slowest pace at which a lockstep run is expected to end, wall time per simulated time: 45 were seen on two cores that
ten other programs wanted."""
_ALIVE = 10
"""States that must come within ``_START_TIMEOUT``; less is no slow run but one that stands still."""
_LISTENERS = 3
"""Those who hear the plant's states: controller, disturbance, recorder. The conductor makes one more."""
_RUN_LISTENERS = {
    names.JOINT_STATES: _LISTENERS,
    names.EFFORT_COMMAND: 2,
    names.DISTURBANCE: 2,
    names.APPLIED_EFFORT: 1,
    names.EVENTS: 2,
}
"""How many listen to each topic of a run: its reader, the recorder, and to events the conductor."""


def run_lockstep(
    bag: Path,
    settings: RegulationSettings,
    *,
    side: str = "sim",
    theta: float = UPRIGHT,
    domain: int | None = None,
    on_wait: Callable[[], None] = lambda: None,
) -> Path:
    """Run one plant of the thesis's experiment under control and noise, as fast as the loop allows, and record it.

    Args:
        bag: Folder of the bag.
        settings: What to run.
        side: ``sim`` for the simulator, ``hw`` for the emulated hardware.
        theta: Initial angle [rad].
        domain: ROS domain, or None for any free one.
        on_wait: Called while waiting.

    Raises:
        BagError: The bag exists.
        FaultError: A program ended or did not answer.
    """
    spec = lockstep_spec(settings, side=side, theta=theta)
    return record_run(bag, spec, domain=domain, on_wait=on_wait)


def lockstep_spec(settings: RegulationSettings, *, side: str, theta: float = UPRIGHT) -> RunSpec:
    """Return one side of the thesis's experiment as a run in lockstep, for as long as the noise lasts."""
    noise, foreign = settings.noise, settings.foreign_of(side)
    return RunSpec(
        side=side,
        plant=settings.plant if side == "sim" else "thesis",
        design_plant=settings.plant,
        strategy=settings.strategy,
        controller=settings.kind,
        controller_parameters=settings.tuning,
        disturbance={
            "kind": "uniform",
            "amplitude": noise.amplitude,
            "hold_time": noise.hold_time,
            "duration": noise.duration,
        },
        theta=theta,
        duration=noise.duration,
        seed=noise.seed,
        method=settings.method,
        storage=settings.storage,
        simulation="" if foreign is None else foreign.name,
        mapping="" if foreign is None else foreign.mapping,
    )


def longest_run(duration: float) -> float:
    """Return the longest time [s] that a run of a duration [s] may take: starting, discovery, arming, lockstep."""
    return 4.0 * _START_TIMEOUT + _SLOWEST * duration


class GraphRun(Protocol):
    """What a run over DDS has to say of itself; a :class:`RunSpec` does."""

    @property
    def namespace(self) -> str:
        """Namespace of the plant."""

    @property
    def storage(self) -> str:
        """Storage of the bag."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    @property
    def steps(self) -> int:
        """Number of steps of the plant."""

    @property
    def simulated_time(self) -> bool:
        """Whether time is that of the plant and not that of the wall."""

    @property
    def has_bridge(self) -> bool:
        """Whether the plant is the bridge, which no parameter arms."""

    def metadata(self) -> dict[str, Any]:
        """Return what the bag says about its run."""

    def plant_program(self, listeners: int) -> NodeProgram:
        """Return the plant, which waits for so many subscriptions to its states."""

    def controller_program(self) -> NodeProgram:
        """Return the controller."""

    def disturbance_program(self) -> NodeProgram:
        """Return the disturbance."""


def record_run(
    bag: Path, spec: GraphRun, *, domain: int | None = None, on_wait: Callable[[], None] = lambda: None
) -> Path:
    """Carry out one run over DDS, in lockstep or in real time as it says, and record it.

    Args:
        bag: Folder of the bag.
        spec: What to run.
        domain: ROS domain, or None for any free one.
        on_wait: Called while waiting.

    Raises:
        BagError: The bag exists.
        FaultError: A program ended or did not answer, or the plant faulted.
    """
    if bag.exists():
        raise BagError(f"bag {bag} exists; expected a new folder")
    namespace = spec.namespace
    logs = bag.parent / "logs" / bag.name
    with (
        reserve_domain(domain) as reserved,
        ProcessSet(logs, ros_environment(reserved, logs)) as processes,
        Conductor(reserved, watch=processes.check, on_wait=on_wait) as conductor,
    ):
        metadata = logs / "metadata.json"
        write_json(metadata, spec.metadata())
        simulated = spec.simulated_time
        log_time = "header" if simulated else "receive"
        recorder = start_recorder(processes, bag, namespace, metadata, spec.storage, log_time=log_time)
        program = spec.plant_program(_LISTENERS + 1)
        niceness = 0 if simulated else _LOOP_NICENESS
        processes.start_node(spec.controller_program(), niceness=niceness)
        processes.start_node(spec.disturbance_program(), niceness=niceness)
        processes.start_node(program, niceness=niceness)
        client = PlantClient(conductor, namespace, program.node_name, watch=False)
        wait_until_all_hear_each_other(conductor, namespace, _RUN_LISTENERS, clock=simulated)
        if not simulated:
            _keep_time(conductor, client, spec, processes, recorder)
            return bag
        if spec.has_bridge:
            client.arm(_START_TIMEOUT)
        client.watch()
        if not spec.has_bridge:
            client.resume(_START_TIMEOUT)
        _wait_for_end(conductor, client, spec.duration)
        finish_recording(conductor, processes, recorder, client, spec.steps + 1)
    return bag


def _keep_time(
    conductor: Conductor, plant: PlantClient, spec: GraphRun, processes: ProcessSet, recorder: Child
) -> None:
    """Let a run in real time go, wait for its length by the plant's clock, and put the plant to rest."""
    plant.watch()
    try:
        if spec.has_bridge:
            plant.arm(_START_TIMEOUT)
        else:
            plant.resume(_START_TIMEOUT)
        conductor.wait_for("states", lambda: plant.sample is not None, _START_TIMEOUT)
        assert plant.sample is not None
        plant.mark(START_EVENT)
        end_ns = plant.sample.stamp_ns + round(spec.duration * NANOSECONDS)
        conductor.wait_for(
            f"{spec.duration:g} s of real time", lambda: _has_reached(plant, end_ns), _START_TIMEOUT + spec.duration
        )
        plant.mark(END_EVENT)
        conductor.spin(_LAST_WORDS)
    finally:
        plant.disarm_quietly()
    if processes.finish(recorder) != 0:
        raise FaultError(recorder.last_words(1))


def _has_reached(plant: PlantClient, end_ns: int) -> bool:
    plant.check_mode()
    return plant.sample is not None and plant.sample.stamp_ns >= end_ns


def _wait_for_end(conductor: Conductor, plant: PlantClient, duration: float) -> None:
    """Wait for the end of a run in lockstep, however slow a busy machine makes it, as long as it goes on."""
    while not _is_finished(plant):
        enough = plant.states + _ALIVE
        conductor.wait_for(
            f"{_ALIVE} more states of a run of {duration:g} s of simulated time",
            lambda enough=enough: plant.states >= enough or _is_finished(plant),  # type: ignore[misc]
            _START_TIMEOUT,
        )


def _is_finished(plant: PlantClient) -> bool:
    plant.check_mode()
    return plant.has_event(Event.LOCKSTEP_FINISHED) is not None


def finish_recording(
    conductor: Conductor, processes: ProcessSet, recorder: Child, plant: PlantClient, states: int
) -> None:
    """Close the bag of a run in lockstep when it holds everything.

    Simulated time stands still by then: what the nodes say on their way out is no part of the run.

    Args:
        conductor: Who conducts.
        processes: The run's programs.
        recorder: The recorder among them.
        plant: The plant.
        states: How many states the plant has published.

    Raises:
        FaultError: Messages were lost.
    """
    # The clock ticks once for each state, and neither topic waits for the other.
    for topic in (f"{plant.namespace}/{names.JOINT_STATES}", names.CLOCK):
        RecorderClient(conductor, plant.namespace).wait_for_all(topic, states)
    if processes.finish(recorder) != 0:
        raise FaultError(recorder.last_words(1))


def wait_until_all_hear_each_other(
    conductor: Conductor, namespace: str, listeners: Mapping[str, int], *, clock: bool = True
) -> None:
    """Wait until every subscription of a run is on the graph, and the recorder's are matched with a publisher.

    Args:
        conductor: Who conducts.
        namespace: Namespace of the plant.
        listeners: How many subscriptions each topic of the plant must have, by relative name.
        clock: Whether the plant keeps simulated time, which is recorded too.
    """
    node = conductor.node

    def complete() -> bool:
        return all(
            node.count_subscribers(f"{namespace}/{topic}") >= count
            and node.count_publishers(f"{namespace}/{topic}") >= (1 if count else 0)
            for topic, count in listeners.items()
        )

    conductor.wait_for("all nodes to hear each other", complete, _START_TIMEOUT)
    recorder = RecorderClient(conductor, namespace)
    recorded = {f"{namespace}/{topic}" for topic, count in listeners.items() if count}
    recorded |= {names.CLOCK} if clock else set()
    conductor.wait_for("the recorder to hear all topics", lambda: recorded <= recorder.heard(), _START_TIMEOUT)
    # What one side of a match knows, the other side knows a moment later.
    conductor.spin(0.5)
