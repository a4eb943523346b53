"""The first layer: the tests of one run, or of several alike, in plain words."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pendulum_bags.comparison import Comparison, EquivalenceTest, Outcome
from pendulum_bags.runs.case import Case
from pendulum_bags.runs.next_test import (
    measurement_of,
    model_options,
    next_test_of,
    plant_file_of,
    question_of,
    with_budget,
)
from pendulum_bags.runs.run_folder import REPEATS
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict.layers import Evidence, Layer, LayerResult, Mark

__all__ = [
    "case_of",
    "how_to_measure",
    "in_words",
    "layers_of_files",
    "recordings_of",
    "same_run_layer",
    "seen_note",
    "simulated_plant",
]

_MARKS = {Outcome.EQUIVALENT: Mark.YES, Outcome.DIFFERENT: Mark.NO, Outcome.UNDECIDED: Mark.UNDECIDED}
_MOST_REASONS = 3
"""Reasons that a sentence has with their size; it names the rest, and the table has them all."""
_MOST_RECORDED = 1800.0
"""Longest further recordings that are recommended [s]."""
_MOST_RECORDINGS = 4
"""Most recordings in the command that identifies the plant."""


def same_run_layer(comparison: Comparison, *, more: str = "", refused: str = "") -> LayerResult:
    """Return the first layer of a comparison.

    ``more`` is how to record more, such as ``make experiment ARGS="--budget 120"``; by default the number of runs.
    ``refused`` is why no plant could be identified, as a sentence, or empty.
    """
    verdict = comparison.verdict
    tests = verdict.tests
    mark = _MARKS[verdict.outcome]
    runs = "this run" if len(comparison.tested) == 1 else f"these {len(comparison.tested)} runs"
    whose = verdict.margins.whose
    if mark is Mark.YES:
        reason = f"in {runs} simulation and the hardware move alike within {whose}, in all {len(tests)} tests"
        finite = [test for test in tests if math.isfinite(test.interval.estimate)]
        reason += f"; nearest to its margin, {in_words(max(finite, key=_beyond))}" if finite else ""
        steps: Sequence[str] = ()
    elif mark is Mark.NO:
        failed = sorted((test for test in tests if test.outcome is Outcome.DIFFERENT), key=_beyond, reverse=True)
        once = _each_once(failed)
        further = ", ".join(test.quantity for test in once[_MOST_REASONS:])
        reason = "; ".join(in_words(test) for test in once[:_MOST_REASONS])
        reason += f"; also beyond its margin: {further}" if further else ""
        steps = _remedies(comparison, failed, refused)
    else:
        reason = verdict.sentence.removeprefix("Undecided: ").rstrip(".")
        if tests and comparison.is_paired and not comparison.unlike_references:
            open_tests = [test for test in tests if test.outcome is Outcome.UNDECIDED]
            reason = f"{runs} cannot decide yet on {', '.join(test.quantity for test in open_tests)}"
        steps = (_what_it_takes(comparison, more),)
    sentence = f"{reason[0].upper()}{reason[1:]}."
    evidence = tuple(map(_evidence, tests))
    return LayerResult(Layer.SAME_RUN, mark, sentence, evidence, steps, reason=reason, case=case_of(comparison))


def case_of(comparison: Comparison) -> Case:
    """Return the plants of a comparison; a DataError if the runs of one side are of two plants."""
    return Case.of(
        [run_record(pair.simulation.metadata) for pair in comparison.pairs],
        [run_record(pair.hardware.metadata) for pair in comparison.pairs],
    )


def how_to_measure(comparison: Comparison) -> dict[Layer, str]:
    """Return the commands that measure the other layers of a comparison's own plants."""
    first = comparison.pairs[0]
    bags = [one.source or name for one, name in ((first.simulation, "SIM"), (first.hardware, "HW"))]
    records = _records(comparison)
    if first.hardware.joint:
        plant = shlex.quote(simulated_plant(comparison))
        return dict.fromkeys(
            Layer, with_budget(records) or f"python -m pendulum_bags experiment joints --plant {plant}"
        )
    in_frequency = measurement_of(records, "frequency_response") or (
        f"python -m pendulum_bags frequency_response {' '.join(map(shlex.quote, bags))} --out FOLDER"
        if not (first.simulation.is_whole or first.hardware.is_whole)
        else "record both plants under a disturbance (python -m pendulum_bags frequency_response SIM HW --out FOLDER)"
    )
    choice = measurement_of(records, "ranking") or (
        "record several controllers on both plants (python -m pendulum_bags ranking FOLDER)"
    )
    return {Layer.SAME_PLANT: in_frequency, Layer.WHICH_CONTROLLERS: in_frequency, Layer.SAME_CHOICE: choice}


