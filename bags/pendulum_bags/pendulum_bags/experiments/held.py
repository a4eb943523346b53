"""A plant of several joints that runs on the graph already: held upright by hand, then balanced under noise."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.graph_plant import join
from pendulum_bags.experiments.joint_run import JointSettings, has_fallen
from pendulum_bags.experiments.orchestrator_node import PlantClient, RecorderClient
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.session import ANSWER_PRIORITY, START_TIMEOUT, Session, conduct, start_loop
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism

__all__ = ["HOLD_PATIENCE", "RELEASE_TIME", "record_held"]

HOLD_PATIENCE = 120.0
"""Longest wait until the plant is held upright [s]."""
RELEASE_TIME = 3.0
"""Time under control in which the hand releases the plant, before the noise [s]."""
_NEAR = 0.3
"""Largest first effort of the controller, as a share of each motor's limit."""
_STILL = 0.5
"""Time for which the plant must stay there before it is armed [s]."""


def record_held(
    bag: Path,
    settings: JointSettings,
    side: str,
    domain: int | None,
    progress: PhaseProgress,
    leaving: ExitStack,
) -> None:
    """Record a running plant of a side under noise, as its settings describe, and disarm it.

    It is armed once a person holds it so near upright, and so still, that the controller would ask for little; a
    commanded effort acts from then on only.

    Raises:
        FaultError: It is not held upright in time, it fell, a program ended, or the plant refused or faulted; it is
            disarmed again.
    """
    space, design = settings.namespace(side), load_mechanism(settings.design_plant)
    run = replace(settings.run(side), clock="realtime")
    controller = make_controller(settings.controller, design, run.period, run.law(design))
    with ExitStack() as stack:
        session = stack.enter_context(conduct(bag.parent / "logs" / side, stack.enter_context(reserve_domain(domain))))
        progress.phase("starting", 6.0)
        plant = join(session.orchestrator, space, design.coordinates)
        recorder = session.record(bag, space, settings.metadata(side), settings.storage)
        # The plant's period is its own.
        for program, own in ((run.controller_program(), {"period": 0.0}), (run.disturbance_program(), {})):
            waiting = {**program.parameters, **own, "autostart": False}
            started = replace(program, namespace=space, parameters=waiting)
            start_loop(session.processes, started, ANSWER_PRIORITY)
        session.drives(plant)
        plant.wait_until_ready(START_TIMEOUT)
        RecorderClient(session.orchestrator, space).wait_until_heard(
            [f"{space}/{topic}" for topic in (names.JOINT_STATES, *design.coordinates.topics)], START_TIMEOUT
        )
        plant.configure_controller()
        progress.phase("waiting until it is held upright", 10.0)
        _wait_for_hand(session, plant, controller, design)
        _balance(session, plant, settings, design, progress)
        session.close(recorder)
        session.leaves(plant)
        session.processes.stop()
        leaving.push(stack.pop_all())


def _wait_for_hand(session: Session, plant: PlantClient, controller: Controller, design: PlantParameters) -> None:
    """Wait until the controller would ask for little, long enough."""
    since: list[int] = []

    def is_held() -> bool:
        plant.check_mode()
        plant.check_alive()
        sample = plant.sample
        assert sample is not None
        asked = controller.efforts(0.0, sample.position, sample.velocity)
        near = all(abs(u) <= _NEAR * limit for u, limit in zip(asked, design.command_limits, strict=True))
        if not near or has_fallen(design, sample.position):
            since.clear()
            return False
        since.append(sample.stamp_ns)
        return since[-1] - since[0] >= _STILL * NANOSECONDS

    try:
        session.orchestrator.wait_for("it to be held upright", is_held, HOLD_PATIENCE)
    except FaultError as error:
        if plant.sample is None or "in vain" not in str(error):
            raise
        at = ", ".join(
            f"{joint.name} {q:.3f} {joint.unit}"
            for joint, q in zip(design.mechanism.joints, plant.sample.position, strict=True)
        )
        raise FaultError(
            f"{plant.namespace} was not held upright and still within {HOLD_PATIENCE:g} s (it is at {at}); expected "
            f"{', '.join(f'{goal:.3g}' for goal in design.coordinates.goal)}, where the controller asks for at most "
            f"{_NEAR:g} of each motor's limit"
        ) from None


def _balance(
    session: Session, plant: PlantClient, settings: JointSettings, design: PlantParameters, progress: PhaseProgress
) -> None:
    orchestrator, noise = session.orchestrator, settings.noise

    def stands() -> None:
        plant.check_mode()
        plant.check_alive()
        assert plant.sample is not None
        if has_fallen(design, plant.sample.position):
            raise FaultError(f"{plant.namespace} fell; expected it to stay upright: try a smaller --amplitude")

    def settled(end_ns: int) -> bool:
        stands()
        assert plant.sample is not None
        return plant.sample.stamp_ns >= end_ns

    def ended() -> bool:
        stands()
        return plant.newest_event(Event.NOISE_END) is not None

    plant.arm()
    plant.switch_controller(on=True)
    progress.phase("regulation: release it now", RELEASE_TIME)
    plant.mark("regulation")
    assert plant.sample is not None
    end_ns = plant.sample.stamp_ns + round(RELEASE_TIME * NANOSECONDS)
    orchestrator.wait_for("the plant to settle", lambda: settled(end_ns), START_TIMEOUT)
    progress.phase("noise", noise.duration)
    started = plant.start_disturbance()
    orchestrator.wait_for("the disturbance to start", started.done, 5.0)
    orchestrator.wait_for("the end of the noise", ended, noise.duration + 15.0)
    plant.disarm()
    plant.switch_controller(on=False)
    plant.mark("done")
    orchestrator.spin(0.2)
