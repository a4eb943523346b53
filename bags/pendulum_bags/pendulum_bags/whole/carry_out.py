"""Carry out the whole answer: the machine is recorded once, while this process simulates and analyses.

Plants of one joint are compared in real time first, from ramp to ramp; their machine's other recordings run while the
ramps leave the computer idle, and behind the analysis. Plants of several joints begin upright in lockstep. Every
simulated plant is compared with the same recordings, under controllers designed on the given plant.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TypeVar

from pendulum_bags.comparison import Comparison, Margins
from pendulum_bags.experiments.deadline import BudgetSpentError, Deadline
from pendulum_bags.experiments.decide import decide
from pendulum_bags.experiments.held import record_held
from pendulum_bags.experiments.joint_run import JointSettings, design_file, require_upright
from pendulum_bags.experiments.machine import Machine, MachineRun
from pendulum_bags.experiments.processes import Child, ProcessSet
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.repeats import SHORTEST, record_repeat, record_simulation, repeat_folder, repeat_settings
from pendulum_bags.experiments.run_spec import SIDES, RunSpec
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.experiments.simulation import recorded_difference
from pendulum_bags.experiments.stalls import run_undisturbed
from pendulum_bags.experiments.thesis import run_thesis
from pendulum_bags.frequency_response.analyse import analyse_responses, read_responses
from pendulum_bags.frequency_response.multisine import FOLDER as MULTISINE
from pendulum_bags.frequency_response.multisine import Multisine
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.frequency_response.write import write_numbers
from pendulum_bags.ranking.joint_choice import COST
from pendulum_bags.ranking.present import Words, same_choice
from pendulum_bags.ranking.ranking import Ranking
from pendulum_bags.runs.next_test import with_budget
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import Answer, Layer, LayerResult, Mark, write_layer
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.verdict.same_run import case_of, recordings_of
from pendulum_bags.whole.contenders import (
    CONTENDERS,
    LENGTH,
    SEEDS,
    contender_specs,
    keep_run,
    place_of,
    rank_folders,
    simulate_contenders,
)
from pendulum_msgs_py.errors import DataError, FaultError, PendulumError, PlantStoppedError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant

__all__ = ["IDENTIFIED", "STEPS", "Findings", "Order", "Settings", "Simulated", "carry_out"]

Settings = RegulationSettings | JointSettings
_Settings = TypeVar("_Settings", bound=RegulationSettings | JointSettings)
IDENTIFIED = "identified"
"""Step that identifies a plant, folder of its recordings within the run folder, and its entry in ``summary.json``."""
STEPS = (Layer.SAME_RUN.key, IDENTIFIED, *(layer.key for layer in Layer if layer is not Layer.SAME_RUN))
"""What may be asked for alone; the first is always carried out."""
PLANT_FILE = "plant.yaml"
RANKING = "ranking"
_TEST_SEED_STEP = 2_000_000
"""Added to the seed for the noise under which an identified plant is tested: a fit has seen the other."""
_SHARE = 0.4
"""Share of the time for repeats of one plant, so that the other layers have time, too."""
_WRITING = 6.0
"""Processor time to end all programs and write the page without files of its figures [s]."""
_POLL = 0.05
_ANALYSING, _SIMULATING = 3.0, 0.4
"""Processor time of an analysis of frequencies, and of a contender's run, which nothing ends before [s]."""


