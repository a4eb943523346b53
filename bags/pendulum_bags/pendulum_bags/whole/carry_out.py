"""Carry out the whole answer: what the machine does is recorded once, while this process simulates and analyses.

The machine's recordings begin while the ramp down of the run in real time leaves the computer idle. Every simulated
plant is compared with the same recordings, under the controllers that were designed on the given plant.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pendulum_bags.comparison import Comparison, Margins
from pendulum_bags.experiments.decide import Budget, decide
from pendulum_bags.experiments.lockstep import lockstep_spec
from pendulum_bags.experiments.machine import Machine, MachineRun
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.repeats import SHORTEST, record_repeat, record_simulation, repeat_folder, repeat_settings
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.experiments.simulation import recorded_difference
from pendulum_bags.experiments.stalls import run_undisturbed
from pendulum_bags.experiments.thesis import run_thesis
from pendulum_bags.frequency_response.analyse import analyse_responses, read_responses
from pendulum_bags.frequency_response.multisine import FOLDER as MULTISINE
from pendulum_bags.frequency_response.multisine import Multisine
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.frequency_response.write import write_numbers
from pendulum_bags.identification.identify import identify
from pendulum_bags.ranking.present import same_choice
from pendulum_bags.ranking.ranking import Ranking
from pendulum_bags.runs.next_test import with_budget
from pendulum_bags.runs.read_recording import read_recording
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import Answer, Layer, LayerResult, Mark, write_layer
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.verdict.same_run import case_of, recordings_of
from pendulum_bags.whole.contenders import (
    contender_specs,
    keep_run,
    place_of,
    rank_folders,
    simulate_contenders,
)
from pendulum_msgs_py.errors import DataError, FaultError, PendulumError, PlantStoppedError
from pendulum_msgs_py.plants.plant_parameters import load_plant

__all__ = ["IDENTIFIED", "STEPS", "Findings", "Order", "Simulated", "carry_out"]

IDENTIFIED = "identified"
"""Step that identifies a plant, folder of its recordings within the run folder, and its entry in ``summary.json``."""
STEPS = (Layer.SAME_RUN.key, IDENTIFIED, *(layer.key for layer in Layer if layer is not Layer.SAME_RUN))
"""What may be asked for alone; the first is always carried out."""
PLANT_FILE = "plant.yaml"
RANKING = "ranking"
_TEST_SEED_STEP = 2_000_000
"""Added to the seed for the noise under which an identified plant is tested: a fit has seen the other."""
_SHARE = 0.4
"""Share of the budget for repeats of one plant, so that the other layers have time, too."""
_WRITING = 5.0
"""Processor time to end all programs and write the page without files of its figures [s]."""
_OWN_LOAD = 2.0
"""Programs of this run that want to run at once: this one, and of the machine's one at a time."""
_POLL = 0.2
_MOST_WRITING = 0.5
"""Largest share of the budget that is left for it, where this computer is busy."""


@dataclass(frozen=True)
class Order:
    """What is wanted.

    Attributes:
        settings: The given plant, the machine, controller and noise.
        margins: What difference does not matter.
        budget: Longest wall time of what follows the run in real time; 0 for one analysis of that run alone [s].
        steps: Of :data:`STEPS`.
        contenders: Controllers of the ranking.
        domain: ROS domain of the run in real time; None for any free one.
    """

    settings: RegulationSettings
    margins: Margins
    budget: float
    steps: Collection[str]
    contenders: int
    domain: int | None = None

    @property
    def alone(self) -> bool:
        """Whether the run in real time is all: a machine moves when its operator wants it to."""
        return not self.settings.can_repeat or self.budget <= 0.0

    @property
    def expected_wall_time(self) -> float:
        """Wall time of all steps, measured on two cores [s]."""
        further = 0.0 if self.alone else 4.0 + 18.0 * (IDENTIFIED in self.steps)
        further += 6.0 * self.wants(Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS)
        further += (5.0 + 3.6 * self.contenders) * self.wants(Layer.SAME_CHOICE)
        return self.settings.expected_wall_time + further

    def wants(self, *layers: Layer) -> bool:
        """Return whether one of some layers is asked for."""
        return not self.alone and bool({layer.key for layer in layers} & set(self.steps))