def layers_of_files(comparison: Comparison) -> list[LayerResult]:
    """Return the other layers of a comparison of recordings, each with what the recordings lack for it."""
    runs = comparison.pairs[0].simulation, comparison.pairs[0].hardware
    lacks = []
    for run in runs:
        added = run.recorded or (run.followed if run.followed and len(set(run.followed.value)) > 1 else None)
        what = [name for name, signal in (("disturbance", added), ("input", run.applied)) if signal is None]
        if run.applied is not None and run.window.effort_unit not in {"N m", "N"}:
            what.append(f"input in N m (it is in {run.window.effort_unit})")
        if what:
            lacks.append(f"{Path(run.source).name} has no {' and no '.join(what)}")
    names = " ".join(shlex.quote(run.source) for run in runs)
    response = (
        f"Not computed: it needs what was added to the torque, and the torque, of both plants, and {'; '.join(lacks)}."
        if lacks
        else f"Not computed yet: python -m pendulum_bags frequency_response {names} --plant FILE does, for that plant."
    )
    choice = (
        "Not computed: it needs runs of several controllers on both plants (python -m pendulum_bags ranking FOLDER)."
    )
    sentences = {Layer.SAME_PLANT: response, Layer.WHICH_CONTROLLERS: response, Layer.SAME_CHOICE: choice}
    return [LayerResult(layer, Mark.NOT_MEASURED, sentence) for layer, sentence in sentences.items()]


def in_words(test: EquivalenceTest) -> str:
    """Return a test's result as a clause, with its margin in the same quantity and unit."""
    value = test.interval.estimate
    unit = "" if test.unit == "-" else f" {test.unit}"
    allowed = f"{test.high if value >= 0.0 or not math.isfinite(test.low) else -test.low:.3g}{unit} allowed"
    if test.quantity == "delay":
        when = "later" if value >= 0.0 else "earlier"
        return f"the hardware responds {abs(value):.3g}{unit} {when} than the simulation ({allowed})"
    if test.quantity.startswith("mean "):
        what = test.quantity.removeprefix("mean ").split(" ", maxsplit=1)[0]
        way = "higher" if value >= 0.0 else "lower"
        return f"the hardware's mean {what} is {abs(value):.3g}{unit} {way} ({allowed})"
    if test.quantity.startswith("spread of "):
        what = f"the hardware's {test.quantity.partition(' (')[0].removesuffix(' difference')} is"
        if unit:
            return f"{what} {abs(value):.3g}{unit} {'larger' if value >= 0.0 else 'smaller'} ({allowed})"
        if value >= 2.0:
            return f"{what} {value:.3g} times as large ({test.high:.3g} times allowed)"
        way, bound = ("larger", test.high) if value >= 1.0 else ("smaller", test.low)
        sizes = [f"{100.0 * abs(one - 1.0):.3g} %" for one in (value, bound)]
        return f"{what} {sizes[0]} {way} ({sizes[1]} allowed; ratio {value:.3g})"
    if unit == " %":
        return f"the {test.quantity} is {value:.3g} % of the hardware's spread ({allowed})"
    return f"the {test.quantity} is {value:.3g}{unit} ({allowed})"


