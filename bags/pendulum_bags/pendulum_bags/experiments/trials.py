"""The thesis's two identification experiments: six trials by hand on a table, three staircases against gravity."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.host_pool import HostPool, open_pool
from pendulum_bags.experiments.operator import RealMachine, real_machine
from pendulum_bags.experiments.orchestrator_node import PlantClient
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.run_spec import EMULATOR_PATIENCE, lockstep_parameters
from pendulum_bags.experiments.session import ANSWER_PRIORITY, PLANT_PRIORITY, START_TIMEOUT, conduct, start_loop
from pendulum_bags.experiments.settings import HARDWARE
from pendulum_bags.runs.run_folder import provenance
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.trajectory import RAMP_INCREMENT, RAMP_PERIOD
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs import graph

__all__ = ["GRAVITY", "INERTIA_DAMPING", "TrialKind", "TrialSettings", "run_trials"]

_SLOWEST = 3.0
"""Slowest pace at which a trial still counts as alive, wall time per simulated time."""
_LONGEST_BY_HAND = 600.0
"""Timeout of a trial by hand [s]."""
_MARGIN = 1.0
"""Time beyond the steps of the staircase, whose ramps end on whole increments [s]."""


@dataclass(frozen=True)
class TrialKind:
    """One of the two experiments.

    Attributes:
        name: As in ``experiment NAME`` and ``identify --experiment NAME``.
        procedure: What the bridge's procedure plays.
        trials: Number of trials, as in the thesis.
        flat: Whether the pendulum lies on a table, without gravity.
        inputs: Inputs of the plant with a reply to each state.
        longest: Longest time of the simulated hand [s]; 0 if the settings have it.
    """

    name: str
    procedure: str
    trials: int
    flat: bool
    inputs: tuple[str, ...]
    longest: float = 0.0


INERTIA_DAMPING = TrialKind("inertia_damping", "hand", 6, True, (names.EFFORT_COMMAND, names.PUSH), 22.0)
GRAVITY = TrialKind("gravity", "staircase", 3, False, (names.EFFORT_COMMAND,))


@dataclass(frozen=True)
class TrialSettings:
    """What to run.

    Attributes:
        hardware: ``emulator`` or ``hebi``.
        plant: Plant of the emulator: preset or file with a drivetrain.
        realtime: Wall time for the emulator too; a real actuator always has it.
        step: Height of a step of the staircase [deg].
        top: Highest angle of the staircase [deg].
        hold: Time at rest on each step [s].
        lab: Lab file of the real actuator, for ``hebi``.
    """

    kind: TrialKind
    trials: int
    hardware: str = "emulator"
    plant: str = "thesis"
    realtime: bool = False
    seed: int = 1
    step: float = 10.0
    top: float = 90.0
    hold: float = 2.0
    storage: str = "mcap"
    lab: str = ""

    def __post_init__(self) -> None:
        if self.hardware not in HARDWARE:
            raise ParameterError(f"hardware is {self.hardware!r}; expected one of {', '.join(HARDWARE)}")
        real_machine(self.hardware, self.lab)
        if self.trials < 1:
            raise ParameterError(f"number of trials is {self.trials}; expected >= 1")
        if self.top / self.step != round(self.top / self.step):
            raise ParameterError(f"staircase top is {self.top:g} deg; expected a multiple of step, {self.step:g} deg")

    @property
    def machine(self) -> RealMachine | None:
        """The machine of the lab file; None for the emulator."""
        return real_machine(self.hardware, self.lab)

    @property
    def lockstep(self) -> bool:
        """Whether time is simulated."""
        return self.hardware == "emulator" and not self.realtime

    @property
    def by_person(self) -> bool:
        """Whether a person turns the pendulum."""
        return self.hardware == "hebi" and self.kind.procedure == "hand"

    @property
    def expected_duration(self) -> float:
        """Length of one trial, at most [s]."""
        if self.kind.procedure == "hand":
            return self.kind.longest
        ramp = math.radians(self.step) / RAMP_INCREMENT * RAMP_PERIOD
        return _MARGIN + 4.0 * self.top / self.step * (self.hold + ramp)

    @property
    def expected_wall_time(self) -> float:
        """Wall time of one trial, including the start of its nodes [s]."""
        return 4.0 + self.expected_duration / (10.0 if self.lockstep else 1.0)

    def plant_program(self, trial: int, bag: Path | None = None) -> graph.NodeProgram:
        """Return the bridge; a real actuator's own log is written next to the bag."""
        if (machine := self.machine) is not None:
            return machine.bridge_program("direct_pwm", bag)
        parameters: dict[str, graph.ParameterArgument] = {"plant": self.plant, "effort_strategy": "direct_pwm"}
        if self.hardware == "emulator":
            parameters.update(flat=self.kind.flat, seed=1000 * self.seed + trial)
            if self.lockstep:
                # Ends by simulated time, too: a busy machine delays the orchestrator's view of the end.
                parameters.update(lockstep_parameters(_LISTENERS + 1, self.expected_duration, self.kind.inputs))
            else:
                parameters.update(EMULATOR_PATIENCE)
        return graph.bridge("/hw", backend=self.hardware, **parameters)

    def procedure_program(self, trial: int) -> graph.NodeProgram:
        """Return the node that plays a trial."""
        parameters: dict[str, graph.ParameterArgument] = {
            "procedure": self.kind.procedure,
            "trial": trial,
            "seed": self.seed,
            "autostart": self.lockstep,
            "person": self.by_person,
            "use_sim_time": self.lockstep,
            "step": float(self.step),
            "top": float(self.top),
            "hold": float(self.hold),
        }
        return graph.NodeProgram("pendulum_hw_bridge", "procedure", "/hw", parameters=parameters)