@dataclass
class Simulated:
    """One simulated plant, and what was found of it beside the machine.

    Attributes:
        name: As sentences name it.
        settings: What ran.
        folder: Of its recordings.
        budget: That of the next run where this one's did not suffice; 0 where more of it measures nothing [s].
    """

    name: str
    settings: RegulationSettings
    folder: Path
    budget: float = 0.0
    comparison: Comparison | None = None
    analysis: Analysis | None = None
    ranking: Ranking | None = None
    layers: list[LayerResult] = field(default_factory=list)

    def answer(self) -> Answer:
        """Return the sum of what was measured; there is a comparison."""
        assert self.comparison is not None
        more = (
            with_budget([run_record(self.comparison.pairs[0].simulation.metadata)], self.budget) if self.budget else ""
        )
        return answer_of(self.comparison, anew=self.layers, more=more, how=dict.fromkeys(Layer, more) if more else {})

    def add(self, *layers: LayerResult) -> None:
        """Add layers of this plant and store them.

        Raises:
            DataError: They are of another plant or machine.
        """
        assert self.comparison is not None
        for layer in layers:
            case_of(self.comparison).require_same(layer.case, f"“{layer.layer.title}”")
            write_layer(self.folder, layer)
        self.layers += layers


@dataclass
class Findings:
    """All that a run found.

    Attributes:
        given: The plant that was given.
        identified: The one that was identified; None for none.
        notes: What could not be done, a sentence each.
        interrupted: Whether the user ended it early.
        spent: Whether the budget did.
    """

    given: Simulated
    identified: Simulated | None = None
    notes: list[str] = field(default_factory=list)
    interrupted: bool = False
    spent: bool = False

    @property
    def plants(self) -> list[Simulated]:
        """Every plant that was compared."""
        return [one for one in (self.given, self.identified) if one is not None and one.comparison is not None]


def carry_out(
    folder: Path, order: Order, progress: PhaseProgress, leaving: ExitStack, on_first: Callable[[Simulated], None]
) -> Findings:
    """Record, identify and compare; what is found when the budget ends or the user interrupts is returned.

    Args:
        folder: The run's folder.
        order: What is wanted.
        progress: Shows where it is.
        leaving: Ends the machine's program and leaves the graph; close it when everything is written.
        on_first: Called with the given plant when its first layer is there.

    Raises:
        FaultError: The run in real time failed.
        KeyboardInterrupt: The user interrupted it before the first layer.
    """
    run = _Run(folder, order, progress, on_first)
    leaving.enter_context(run.machine)
    spent = threading.Event()
    try:
        run.measure(leaving)
        with _ends_with_budget(order.budget, run.compared, spent):
            run.carry_out(run.compare_given)
            for step in run.steps():
                run.carry_out(step)
    except KeyboardInterrupt:
        if not run.compared.is_set():
            raise
        run.machine.interrupt()
        run.found.spent, run.found.interrupted = spent.is_set(), not spent.is_set()
        why = f"The budget of {order.budget:g} s was spent" if run.found.spent else "The run was interrupted"
        run.found.notes.append(f"{why}: “{run.now}” and what follows it was left out.")
    return run.found


