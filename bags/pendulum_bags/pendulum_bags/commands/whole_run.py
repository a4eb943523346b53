"""A run of the whole answer on the command line: its options, its progress, and what it prints."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from pendulum_bags.experiments.new_run import new_run
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.runs.run_folder import versions, write_json
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_bags.comparison import Comparison
    from pendulum_bags.verdict import Answer
    from pendulum_bags.whole.carry_out import Findings, Order, Simulated

__all__ = [
    "Budget",
    "Contenders",
    "Design",
    "Only",
    "Periods",
    "Seeds",
    "SignalPeriod",
    "budget_of",
    "run_whole",
    "steps_of",
]

Only = Annotated[
    list[str] | None,
    typer.Option(
        help="Measure this alone: same_run, identified, same_plant, which_controllers or same_choice; may be given "
        "again. The layer same_run comes first in any case."
    ),
]
Budget = Annotated[
    float | None,
    typer.Option(
        help="Longest wall time of what follows the first run, where hardware is emulated: repeats, identification, "
        "further layers, the page; 0 for that run alone. By default 120 for 6 contenders under 3 seeds (240 with "
        "several joints), and 1.5 (5) for each further run of the ranking [s].",
        min=0.0,
    ),
]
Contenders = Annotated[
    int, typer.Option(help="Controllers of the layer same_choice; each differs from all others.", min=3, max=32)
]
Seeds = Annotated[int, typer.Option(help="Seeds of the noise under which each of these runs.", min=1, max=100)]
Periods = Annotated[
    int, typer.Option(help="Periods of the multisine that are averaged; one more settles.", min=3, max=1000)
]
SignalPeriod = Annotated[
    float, typer.Option(help="Length of one period [s]; its inverse is the lowest frequency.", min=0.5, max=100.0)
]
Design = Annotated[
    list[str] | None,
    typer.Option(
        help="Design to certify for the machine: LQR weights or a gain, 'q=100,0.01 r=0.1' or 'k=33,0.2', positions "
        "before velocities; may be given again. Default: four LQRs."
    ),
]


def budget_of(given: float | None, contenders: int, seeds: int, *, joints: bool = False) -> float:
    """Return the budget of a run: the given one, or what its ranking needs [s]."""
    usual, each = (240.0, 5.0) if joints else (120.0, 1.5)
    return usual + each * max(0, contenders * seeds - 18) if given is None else given


def steps_of(only: Sequence[str] | None, budget: float) -> Sequence[str]:
    """Return the steps of a run; a ParameterError for one that is unknown or has no time."""
    from pendulum_bags.whole.carry_out import STEPS

    if unknown := set(only or ()) - set(STEPS):
        raise ParameterError(f"--only is {min(unknown)}; expected one of {', '.join(STEPS)}")
    if budget <= 0.0 and (further := set(only or ()) - set(STEPS[:1])):
        raise ParameterError(f"--only {min(further)} needs time after the run; expected --budget above 0 s")
    return only or STEPS


def run_whole(
    out: Path | None,
    experiment: str,
    order_in: Callable[[Path], Order],
    *,
    json_output: bool,
    remark: Callable[[Path], str] = lambda folder: "",
) -> None:
    """Carry out a run into ``out`` or a new folder, print its answer and write its page."""
    from pendulum_bags.whole.carry_out import carry_out
    from pendulum_bags.whole.page import leave_files_out, write_whole_report
    from pendulum_bags.whole.words import whole_answer

    console = make_console(stderr=json_output, highlight=False)
    with new_run(out, experiment, console) as folder, ExitStack() as leaving:
        order = order_in(folder)
        started = time.monotonic()
        with PhaseProgress(order.expected_wall_time, console) as progress:
            found = carry_out(folder, order, progress, leaving, partial(_print_first, console, json_output=json_output))
            leave_files_out(found)
            answer, answers = whole_answer(found)
            summary = _summary(experiment, found, answer, answers)
            write_json(folder / "summary.json", summary)
            # Before the page: Ctrl-C then loses no answer.
            if json_output:
                print(json_text(summary), flush=True)
            else:
                _print_whole(console, found, answer, answers)
            progress.phase("writing the report", 6.0)
            try:
                write_whole_report(folder, summary, found, answer, answers)
            except KeyboardInterrupt:
                if found.interrupted:
                    raise
                found.interrupted = True
                write_whole_report(folder, summary, found, answer, answers)
        console.print(f"\nreport  {folder / 'report.html'}\nbags    {folder / 'sim'}, {folder / 'hw'}", soft_wrap=True)
        if text := remark(folder):
            console.print(text, soft_wrap=True)
        console.print(f"({time.monotonic() - started:.0f} s)")
        if found.interrupted:
            raise KeyboardInterrupt


def _summary(experiment: str, found: Findings, answer: Answer, answers: Sequence[Answer]) -> dict[str, Any]:
    from pendulum_bags.whole.carry_out import IDENTIFIED

    given, *others = found.plants
    joints = {joint: one.to_json() for joint, one in given.comparisons.items()}
    settings = given.settings
    return {
        **joints.get("", {"joints": joints}),
        # The requested seed; the comparison may have that of a repeat.
        "experiment": experiment,
        "hardware": settings.hardware,
        "seed": settings.noise.seed,
        "strategy": settings.strategy,
        "versions": versions(),
        "answer": answer.to_json(),
        IDENTIFIED: {"plant": others[0].settings.plant, "answer": answers[1].to_json()} if others else None,
        "left_out": found.notes,
    }


def _print_first(console: Console, plant: Simulated, *, json_output: bool) -> None:
    if not json_output:
        if "" in plant.comparisons:
            _print_summary(console, plant.comparison, plant.settings.hardware)
        _print_tests(console, plant)
    console.print(plant.answer().sentence, style="bold", highlight=False, markup=False)


def _print_tests(console: Console, plant: Simulated) -> None:
    from pendulum_bags.verdict.terminal import print_tests

    for joint, comparison in plant.comparisons.items():
        if joint:
            console.print(f"Joint {joint}", style="bold")
        print_tests(console, comparison)


def _print_whole(console: Console, found: Findings, answer: Answer, answers: Sequence[Answer]) -> None:
    from pendulum_bags.frequency_response.designs import designs_table
    from pendulum_bags.verdict.terminal import layers_table, print_sentence

    for plant, own in zip(found.plants, answers, strict=True):
        if plant is found.identified:
            console.print(
                f"\n{plant.name}, identified from these recordings, under noise of another seed", style="bold"
            )
            _print_tests(console, plant)
        if plant.analysis is not None and plant.analysis.designs:
            console.print(designs_table(plant.analysis.designs))
        console.print(layers_table(own, f"The layers of the answer, {plant.name}"))
    for note in found.notes:
        console.print(note, style="yellow", highlight=False, markup=False)
    print_sentence(console, answer)


def _print_summary(console: Console, comparison: Comparison, hardware: str) -> None:
    from pendulum_bags.experiments.settings import is_named
    from pendulum_bags.figures.terminal_table import plants_table
    from pendulum_bags.runs.run_data import timing_warning

    emulated, summary = comparison.is_emulated, comparison.to_json()
    title = f"Simulation and {'emulated hardware' if emulated else 'hardware'} under the same noise"
    if summary["runs"] > 1:
        title += f", all samples of {summary['runs']} runs"
    plants = summary["plants"]
    surrogate = "emulator" if is_named(hardware) else "a simulation"
    headings = [f"hw ({surrogate})" if name == "hw" and emulated else name for name in plants]
    rows = (
        (r"noise recorded \[s]", "duration_s", ".1f"),
        (r"rate \[Hz]", "rate_hz", ".1f"),
        ("missed deadlines", "missed_deadlines", ".0f"),
        (r"std of theta \[rad]", "std_theta", ".5f"),
        (r"std of theta' \[rad/s]", "std_theta_dot", ".5f"),
        (r"max |u| \[N m]", "max_abs_u", ".3f"),
    )
    console.print(plants_table(title, headings, list(plants.values()), rows))
    if "sim_500hz" in plants:
        console.print("(sim_500hz: simulation by the thesis's own protocol, with new noise every 2 ms)")
    if warning := timing_warning(plants):
        console.print(warning, style="bold red")
    for note in summary["notes"]:
        console.print(note, style="yellow", markup=False)