@dataclass(frozen=True)
class Order:
    """What is wanted.

    Attributes:
        budget: Longest wall time after the first recordings; 0 for one analysis of these alone [s].
        steps: Of :data:`STEPS`.
        domain: ROS domain of the run in real time; None for any free one.
        designs: Designs to certify, as text; none for the default ones.
    """

    settings: Settings
    margins: Margins
    budget: float
    steps: Collection[str]
    contenders: int = CONTENDERS
    seeds: int = SEEDS
    domain: int | None = None
    multisine: Multisine = field(default_factory=Multisine)
    designs: Collection[str] = ()

    @property
    def alone(self) -> bool:
        """Whether the first recordings are all: a machine moves when its operator wants it to."""
        return not self.settings.can_repeat or self.budget <= 0.0

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of plants of several; one empty name for plants of one."""
        return self.settings.joints if isinstance(self.settings, JointSettings) else ("",)

    @property
    def expected_wall_time(self) -> float:
        """Wall time of all steps, measured on two cores [s]."""
        further = 0.0 if self.alone else 4.0 + 18.0 * (IDENTIFIED in self.steps)
        further += (3.0 + self.recording_time(self.multisine.duration)) * self.in_frequency
        ranked = self.recording_time(LENGTH) * self.seeds * self.contenders
        further += (5.0 + ranked) * self.wants(Layer.SAME_CHOICE)
        return self.settings.expected_wall_time + further

    def recording_time(self, duration: float) -> float:
        """Return the wall time in which the machine records a run of a duration, at 100 or 500 samples a second [s]."""
        return 0.5 + (0.8 if isinstance(self.settings, JointSettings) else 0.1) * duration

    def wants(self, *layers: Layer) -> bool:
        """Return whether one of some layers is asked for."""
        return not self.alone and bool({layer.key for layer in layers} & set(self.steps))

    @property
    def in_frequency(self) -> bool:
        """Whether both plants are measured in frequency, which is defined where one joint is driven."""
        return self.wants(Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS) and not _undefined(self.settings)


@dataclass
class Simulated:
    """One simulated plant, and its results against the machine.

    Attributes:
        budget: Budget of the next run if this one's did not suffice; 0 if more time measures nothing [s].
        comparisons: Of each joint; empty before the first analysis.
        refused: Why no other plant could be identified from these recordings, or empty.
    """

    name: str
    settings: Settings
    folder: Path
    budget: float = 0.0
    comparisons: Mapping[str, Comparison] = field(default_factory=dict)
    analysis: Analysis | None = None
    ranking: Ranking | None = None
    layers: list[LayerResult] = field(default_factory=list)
    refused: str = ""

    @property
    def comparison(self) -> Comparison:
        """That of the only joint, or of the first; there is one."""
        return next(iter(self.comparisons.values()))

    def more(self, options: str = "") -> str:
        """Return the command that carries out this run again, all of it, with further options; empty for none."""
        command = with_budget([run_record(self.comparison.pairs[0].simulation.metadata)], self.budget)
        return f"{command} {options}".rstrip() if command else ""

    def answer(self) -> Answer:
        """Return the sum of what was measured; there is a comparison."""
        more = self.more() if self.budget else ""
        how = dict.fromkeys(Layer, more) if more else {}
        layers = [*self.layers, *_undefined(self.settings)]
        return answer_of(self.comparisons, updated=layers, more=more, how=how, refused=self.refused)

    def add(self, *layers: LayerResult) -> None:
        """Add layers of this plant and store them; a DataError if they are of another plant or machine."""
        for layer in layers:
            case_of(self.comparison).require_same(layer.case, f"“{layer.layer.title}”")
            write_layer(self.folder, layer)
        self.layers += layers


@dataclass
class Findings:
    """All that a run found.

    Attributes:
        identified: The identified plant, or None.
        deadline: End of the run, its page included.
        notes: What failed, a sentence each.
        interrupted: Whether the user ended it early.
        spent: Whether the budget did.
    """

    given: Simulated
    identified: Simulated | None = None
    deadline: Deadline = field(default_factory=Deadline)
    notes: list[str] = field(default_factory=list)
    interrupted: bool = False
    spent: bool = False

    @property
    def plants(self) -> list[Simulated]:
        """Every plant that was compared."""
        return [one for one in (self.given, self.identified) if one is not None and one.comparisons]


def carry_out(
    folder: Path, order: Order, progress: PhaseProgress, leaving: ExitStack, on_first: Callable[[Simulated], None]
) -> Findings:
    """Record, identify and compare until the budget ends or the user interrupts; return the findings.

    ``leaving`` ends the programs and leaves the graph; close it last. A FaultError if the first recordings failed, a
    KeyboardInterrupt before the first layer.
    """
    run = _Run(folder, order, progress, on_first)
    leaving.enter_context(run.machine)
    leaving.enter_context(run.programs)
    found = run.found
    try:
        run.measure(leaving)
        found.deadline = Deadline(order.budget or math.inf, _WRITING)
        run.carry_out(run.compare_given)
        for step in run.steps():
            run.carry_out(step)
    except KeyboardInterrupt:
        if not found.given.comparisons:
            raise
        found.interrupted = True
        found.notes.append(f"The run was interrupted: “{run.now}” and what follows it was left out.")
    except BudgetSpentError:
        found.spent = True
        found.notes.append(f"The budget of {order.budget:g} s was spent: “{run.now}” and what follows it was left out.")
    run.stop()
    return found


class _Run:
    def __init__(
        self, folder: Path, order: Order, progress: PhaseProgress, on_first: Callable[[Simulated], None]
    ) -> None:
        settings = order.settings
        self.folder, self.order, self.progress, self.on_first = folder, order, progress, on_first
        name = Path(settings.plant if settings.foreign is None else settings.foreign.name).name
        self.found = Findings(Simulated(name, settings, folder, 0.0 if order.alone else 4.0 * order.budget))
        self.now = ""
        self.programs = ProcessSet(folder / "logs" / "identify", {})
        self.identification: Child | None = None
        self.tested = _under_other_noise(settings)
        self.contenders: dict[str, list[tuple[RunSpec, RunSpec]]] = {}
        runs: list[MachineRun] = []
        if isinstance(settings, JointSettings) and settings.hardware == "emulator":
            runs.append(MachineRun(folder / "hw", settings.run("hw")))
        if not order.alone:
            sim, hw = (settings.run(side) for side in ("sim", "hw"))
            # Two simulations without noise would give the same recordings in lockstep.
            if hw.has_bridge and not isinstance(settings, JointSettings):
                first = repeat_settings(settings, 1).run("hw")
                runs.append(MachineRun(repeat_folder(folder, 1) / "hw", first))
            if IDENTIFIED in order.steps:
                runs.append(MachineRun(folder / IDENTIFIED / "hw", self.tested.run("hw")))
            if order.in_frequency:
                self.multisine, machine = order.multisine.specs(sim, hw)
                runs.append(MachineRun(folder / MULTISINE / "hw", machine))
            if order.wants(Layer.SAME_CHOICE):
                self._phase("choosing controllers", 0.1 * order.contenders)
                self.contenders = contender_specs(sim, hw, order.contenders, settings.noise.seed, order.seeds)
                runs += [
                    MachineRun(place_of(folder / RANKING, name, machine) / "bag", machine)
                    for name, specs in self.contenders.items()
                    for _, machine in specs
                ]
        self.machine = Machine(folder, runs)

    def measure(self, leaving: ExitStack) -> None:
        """Make the first recordings."""
        settings = self.order.settings
        if isinstance(settings, JointSettings):
            self._measure_joints(settings, leaving)
            return

        def run() -> None:
            try:
                run_thesis(
                    self.folder,
                    settings,
                    self.order.domain,
                    self.progress,
                    leaving,
                    on_idle=self.machine.resume,
                    rests=self.machine.rests,
                )
            except FaultError:
                self.machine.discard()
                raise

        run_undisturbed(run, self.folder, emulated=settings.is_emulated, report=self.progress.start_again)

    def _measure_joints(self, settings: JointSettings, leaving: ExitStack) -> None:
        """Make the first recordings of a plant of several joints: in lockstep, or as it is held upright."""
        words = {"sim": "the simulation", "hw": "the simulation in the hardware's place"}
        for side in SIDES:
            if settings.running(side) is not None:
                record_held(self.folder / side, settings, side, self.order.domain, self.progress, leaving)
        self.machine.start()
        stopped = ""
        for side in SIDES:
            if (side == "sim" and settings.running("sim") is None) or settings.foreign_of(side) is not None:
                self._phase(f"noise on {words[side]}", 0.1 * settings.noise.duration)
                record_simulation(self.folder / side, settings.run(side))
        if settings.hardware == "emulator":
            self._phase("noise on the hardware", 4.0 + 0.15 * settings.noise.duration)
            try:
                self.machine.wait(self.folder / "hw")
            except PlantStoppedError as error:
                stopped = f"went to {error.mode} ({error.reason})"
        require_upright(self.folder, settings, stopped)

    def compare_given(self) -> None:
        """Compare the given plant with the machine."""
        repeat = repeat_folder(self.folder, 1) / "hw"
        if any(run.bag == repeat for run in self.machine.runs):
            self._phase("repeat on the hardware", 2.0)
            self.machine.wait(repeat)
        self._phase("comparing", 2.0)
        alone = set(self.order.steps) == {Layer.SAME_RUN.key}
        deadline = self.found.deadline if alone else self.found.deadline.share(_SHARE)
        self._compare(self.found.given, None if self.order.alone else deadline)

    def _compare(self, plant: Simulated, deadline: Deadline | None) -> None:
        def take(compared: Mapping[str, Comparison]) -> None:
            first, settings = not plant.comparisons, plant.settings
            if (space := settings.running("sim")) is not None:
                unproved = recorded_difference(plant.folder / "sim", space, settings.plant)
                compared = {joint: replace(one, unproved=[unproved]) for joint, one in compared.items()}
            plant.comparisons = compared
            if first and plant is self.found.given:
                self.on_first(plant)

        decide(
            plant.folder,
            plant.settings,
            self.order.margins,
            deadline,
            joints=self.order.joints,
            on_repeat=lambda number, duration: self._phase(f"undecided: {duration:.0f} s more", 4.0 + 0.25 * duration),
            on_comparison=take,
            record=self._repeat,
        )

    def _repeat(self, folder: Path, settings: Settings, number: int, deadline: Deadline) -> None:
        bag = repeat_folder(folder, number) / "hw"
        run = MachineRun(bag, repeat_settings(settings, number).run("hw"))
        if run.spec.has_bridge and not bag.exists():
            with Machine(bag.parent, [run]) as machine:
                machine.start()
                machine.wait(bag, deadline)
        record_repeat(folder, settings, number, deadline)

    def carry_out(self, step: Callable[[], None]) -> None:
        """Carry out a step; after the first answer, a failed one leaves a note."""
        try:
            step()
        except BudgetSpentError:
            raise
        except PendulumError as error:
            if not self.found.given.comparisons:
                raise
            self.found.notes.append(f"{self.now[0].upper()}{self.now[1:]} failed: {error}".rstrip(".") + ".")

    def steps(self) -> Iterator[Callable[[], None]]:
        """Yield what follows the first layer of the given plant, each step when the one before is done."""
        if self.order.alone:
            return
        found = self.found
        if IDENTIFIED in self.order.steps and found.given.answer().mark is not Mark.YES:
            # In a program of its own, which can be ended at any time.
            yield self._begin_identification
        yield from self._simulate(found.given)
        if self.identification is not None:
            yield self._end_identification
        if found.identified is not None:
            yield from self._simulate(found.identified)
        if self.contenders:
            yield self._machine_contenders
            for plant in found.plants:
                yield partial(self._rank, plant)

    def _simulate(self, plant: Simulated) -> Iterator[Callable[[], None]]:
        if plant.comparisons and self.order.in_frequency:
            yield partial(self._frequencies, plant)
        if plant.comparisons and self.contenders:
            yield partial(self._simulate_contenders, plant)

    def _phase(self, name: str, seconds: float) -> None:
        self.now = name
        self.progress.phase(name, seconds)

    def stop(self) -> None:
        """End what still runs; leaving its context waits for that."""
        self.machine.interrupt()
        self.programs.stop()

    def _begin_identification(self) -> None:
        given = self.found.given
        self._phase("identifying the plant", 0.5)
        words = ["identify", *recordings_of(given.comparison), "--out", str(self.folder / PLANT_FILE), "--json"]
        if isinstance(given.settings, JointSettings):
            words += ["--plant", given.settings.plant]
        else:
            limit = load_plant(given.settings.design_plant).effort_limit
            words += ["--no-page", "--effort-limit", str(limit)]
        self.identification = self.programs.start(
            "identify", [sys.executable, "-m", "pendulum_bags", *words], ends_by_itself=True
        )

    def _end_identification(self) -> None:
        assert self.identification is not None
        deadline, file, place = self.found.deadline, self.folder / PLANT_FILE, self.folder / IDENTIFIED
        self._phase("identifying the plant", 12.0)
        # Loaded while waiting: it takes seconds.
        import_module("pendulum_bags.report.write")
        import_module("matplotlib.backends.backend_pdf")
        while (code := self.identification.process.poll()) is None:
            deadline.require()
            time.sleep(_POLL)
        self.programs.children.clear()
        if code != 0:
            self.found.given.refused = _refusal(self.identification)
            raise DataError(f"no plant was identified: {self.found.given.refused}")
        self._phase(f"comparing {PLANT_FILE}", 4.0)
        self.machine.wait(place / "hw", deadline)
        deadline.require(_ANALYSING)
        settings = _with_plant(self.tested, file)
        record_simulation(place / "sim", settings.run("sim"))
        if isinstance(settings, JointSettings):
            require_upright(place, settings)
        self.found.identified = Simulated(PLANT_FILE, settings, place, self.found.given.budget)
        self._compare(self.found.identified, deadline.share(_SHARE))

    def _frequencies(self, plant: Simulated) -> None:
        excited = 0.0 if plant is self.found.identified else self.order.recording_time(self.multisine.duration)
        self._phase(f"frequencies of {plant.name}", 3.0 + excited)
        own, machine = plant.folder / MULTISINE / "sim", self.folder / MULTISINE / "hw"
        self.found.deadline.require(_ANALYSING)
        record_simulation(own, _of(plant, self.multisine))
        self.machine.wait(machine, self.found.deadline)
        self.found.deadline.require(_ANALYSING)
        responses, _, ran = read_responses([own, machine])
        settings = plant.settings
        design = settings.plant
        if isinstance(settings, JointSettings):
            design = design_file(plant.folder, settings.plant)
        longer = plant.more(f"--periods {5 * self.order.multisine.periods}")
        plant.analysis = analyse_responses(responses, design, [*self.order.designs, *ran], longer=longer)
        write_numbers(plant.folder, plant.analysis)
        plant.add(*(one for one in plant.analysis.layers if self.order.wants(one.layer)))

    def _simulate_contenders(self, plant: Simulated) -> None:
        self._phase(f"{len(self.contenders)} controllers on {plant.name}", 0.6 * len(self.contenders))
        specs = {name: [_of(plant, sim) for sim, _ in both] for name, both in self.contenders.items()}
        simulate_contenders(plant.folder / RANKING, specs, partial(self.found.deadline.require, _SIMULATING))

    def _machine_contenders(self) -> None:
        runs = [theirs for both in self.contenders.values() for _, theirs in both]
        expected = sum(self.order.recording_time(run.duration) for run in runs)
        self._phase(f"{len(self.contenders)} controllers on the hardware", expected)
        for name, both in self.contenders.items():
            for _, spec in both:
                place, failure = place_of(self.folder / RANKING, name, spec), ""
                try:
                    self.machine.wait(place / "bag", self.found.deadline)
                except PlantStoppedError as error:
                    failure = str(error)
                keep_run(place, name, spec, failure)

    def _rank(self, plant: Simulated) -> None:
        self._phase(f"ranking on {plant.name}", 1.0)
        self.found.deadline.require(_SIMULATING)
        plant.ranking, case = rank_folders(plant.folder / RANKING, self.folder / RANKING)
        write_json(plant.folder / "ranking.json", plant.ranking.to_json())
        words = Words(f"record more seeds: {plant.more(f'--seeds {4 * self.order.seeds}')}", "")
        if isinstance(plant.settings, JointSettings):
            words = replace(words, cost=COST)
        plant.add(same_choice(plant.ranking, words, case=case))


def _undefined(settings: Settings) -> list[LayerResult]:
    if not isinstance(settings, JointSettings):
        return []
    if not settings.can_repeat:
        why = "Not measured: a plant that runs already moves once, under one controller."
        return [LayerResult(layer, Mark.NOT_MEASURED, why) for layer in Layer if layer is not Layer.SAME_RUN]
    driven = len(load_mechanism(settings.plant).effort_limits)
    why = f"Not defined: {driven} joints are driven, and frequencies are measured where one is."
    layers = (Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS) if driven > 1 else ()
    return [LayerResult(layer, Mark.NOT_MEASURED, why) for layer in layers]


def _under_other_noise(settings: _Settings) -> _Settings:
    noise = settings.noise
    other = replace(noise, seed=noise.seed + _TEST_SEED_STEP, duration=max(SHORTEST, noise.duration))
    return replace(settings, noise=other)


def _with_plant(settings: Settings, file: Path) -> Settings:
    """Return the settings for a plant file under the controller of the given plant."""
    if isinstance(settings, JointSettings):
        settings = replace(settings, machine=settings.plant_of("hw"))
    return replace(settings, plant=str(file), design=settings.design_plant, simulation="", mapping="")


def _of(plant: Simulated, spec: RunSpec) -> RunSpec:
    """Return a run of the given plant's simulation as one of another plant with the same controller."""
    settings = plant.settings
    return replace(
        spec, plant=settings.plant, method=settings.method, simulation=settings.simulation, mapping=settings.mapping
    )


def _refusal(identification: Child) -> str:
    try:
        return str(json.loads(identification.log.read_text(encoding="utf-8"))["sentences"][0])
    except (ValueError, LookupError, TypeError):
        return identification.last_words(1).removeprefix("error: ")