class _Run:
    """The steps of a run, and what they share."""

    def __init__(
        self, folder: Path, order: Order, progress: PhaseProgress, on_first: Callable[[Simulated], None]
    ) -> None:
        settings = order.settings
        self.folder, self.order, self.progress, self.on_first = folder, order, progress, on_first
        self.found = Findings(Simulated(settings.plant, settings, folder, 0.0 if order.alone else 4.0 * order.budget))
        self.now = ""
        self.compared = threading.Event()
        self.tested = replace(
            settings,
            noise=replace(
                settings.noise,
                seed=settings.noise.seed + _TEST_SEED_STEP,
                duration=max(SHORTEST, settings.noise.duration),
            ),
        )
        self.contenders: dict[str, list[tuple[RunSpec, RunSpec]]] = {}
        runs: list[MachineRun] = []
        if not order.alone:
            sim, hw = (lockstep_spec(settings, side=side) for side in ("sim", "hw"))
            # Two simulations without noise of their own may be one: in lockstep their recordings would be one, too.
            if hw.has_bridge:
                runs.append(self._recorded(repeat_folder(folder, 1) / "hw", repeat_settings(settings, 1)))
            if IDENTIFIED in order.steps:
                runs.append(self._recorded(folder / IDENTIFIED / "hw", self.tested))
            if order.wants(Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS):
                self.multisine, machine = Multisine().specs(sim, hw)
                runs.append(MachineRun(folder / MULTISINE / "hw", machine))
            if order.wants(Layer.SAME_CHOICE):
                self._phase("choosing controllers", 0.1 * order.contenders)
                self.contenders = contender_specs(sim, hw, order.contenders, settings.noise.seed)
                runs += [
                    MachineRun(place_of(folder / RANKING, name, machine) / "bag", machine)
                    for name, specs in self.contenders.items()
                    for _, machine in specs
                ]
        self.machine = Machine(folder, runs)

    @staticmethod
    def _recorded(bag: Path, settings: RegulationSettings) -> MachineRun:
        return MachineRun(bag, lockstep_spec(settings, side="hw"))

    def measure(self, leaving: ExitStack) -> None:
        """Carry out the run in real time, from ramp to ramp."""
        settings = self.order.settings

        def run() -> None:
            try:
                run_thesis(self.folder, settings, self.order.domain, self.progress, leaving, on_idle=self.machine.start)
            except FaultError:
                self.machine.discard()
                raise

        run_undisturbed(run, self.folder, emulated=settings.is_emulated, tell=self.progress.start_again)

    def compare_given(self) -> None:
        """Compare the given plant with the machine."""
        repeat = repeat_folder(self.folder, 1) / "hw"
        if any(run.bag == repeat for run in self.machine.runs):
            self._phase("repeat on the hardware", 2.0)
            self.machine.wait(repeat)
        self._phase("comparing", 2.0)
        share = 1.0 if set(self.order.steps) == {Layer.SAME_RUN.key} else _SHARE
        self._compare(self.found.given, 0.0 if self.order.alone else share * self.order.budget)

    def _compare(self, plant: Simulated, seconds: float) -> None:
        def take(comparison: Comparison) -> None:
            first = plant.comparison is None
            settings = plant.settings
            if (space := settings.running("sim")) is not None:
                unproved = recorded_difference(plant.folder / "sim", space, settings.plant)
                comparison = replace(comparison, unproved=[unproved])
            plant.comparison = comparison
            if first and plant is self.found.given:
                self.on_first(plant)
                self.compared.set()

        decide(
            plant.folder,
            plant.settings,
            self.order.margins,
            Budget(seconds),
            on_look=lambda number, duration: self._phase(f"undecided: {duration:.0f} s more", 4.0 + 0.25 * duration),
            on_comparison=take,
            record=self._repeat,
        )

    def _repeat(self, folder: Path, settings: RegulationSettings, number: int) -> None:
        """Record a repeat; the hardware's in a program of its own, so that this one has a graph once only."""
        bag = repeat_folder(folder, number) / "hw"
        run = self._recorded(bag, repeat_settings(settings, number))
        if run.spec.has_bridge and not bag.exists():
            with Machine(bag.parent, [run]) as machine:
                machine.start()
                machine.wait(bag)
        record_repeat(folder, settings, number)

    def carry_out(self, step: Callable[[], None]) -> None:
        """Carry out a step; one that fails once there is an answer leaves a note, and the others go on."""
        try:
            step()
        except PendulumError as error:
            if not self.compared.is_set():
                raise
            self.found.notes.append(f"{self.now[0].upper()}{self.now[1:]} failed: {error}".rstrip(".") + ".")

    def steps(self) -> Iterator[Callable[[], None]]:
        """Yield what follows the first layer of the given plant, each step when the one before is done."""
        if self.order.alone:
            return
        found, wants = self.found, self.order.wants
        if IDENTIFIED in self.order.steps and found.given.answer().mark is not Mark.YES:
            yield self._identify
        if wants(Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS):
            for plant in found.plants:
                yield partial(self._frequencies, plant)
        if self.contenders:
            for plant in found.plants:
                yield partial(self._simulate_contenders, plant)
            yield self._machine_contenders
            for plant in found.plants:
                yield partial(self._rank, plant)

    def _phase(self, name: str, seconds: float) -> None:
        self.now = name
        self.progress.phase(name, seconds)

    def _identify(self) -> None:
        """Identify a plant from what the given one was compared with, and compare it under noise of another seed."""
        given = self.found.given
        assert given.comparison is not None
        self._phase("identifying the plant", 14.0)
        result = identify([read_recording(path) for path in recordings_of(given.comparison)])
        if result.refused:
            raise DataError(f"no plant was identified: {result.verdict}")
        limit = load_plant(given.settings.design_plant).effort_limit
        file = result.write(self.folder / PLANT_FILE, effort_limit=limit)
        self._phase(f"comparing {PLANT_FILE}", 4.0)
        place = self.folder / IDENTIFIED
        self.machine.wait(place / "hw")
        settings = self.tested_with(file)
        record_simulation(place / "sim", lockstep_spec(settings, side="sim"))
        self.found.identified = Simulated(PLANT_FILE, settings, place, given.budget)
        self._compare(self.found.identified, _SHARE * self.order.budget)

    def tested_with(self, file: Path) -> RegulationSettings:
        """Return the settings that test a plant file under the controller that was designed on the given plant."""
        design = self.order.settings.design_plant
        return replace(self.tested, plant=str(file), design=design, simulation="", mapping="")

    def _frequencies(self, plant: Simulated) -> None:
        """Compare a plant with the machine in frequency, and certify designs on it."""
        self._phase(f"frequencies of {plant.name}", 3.0)
        own, machine = plant.folder / MULTISINE / "sim", self.folder / MULTISINE / "hw"
        record_simulation(own, _of(plant, self.multisine))
        self.machine.wait(machine)
        responses, _, ran = read_responses([own, machine])
        plant.analysis = analyse_responses(responses, plant.settings.plant, ran)
        write_numbers(plant.folder, plant.analysis)
        plant.add(*(one for one in plant.analysis.layers if self.order.wants(one.layer)))

    def _simulate_contenders(self, plant: Simulated) -> None:
        self._phase(f"{len(self.contenders)} controllers on {plant.name}", 0.6 * len(self.contenders))
        specs = {name: [_of(plant, sim) for sim, _ in both] for name, both in self.contenders.items()}
        simulate_contenders(plant.folder / RANKING, specs)

    def _machine_contenders(self) -> None:
        self._phase(f"{len(self.contenders)} controllers on the hardware", 3.0 * len(self.contenders))
        for name, both in self.contenders.items():
            for _, spec in both:
                place, failure = place_of(self.folder / RANKING, name, spec), ""
                try:
                    self.machine.wait(place / "bag")
                except PlantStoppedError as error:
                    failure = str(error)
                keep_run(place, name, spec, failure)

    def _rank(self, plant: Simulated) -> None:
        self._phase(f"ranking on {plant.name}", 1.0)
        plant.ranking, case = rank_folders(plant.folder / RANKING, self.folder / RANKING)
        write_json(plant.folder / "ranking.json", plant.ranking.to_json())
        plant.add(same_choice(plant.ranking, case=case))


