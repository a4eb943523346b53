"""``experiment study`` and the studies that have a name: from a file to a table."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import TextColumn

from pendulum_bags.experiments.plant_options import (
    AcceptDifferences,
    MappingFile,
    SimulatedPlant,
    Simulation,
    Strategy,
    equation_file,
)
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counting_bar, resumable
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_msgs_py.programs.typed_commands import as_typed

if TYPE_CHECKING:
    from pendulum_bags.studies.study_file import Study, StudyRun

__all__ = ["add_commands"]

Out = Annotated[
    Path | None,
    out_option(
        "Folder of the study; an interrupted study resumes there, and one that was given more seeds or plants "
        "carries out those. Default: bags/runs/<name>."
    ),
]
Workers = Annotated[
    int,
    typer.Option(
        help="Runs at once, each in a ROS domain of its own; 0: one more than cores, one alone in real time.",
        min=0,
        max=256,
    ),
]
Retry = Annotated[bool, typer.Option("--retry-failed", help="Carry out again the runs that failed.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show matrix, time and disk that it needs; run nothing.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before each run that moves a real machine.")]
Seeds = Annotated[int, typer.Option(help="Number of seeds in place of the file's; 0 keeps those.", min=0)]

_SHOWN = (
    "rms_error",
    "settling_time",
    "overshoot",
    "ise",
    "itae",
    "max_effort",
    "effort_energy",
    "smoothness",
    "success",
)

_SHIPPED = {
    "pid_vs_lqr": (
        "Compare PID and LQR on simulation and hardware under the same noise and the same step, over 20 seeds.",
        "--out /tmp/pid_vs_lqr --workers 2",
    ),
    "random_start": (
        "Regulate from random starts on simulation and hardware, the thesis's future work.",
        "--out /tmp/random --seeds 5",
    ),
    "ranking": (
        "Rank every controller and twenty gains on simulation and hardware: would the simulation have picked right?",
        "--out /tmp/ranking --workers 2",
    ),
}
"""Shipped studies whose number of seeds may be chosen, with their help and an example."""


def add_commands(app: typer.Typer) -> None:
    """Add the studies to the command line of ``experiment``."""
    app.command(name="study")(study)
    app.command(name="run", hidden=True)(run)
    app.command(name="strategies")(strategies)
    for name, (what, example) in _SHIPPED.items():
        app.command(name=name)(_shipped(name, what, example))


def study(
    file: Annotated[str, typer.Argument(help="Study file (YAML), or the name of a shipped study.")],
    out: Out = None,
    workers: Workers = 0,
    seeds: Seeds = 0,
    retry_failed: Retry = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    json_output: Json = False,
) -> None:
    """Carry out a study: plants x controllers x disturbances x set-points x starts x seeds.

    Shipped: thesis, pid_vs_lqr, ranking, strategies, inertia_damping, gravity, random_start.

    Example: python -m pendulum_bags experiment study random_start --out /tmp/random --workers 2
    """
    _study(file, out, workers, seeds, retry_failed, dry_run, json_output, yes=yes)


def strategies(
    out: Out = None,
    workers: Workers = 0,
    retry_failed: Retry = False,
    dry_run: DryRun = False,
    json_output: Json = False,
) -> None:
    """Show how the actuator's strategy changes the plant that one and the same LQR sees.

    Example: python -m pendulum_bags experiment strategies --out /tmp/strategies
    """
    _study("strategies", out, workers, 0, retry_failed, dry_run, json_output)


def _shipped(name: str, what: str, example: str) -> Callable[..., None]:
    """Return the command of a shipped study."""

    def command(
        out: Out = None,
        workers: Workers = 0,
        seeds: Seeds = 0,
        plant: SimulatedPlant = None,
        simulation: Simulation = "",
        mapping: MappingFile = None,
        accept_differences: AcceptDifferences = False,
        strategy: Strategy = "direct_pwm",
        retry_failed: Retry = False,
        dry_run: DryRun = False,
        json_output: Json = False,
    ) -> None:
        from pendulum_bags.experiments.run_spec import absolute_plant
        from pendulum_bags.experiments.simulation import ForeignSimulation

        out = out or Path("bags", "runs", name)
        foreign = ForeignSimulation(simulation, str(mapping or "")) if simulation else None
        own = bool(plant or simulation or strategy != "direct_pwm")
        if foreign is not None and plant is None:
            plant = equation_file(foreign, out, accept_differences=accept_differences)
        design = {"design_plant": absolute_plant(plant or "thesis")}
        sim = {"plant": design["design_plant"], **design}
        if foreign is not None:
            sim |= foreign.absolute()
        _study(
            name,
            out,
            workers,
            seeds,
            retry_failed,
            dry_run,
            json_output,
            plants={"sim": sim, "hw": {**design, "strategy": strategy}} if own else None,
        )

    command.__doc__ = f"{what}\n\nExample: python -m pendulum_bags experiment {name} {example}"
    return command


def run(
    spec: Annotated[Path, typer.Argument(help="JSON file with one run, or with a list of runs and their bags.")],
    bag: Annotated[Path | None, typer.Option(help="Folder of the bag of one run; it must not exist.")] = None,
) -> None:
    """Carry out one run of a study, or runs one after the other; programs start each other this way.

    Example: python -m pendulum_bags experiment run run.json --bag /tmp/bag
    """
    from pendulum_bags.experiments.host_pool import shared_pool
    from pendulum_bags.experiments.lockstep import record_run
    from pendulum_bags.experiments.machine import record_listed
    from pendulum_bags.experiments.run_spec import RunSpec

    if bag is None:
        record_listed(spec)
        return
    try:
        values = json.loads(spec.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ParameterError(f"run file {spec} cannot be read: {error}") from error
    record_run(bag, RunSpec.from_json(values), hosts=shared_pool())


def _study(
    source: str,
    out: Path | None,
    workers: int,
    seeds: int,
    retry_failed: bool,
    dry_run: bool,
    json_output: bool,
    *,
    yes: bool = False,
    plants: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    from pendulum_bags.experiments.operator import ask_yes, real_machine
    from pendulum_bags.studies.results import collect, write_table
    from pendulum_bags.studies.runner import StudyProgress, default_workers, open_study_folder, run_study
    from pendulum_bags.studies.study_file import load_study

    found = load_study(source, seeds=range(1, seeds + 1) if seeds else None, plants=plants)
    workers = workers or default_workers(found)
    if found.realtime and workers > 1:
        raise ParameterError(f"workers is {workers}; expected 1: runs in real time must not share the machine")
    console = make_console(stderr=json_output, highlight=False)
    if dry_run:
        _print_matrix(console, found, workers)
        return
    folder = out or Path("bags", "runs", found.name)
    found = open_study_folder(folder, found)
    for sentence in found.left_out:
        console.print(f"left out: {as_typed(sentence)}", markup=False)
    printed = -1

    def show(progress: StudyProgress) -> None:
        nonlocal printed
        bar.update(task, completed=progress.done, remaining=_duration(progress.remaining))
        if not console.is_terminal and progress.done != printed:
            printed = progress.done
            failed = f", {progress.failed} failed" if progress.failed else ""
            console.print(f"{progress.done} of {progress.total} runs{failed}, {_duration(progress.remaining)} left")

    def ask(run: StudyRun) -> None:
        bar.stop()
        plan = f"Run {run.number} of {len(found.runs)}, {run.name}: {' '.join(run.arguments)}"
        machine = real_machine("hebi", run.lab)
        assert machine is not None
        ask_yes(machine, plan, make_console(stderr=True, highlight=False), yes=yes)
        bar.start()

    if any(run.lab for run in found.runs) and workers > 1:
        raise ParameterError(f"workers is {workers}; expected 1: there is one machine")
    with resumable(console, folder), counting_bar(console, TextColumn("{task.fields[remaining]} left")) as bar:
        task = bar.add_task(found.name, total=len(found.runs), remaining="")
        end = run_study(folder, found, workers=workers, retry_failed=retry_failed, on_progress=show, before_machine=ask)
    records = collect(folder, found)
    write_table(folder / "runs.csv", records)
    for record in records:
        if record["status"] == "failed":
            console.print(f"run {record['number']} failed: {record['reason']}", markup=False)
    if end.failed == end.total:
        raise FaultError(f"all {end.total} runs failed; {folder}/runs holds their logs")
    result, print_results = _analyse(folder, found, records)
    if json_output:
        print(json_text(result))
    else:
        print_results(console)
        if found.analysis == "ranking":
            console.print(f"page    {folder / 'ranking.html'}", soft_wrap=True)
        wall = sum(record["wall_s"] for record in records)
        simulated = sum(record["simulated_s"] or 0.0 for record in records)
        of_them = f", {simulated:.0f} s simulated" if simulated else ""
        console.print(
            f"\nstudy   {folder}\ntable   {folder / 'runs.csv'}\n({len(records)} runs, {wall:.0f} s of runs{of_them})",
            soft_wrap=True,
        )
    if end.failed:
        console.print(f"{end.failed} of {end.total} runs failed; --retry-failed carries them out again")
        raise typer.Exit(1)


def _analyse(
    folder: Path, found: Study, records: Sequence[dict[str, Any]]
) -> tuple[dict[str, Any], Callable[[Console], None]]:
    from pendulum_bags.runs.run_folder import write_json
    from pendulum_bags.studies import pid_vs_lqr, pooled, strategies
    from pendulum_bags.studies.results import group_runs, groups_to_json

    result: dict[str, Any] = {"study": found.name, "runs": len(records), "left_out": list(found.left_out)}
    print_results: Callable[[Console, Any], None]
    if found.experiment == "run":
        key, print_results = "groups", _print_groups
        result[key] = groups_to_json(group_runs(records))
    else:
        key, print_results = "pooled", pooled.print_table
        result[key] = pooled.analyse(folder, found, records)
    if found.analysis == "strategies":
        key, print_results = "strategies", strategies.print_table
        result[key] = strategies.analyse(folder, found)
    elif found.analysis == "pid_vs_lqr":
        key, print_results = "pid_vs_lqr", pid_vs_lqr.print_table
        result[key] = pid_vs_lqr.analyse(folder, found, records)
    elif found.analysis == "ranking":
        from pendulum_bags.ranking.collect import collect_contenders
        from pendulum_bags.ranking.present import print_ranking, write_ranking
        from pendulum_bags.ranking.ranking import rank

        contenders, case = collect_contenders([folder])
        ranked = rank(contenders)
        notes = [f"Left out: {sentence}." for sentence in found.left_out]
        write_ranking(folder, ranked, notes=notes, emulated=all(one.emulated for one in contenders), case=case)
        key, print_results = "ranking", lambda console, _: print_ranking(console, ranked)
        result[key] = ranked.to_json()
    write_json(folder / "results.json", result)
    return result, lambda console: print_results(console, result[key])


def _print_matrix(console: Console, found: Study, workers: int) -> None:
    from pendulum_bags.studies.study_file import AXES

    console.print(f"{found.name}: {found.description}" if found.description else found.name, markup=False)
    table = WholeTable("axis", "values")
    for axis in (*AXES, "seed", "repeat"):
        values = list(dict.fromkeys(_label(run.labels[axis]) for run in found.runs))
        if values == [""]:
            continue  # this experiment has no such axis
        text = ", ".join(values[:8]) + (f", ... ({len(values)})" if len(values) > 8 else "")
        table.add_row(axis, text)
    console.print(table)
    seconds = sum(run.seconds for run in found.runs) / max(1, min(workers, len(found.runs)))
    size = sum(run.bytes for run in found.runs) / 1e6
    runs = "1 run" if len(found.runs) == 1 else f"{len(found.runs)} runs"
    console.print(f"{runs}, about {_duration(seconds)} with {workers} at once, about {size:.0f} MB on disk")


def _print_groups(console: Console, groups: Sequence[Mapping[str, Any]]) -> None:
    axes = ("plant", "controller", "disturbance", "start")
    headings = ("\n".join(str(group[axis]) for axis in axes) for group in groups)
    table = WholeTable("", *headings, title="Mean over seeds, 95 % interval", title_justify="left")
    runs = (f"{group['runs']}" + (f" ({group['failed']} failed)" if group["failed"] else "") for group in groups)
    table.add_row("runs", *runs)
    for metric in _SHOWN:
        if any(metric in group["metrics"] for group in groups):
            table.add_row(metric, *(_cell(group["metrics"].get(metric)) for group in groups))
    console.print(table)


def _cell(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if found["mean"] is None:
        return "never"
    interval = "" if found["low"] is None else f"\n{found['low']:.4g} to {found['high']:.4g}"
    return f"{found['mean']:.4g}{interval}" + (f"\nnever in {found['never']}" if found["never"] else "")


def _label(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