def seen_note(comparison: Comparison) -> str:
    """Return why the tests' ratios of spreads are not those over all samples, and what those are."""
    plants = comparison.plants
    simulation = plants["sim"] if comparison.is_tested_in_pairs else plants.get("sim_500hz", plants["sim"])
    what = "position" if comparison.pairs[0].simulation.window.slides else "angle"
    ratios = " and ".join(
        f"{plants['hw'][key] / simulation[key]:.3g} ({name})"
        for key, name in (("std_theta", what), ("std_theta_dot", "velocity"))
        if simulation[key] > 0.0
    )
    why = ", since its velocity is seen at those phases of the noise only" if comparison.is_tested_in_pairs else ""
    return (
        f"The tests take spreads and distances {comparison.seen}{why}. Over all samples the ratios of std, hardware "
        f"per simulation, are {ratios}."
    )


def _evidence(test: EquivalenceTest) -> Evidence:
    unit = "" if test.unit == "-" else test.unit
    interval = test.interval
    margin = test.margin_text().removeprefix("margin ")
    expected = f"below {margin}" if not math.isfinite(test.low) else margin
    return Evidence(
        test.quantity,
        unit,
        interval.estimate,
        interval.low,
        interval.high,
        f"{expected} {unit}".rstrip(),
        _MARKS[test.outcome],
        f"{interval.title}, {interval.blocks} independent blocks",
    )


def _beyond(test: EquivalenceTest) -> float:
    value = test.interval.estimate
    if math.isfinite(test.low) and not math.isclose(test.low, -test.high):
        return abs(math.log(max(value, 1e-9))) / math.log(test.high)
    return abs(value) / test.high


def simulated_plant(comparison: Comparison) -> str:
    """Return the simulated plant, as commands name it; MECHANISM if unknown."""
    return str(run_record(comparison.pairs[0].simulation.metadata).get("plant", "MECHANISM"))


def _each_once(failed: Sequence[EquivalenceTest]) -> list[EquivalenceTest]:
    plain = [test for test in failed if not test.quantity.startswith("distance")]
    return plain or list(failed)


def _remedies(comparison: Comparison, failed: Sequence[EquivalenceTest], refused: str) -> tuple[str, ...]:
    steps = []
    names = {test.quantity for test in failed}
    shapes = {name for name in names if name != "delay" and not name.startswith("mean")}
    source = " ".join(map(shlex.quote, recordings_of(comparison))) or "RUN/hw"
    late = next((test for test in failed if test.quantity == "delay"), None)
    foreign = _foreign_simulation(comparison)
    moves_otherwise = any(name.startswith("spread") or "less the delay" in name for name in shapes)
    if moves_otherwise and refused:
        steps.append(f"No plant could be identified from these recordings: {refused.rstrip('.')}.")
    elif moves_otherwise:
        fitted = "" if foreign else plant_file_of(_records(comparison))
        out = _next_file(fitted)
        model, again = model_options(_records(comparison)) if foreign else ("", "")
        identify = f"python -m pendulum_bags identify {source} {model or f'--out {shlex.quote(out)}'}"
        if not model and comparison.pairs[0].hardware.joint:
            identify = f"{identify} --plant {shlex.quote(simulated_plant(comparison))}"
        begin = "Identify the plant from what the hardware did"
        if fitted:
            begin = (
                f"The simulation had {fitted} already. Identify once more, with the recordings behind that file added"
            )
        if model:
            then = f"measure again with {again}."
        else:
            then = f"carry its values over to {foreign}." if foreign else _test_of_the_plant(comparison, out)
        steps.append(f"{begin} ({identify}), then {then}")
        if fitted:
            steps.append(
                "If that is no too, no parameters suffice: the model lacks what the hardware does. Measure which "
                f"designs are safe all the same ({how_to_measure(comparison)[Layer.WHICH_CONTROLLERS]})."
            )
    elif late is not None and foreign:
        steps.append(f"Give {foreign} {_late(late)}; measure again.")
    elif late is not None:
        steps.append(
            f"Give the simulated plant {_late(late)}: transport_delay in its plant file; "
            "then measure again with --plant."
        )
    if any(name.startswith("mean") for name in names):
        steps.append("Check for an offset: angle_offset or torque_offset in the plant file, or dry friction.")
    return tuple(steps)