def _of(plant: Simulated, spec: RunSpec) -> RunSpec:
    """Return a run of the given plant's simulation as one of another plant; the controller stays."""
    settings = plant.settings
    return replace(
        spec, plant=settings.plant, method=settings.method, simulation=settings.simulation, mapping=settings.mapping
    )


def _slowness() -> float:
    """Return how many times longer than alone a computation takes, by the programs that others want to run."""
    return max(1.0, (os.getloadavg()[0] - _OWN_LOAD) / (os.cpu_count() or 1))


@contextmanager
def _ends_with_budget(budget: float, compared: threading.Event, spent: threading.Event) -> Iterator[None]:
    """Interrupt the main thread when the budget less the time to write the page is spent, as Ctrl-C would.

    Args:
        budget: Wall time from now on; 0 for no end [s].
        compared: Set when the first layer is there, for which there is always time.
        spent: Set before the interruption.
    """
    ends, done = time.monotonic() + budget, threading.Event()

    def end() -> None:
        compared.wait()
        while time.monotonic() < ends - min(_WRITING * _slowness(), _MOST_WRITING * budget):
            if done.wait(_POLL):
                return
        spent.set()
        os.kill(os.getpid(), signal.SIGINT)

    watch = threading.Thread(target=end, daemon=True)
    if budget > 0.0:
        watch.start()
    try:
        yield
    finally:
        done.set()
        if budget > 0.0 and compared.is_set():
            # One that has just ended interrupts here, and not what comes next.
            watch.join()