_LISTENERS = 2
"""Subscribers of the bridge's states in addition to the orchestrator: procedure and recorder."""


def run_trials(
    folder: Path,
    settings: TrialSettings,
    domain: int | None,
    progress: PhaseProgress,
    ask: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Run all trials, one bag each (``trial_1``, ...), and return the bags.

    ``domain`` is None for any free one; ``ask`` shows an operator prompt and returns on Enter. A FaultError if a
    program ended or the plant refused or faulted; the drive is then at rest.
    """
    bags = []
    with reserve_domain(domain) as reserved, open_pool() as hosts:
        for trial in range(1, settings.trials + 1):
            progress.phase(f"trial {trial} of {settings.trials}", settings.expected_wall_time)
            bags.append(_run_trial(folder, settings, trial, reserved, hosts if settings.lockstep else None, ask))
    return bags


def _run_trial(
    folder: Path, settings: TrialSettings, trial: int, domain: int, hosts: HostPool | None, ask: Callable[[str], None]
) -> Path:
    bag = folder / f"trial_{trial}"
    lockstep = settings.lockstep
    with conduct(folder / "logs" / bag.name, domain, hosts=hosts) as session:
        orchestrator = session.orchestrator
        recorder = session.record(bag, "/hw", _metadata(settings, trial), settings.storage, simulated=lockstep)
        start_loop(session.processes, settings.procedure_program(trial), ANSWER_PRIORITY, simulated=lockstep)
        start_loop(session.processes, settings.plant_program(trial, bag), PLANT_PRIORITY, simulated=lockstep)
        plant = PlantClient(orchestrator, "/hw", "bridge", watch=not lockstep)
        session.drives(plant)
        session.wait_until_all_hear_each_other("/hw", _topics(settings), clock=lockstep)
        if settings.by_person:
            ask(f"Trial {trial} of {settings.trials}: let the pendulum lie still at 0, then press Enter to begin.")
        plant.arm(START_TIMEOUT)
        if lockstep:
            plant.watch()
        else:
            plant.call("procedure/start")
        if settings.by_person:
            ask("Turn it slowly to half a turn and back, in 10 to 20 s; then press Enter.")
            plant.call("procedure/finish")
        longest = _LONGEST_BY_HAND if settings.by_person else START_TIMEOUT + _SLOWEST * settings.expected_duration
        orchestrator.wait_for(f"the end of trial {trial}", lambda: _has_ended(plant, lockstep=lockstep), longest)
        if lockstep:
            finished = plant.newest_event(Event.LOCKSTEP_FINISHED)
            assert finished is not None
            session.close_in_lockstep(recorder, plant, 1 + int(finished["steps"]), [names.APPLIED_EFFORT])
        session.disarm_all()
        orchestrator.spin(0.2)
    return bag


def _has_ended(plant: PlantClient, *, lockstep: bool) -> bool:
    plant.check_mode()
    if failed := plant.newest_event(Event.TRIAL_FAILED):
        raise FaultError(f"{plant.namespace}: {failed.get('reason')}")
    ended = plant.newest_event(Event.TRIAL_END) is not None
    return ended and (not lockstep or plant.newest_event(Event.LOCKSTEP_FINISHED) is not None)


def _topics(settings: TrialSettings) -> dict[str, int]:
    topics = {
        names.JOINT_STATES: _LISTENERS,
        names.EFFORT_COMMAND: 2,
        names.APPLIED_EFFORT: 1,
        names.EVENTS: 3,
        "actuator/feedback": 1,
    }
    if settings.kind.procedure == "hand":
        # A real pendulum is pushed by hand.
        topics[names.PUSH] = 0 if settings.by_person else 2
    else:
        topics[names.JOINT_TRAJECTORY] = 2
    return topics


def _metadata(settings: TrialSettings, trial: int) -> dict[str, object]:
    kind = settings.kind
    return {
        RUN_RECORD: {
            "experiment": kind.name,
            "trial": trial,
            "trials": settings.trials,
            "plant": settings.hardware,
            **({} if (machine := settings.machine) is None else {"lab": dict(machine.lab.values)}),
            "emulated_plant": settings.plant if settings.hardware == "emulator" else "",
            "strategy": "direct_pwm" if kind.procedure == "hand" else "strategy 3 of the firmware",
            "seed": settings.seed,
            "flat": kind.flat,
            "clock": "lockstep" if settings.lockstep else "realtime",
            "namespace": "/hw",
            **provenance(),
        }
    }
