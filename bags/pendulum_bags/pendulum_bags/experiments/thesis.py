"""The thesis's experiment: upright on simulator and hardware, LQR under the same noise, down again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.graph_plant import join
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.processes import Child
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.repeats import record_simulation
from pendulum_bags.experiments.run_spec import SIDES
from pendulum_bags.experiments.session import (
    ANSWER_PRIORITY,
    PLANT_PRIORITY,
    START_TIMEOUT,
    Session,
    conduct,
    start_loop,
)
from pendulum_bags.experiments.settings import SETTLE_TIME, RegulationSettings
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.errors import FaultError

__all__ = ["run_thesis"]

_PAUSING = 4.0
"""Time before the end of the ramp up from which nothing is begun in parallel [s]."""
OWN_PROTOCOL_SEED_STEP = 1_000_000
"""Added to the seed for the unpaired simulation, whose noise must not be that of the hardware."""


def run_thesis(
    folder: Path,
    settings: RegulationSettings,
    domain: int | None,
    progress: PhaseProgress,
    leaving: ExitStack,
    *,
    on_idle: Callable[[], None] = lambda: None,
    rests: Callable[[], bool] = lambda: True,
) -> None:
    """Run the experiment and leave the bags ``sim``, ``hw`` and ``sim_500hz`` in the folder.

    Args:
        domain: ROS domain, or None for any free one.
        leaving: Leaves the graph of a successful run, in which the middleware can hang: close it last.
        on_idle: Called when a ramp begins, which leaves the computer idle.
        rests: Polled until the background work has paused, before the noise.

    Raises:
        FaultError: A program ended, a plant refused or faulted; everything is at rest again.
    """
    with ExitStack() as stack:
        session = stack.enter_context(conduct(folder / "logs", stack.enter_context(reserve_domain(domain))))
        progress.phase("starting", 6.0)
        _refuse_occupied_domain(session.orchestrator, settings)
        plants, recorders = _start(session, folder, settings)
        session.drives(*plants)
        _regulate(session, plants, settings, progress, on_idle, rests)
        progress.phase("closing the bags", 2.0)
        for recorder in recorders:
            session.close(recorder)
        for plant in plants:
            session.leaves(plant)
        session.processes.stop()
        if settings.running("sim") is None:
            _simulate_own_protocol(folder, settings)
        leaving.push(stack.pop_all())


def _start(
    session: Session, folder: Path, settings: RegulationSettings
) -> tuple[tuple[PlantClient, PlantClient], list[Child]]:
    """Start all programs; return both plants, and their recorders."""
    orchestrator = session.orchestrator
    joined = {side: join(orchestrator, running) for side in SIDES if (running := settings.running(side)) is not None}
    recorders = []
    for side in SIDES:
        namespace, plant = settings.namespace(side), settings.plant_name(side)
        metadata = settings.metadata(
            "thesis", side=side, plant=plant, namespace=namespace, ramp_speed=settings.ramp_speed
        )
        recorders.append(session.record(folder / side, namespace, metadata, settings.storage))
    programs = {side: settings.plant_program(side, folder / "hw") for side in SIDES}
    others = [
        make(settings.namespace(side), autostart=False)
        for make in (settings.controller_program, settings.disturbance_program)
        for side in SIDES
    ]
    for program in programs.values():
        if program is not None:
            start_loop(session.processes, program, PLANT_PRIORITY)
    for program in others:
        start_loop(session.processes, program, ANSWER_PRIORITY)
    sim, hw = (
        joined[side] if program is None else PlantClient(orchestrator, settings.namespace(side), program.node_name)
        for side, program in programs.items()
    )
    return (sim, hw), recorders


def _regulate(
    session: Session,
    plants: Sequence[PlantClient],
    settings: RegulationSettings,
    progress: PhaseProgress,
    on_idle: Callable[[], None],
    rests: Callable[[], bool],
) -> None:
    orchestrator, noise = session.orchestrator, settings.noise
    for plant in plants:
        plant.wait_until_ready(START_TIMEOUT)
        recorded = [f"{plant.namespace}/{topic}" for topic in (*names.SIGNALS, names.JOINT_TRAJECTORY)]
        RecorderClient(orchestrator, plant.namespace).wait_until_heard(recorded, START_TIMEOUT)
        plant.wait_until_moves_are_recorded(START_TIMEOUT)
    for plant in plants:
        plant.configure_controller()
        plant.arm()

    durations = _start_move(orchestrator, plants, settings, UPRIGHT, "ramp_up", progress)
    on_idle()
    orchestrator.spin(max(0.0, max(durations) - _PAUSING))
    rests()
    _wait_for_goal(orchestrator, plants, durations)
    orchestrator.wait_for("other recordings to pause", rests, START_TIMEOUT)

    progress.phase("regulation", SETTLE_TIME)
    for plant in plants:
        plant.mark("regulation")
        plant.switch_controller(on=True)
    orchestrator.spin(SETTLE_TIME)

    progress.phase("noise", noise.duration)
    started = [plant.start_disturbance() for plant in plants]
    orchestrator.wait_for("the disturbances to start", lambda: all(future.done() for future in started), 5.0)
    for plant in plants:
        orchestrator.wait_for(
            f"the end of the noise on {plant.namespace}", partial(_noise_ended, plant), noise.duration + 15.0
        )

    durations = _start_move(orchestrator, plants, settings, 0.0, "ramp_down", progress)
    on_idle()
    # Before the ramp ends: an active controller would take over a pendulum half a turn from upright.
    for plant in plants:
        plant.switch_controller(on=False)
    _wait_for_goal(orchestrator, plants, durations)
    for plant in plants:
        plant.disarm()
        plant.mark("done")
    orchestrator.spin(0.2)


def _noise_ended(plant: PlantClient) -> bool:
    plant.check_mode()
    plant.check_alive()
    return plant.newest_event(Event.NOISE_END) is not None


def _simulate_own_protocol(folder: Path, settings: RegulationSettings) -> None:
    """Simulate as the thesis did: its own noise, a sample every 2 ms, no nodes."""
    foreign = settings.foreign
    hold_time = 0.002 if foreign is None else max(0.002, foreign.period)
    noise = replace(settings.noise, seed=settings.noise.seed + OWN_PROTOCOL_SEED_STEP, hold_time=hold_time)
    record_simulation(folder / "sim_500hz", replace(settings, noise=noise).run("sim"))


def _start_move(
    orchestrator: Orchestrator,
    plants: Sequence[PlantClient],
    settings: RegulationSettings,
    goal: float,
    phase: str,
    progress: PhaseProgress,
) -> list[float]:
    ramps = []
    for plant in plants:
        assert plant.sample is not None
        ramps.append(settings.ramp(plant.sample.position[0], goal))
    progress.phase(phase.replace("_", " "), max(ramp.duration for ramp in ramps))
    for plant, ramp in zip(plants, ramps, strict=True):
        plant.follow(ramp, phase, goal=goal)
    for plant in plants:
        orchestrator.wait_for(f"{plant.namespace} to follow the {phase.replace('_', ' ')}", plant.is_following, 5.0)
    return [ramp.duration for ramp in ramps]


def _wait_for_goal(orchestrator: Orchestrator, plants: Sequence[PlantClient], durations: Sequence[float]) -> None:
    for plant, duration in zip(plants, durations, strict=True):
        orchestrator.wait_for(f"{plant.namespace} to end its move", plant.trajectory_finished, duration + 15.0)


def _refuse_occupied_domain(orchestrator: Orchestrator, settings: RegulationSettings) -> None:
    ours = {settings.namespace(side) for side in SIDES if settings.running(side) is None}
    orchestrator.spin(0.5)
    for name, namespace in orchestrator.node.get_node_names_and_namespaces():
        if namespace in ours:
            raise FaultError(
                f"ROS domain {orchestrator.domain} is in use: {namespace}/{name} is already there; "
                "choose another with --domain"
            )