def recordings_of(comparison: Comparison) -> list[str]:
    """Return the compared recordings to identify the hardware from, the first run before its repeats."""
    sources = [pair.hardware.source for pair in comparison.pairs if pair.hardware.source]
    repeated = [path.parents[2] / path.name for path in map(Path, sources) if path.parts[-3:-2] == (REPEATS,)]
    runs = [str(path) for path in repeated if path.is_dir()]
    return list(dict.fromkeys([*runs, *sources]))[:_MOST_RECORDINGS]


def _records(comparison: Comparison) -> list[Mapping[str, Any]]:
    return [run_record(run.metadata) for pair in comparison.pairs for run in (pair.hardware, pair.simulation)]


def _next_file(fitted: str) -> str:
    if not fitted:
        return "plant.yaml"
    path = Path(fitted)
    stem, _, number = path.stem.rpartition("_")
    following = f"{stem}_{int(number) + 1}" if stem and number.isdecimal() else f"{path.stem}_2"
    return str(path.with_name(f"{following}{path.suffix}"))


def _test_of_the_plant(comparison: Comparison, plant: str) -> str:
    command = next_test_of(_records(comparison), plant, [pair.hardware.source for pair in comparison.pairs])
    if not command:
        return f"simulate and design with --plant {shlex.quote(plant)}, and compare again under noise of another seed."
    return (
        f"test that file under other noise ({command}). MODEL INCOMPLETE, if identify reports it, is no reason to "
        "stop: the parameters compensate for what the model lacks, and the test shows whether they suffice for this "
        f"controller.{question_of(command)}"
    )


def _late(test: EquivalenceTest) -> str:
    value = test.interval.estimate
    return f"{abs(value):.3g} {test.unit} {'more' if value >= 0.0 else 'less'} delay than now"


def _foreign_simulation(comparison: Comparison) -> str:
    run = comparison.pairs[0].simulation
    if run.of_file:
        return f"the simulation of {Path(run.source).name}"
    simulation = run_record(run.metadata).get("simulation")
    return str(simulation.get("name", "")) if isinstance(simulation, Mapping) else ""


def _what_it_takes(comparison: Comparison, more: str) -> str:
    if comparison.advice:
        return comparison.advice
    if comparison.unlike_references:
        return (
            "Hold a set-point while both plants are compared, as lqr does with the same q and r; or record each side "
            "in lockstep (experiment lockstep --side), where reference and noise begin together."
        )
    if not comparison.is_paired:
        return "Record both plants under one and the same disturbance (make experiment does)."
    runs = comparison.verdict.more_runs
    if any(math.isnan(test.interval.estimate) for test in comparison.verdict.tests):
        return "Record both under a disturbance that moves them more: they are too dissimilar to show a delay."
    if runs is None:
        return "More runs would hardly decide it: a difference sits on its margin; state another margin, or mend it."
    duration = comparison.pairs[0].hardware.window.duration
    what = f"about {runs} more run{'s' if runs != 1 else ''} of {duration:.0f} s"
    if runs * duration > _MOST_RECORDED:
        return (
            f"{what[0].upper()}{what[1:]} would decide it ({runs * duration / 3600.0:.2g} h): a difference sits near "
            "its margin; state another margin, or mend it."
        )
    if comparison.operating is not None:
        return f"Record {what} of the machine under the same {comparison.shared}."
    return f"Record {what}" + (f": {more}." if more else ", each with a seed of its own.")
