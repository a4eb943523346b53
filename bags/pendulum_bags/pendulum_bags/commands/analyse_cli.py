"""``analyse``: ask many recordings the same questions, and print one table."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from pendulum_bags.analyse.questions import QUESTIONS
from pendulum_bags.commands.recording_options import Dt, Mappings, Start, Stop, Topics, readings_of
from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counted_progress
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_bags.analyse.bag_table import Table as BagTable

__all__ = ["main"]


_SHOWN = {
    "seed": "seed",
    "rate_hz": "rate [Hz]",
    "rms_error": "rms error [rad]",
    "max_abs_u": "max |u| [N m]",
    "states_gaps": "gaps",
    "answer_p99": "answer p99 [ms]",
    "inertia": "inertia [kg m^2]",
    "damping": "damping [N m s/rad]",
    "gravity": "gravity [N m]",
    "outcome": "outcome",
    "report": "report",
    "guessed": "guessed",
}
"""Columns that are printed, with their headings; the CSV file has all."""
_MOST_ROWS = 40


def _named(*, of_runs: bool) -> str:
    return ", ".join(name for name, question in QUESTIONS.items() if question.of_runs is of_runs)


def analyse(
    folders: Annotated[list[Path], typer.Argument(help="Folders with bags below them, or recordings of any format.")],
    ask: Annotated[
        str,
        typer.Option(help=f"Questions: {_named(of_runs=False)} of each plant; {_named(of_runs=True)} of run folders."),
    ] = "metrics,timing",
    out: Annotated[Path, out_option("Folder for the tables; an interrupted analysis resumes there.")] = Path(
        "bags", "runs", "analysed"
    ),
    workers: Annotated[
        int, typer.Option(help="Processes of a local Dask cluster; 0: one after the other, in this process.", min=0)
    ] = 0,
    scheduler: Annotated[
        str, typer.Option(help="Dask scheduler, tcp://HOST:PORT; its workers see the bags under the same paths.")
    ] = "",
    mapping: Mappings = None,
    topic: Topics = None,
    dt: Dt = None,
    start: Start = None,
    stop: Stop = None,
    json_output: Json = False,
) -> None:
    """Ask many recordings the same questions: metrics, timing, identified parameters, equivalence; one table.

    Example: python -m pendulum_bags analyse bags/examples --ask metrics,timing --out /tmp/analysed
    """
    from pendulum_bags.analyse.bag_table import analyse_bags, find_pieces
    from pendulum_bags.studies.chunks import cluster_client

    questions = [name.strip() for name in ask.split(",") if name.strip()]
    (how,) = readings_of([Path()], mapping, topic, dt, start, stop)
    pieces = find_pieces(folders, questions, how)
    console = make_console(stderr=json_output, highlight=False)
    started = time.monotonic()
    connect = partial(cluster_client, scheduler, workers)
    with counted_progress(console, "bags", len(pieces), out) as on_progress:
        table = analyse_bags(out, pieces, questions, connect=connect, on_progress=on_progress)
    if json_output:
        print(json_text({"bags": table.bags, "runs": table.runs}))
    else:
        _print(console, table, out, time.monotonic() - started)
    if table.failed:
        raise typer.Exit(1)


def _print(console: Console, found: BagTable, out: Path, elapsed: float) -> None:
    for title, file, rows in (("Bags", "bags", found.bags), ("Runs", "runs", found.runs)):
        if not rows:
            continue
        names = [name for name in _SHOWN if any(row.get(name) is not None for row in rows)]
        first = ("bag", "plant") if file == "bags" else ("run",)
        table = number_table(title, *first, *(escape(_SHOWN[name]) for name in names), left=len(first))
        for row in rows[:_MOST_ROWS]:
            whose = [row["bag"], row["plant"]] if file == "bags" else [row["bag"]]
            table.add_row(*whose, *(_cell(row.get(name)) for name in names))
        console.print(table)
        if len(rows) > _MOST_ROWS:
            console.print(f"... and {len(rows) - _MOST_ROWS} more")
        for row in rows:
            if row["error"]:
                console.print(f"{row['bag']} {row['plant']}: {row['error']}", markup=False)
        console.print(f"table   {out / file}.csv, with all columns")
    cached = f", {found.cached} of them cached" if found.cached else ""
    console.print(f"({len(found.bags) + len(found.runs)} rows{cached}, {elapsed:.0f} s)")


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else escape(str(value))


main = command_line(analyse, "python -m pendulum_bags analyse")
