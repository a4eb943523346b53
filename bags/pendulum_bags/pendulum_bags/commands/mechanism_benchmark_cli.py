"""``experiment benchmark``: the public double-pendulum benchmark, with its published rows."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Column

from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import results_at_once
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_bags.studies.mechanism_benchmark import Published
    from pendulum_bags.studies.mechanism_benchmark_table import Row

__all__ = ["benchmark"]

_FEW = 8
"""Runs up to which compiling the simulation takes longer than interpreting it."""


def benchmark(
    plant: Annotated[str, typer.Option(help="acrobot or pendubot.")] = "acrobot",
    controller: Annotated[
        str, typer.Option(help="Controllers and policy files, separated by commas; empty for all controllers.")
    ] = "",
    out: Annotated[Path, out_option("Folder of the figure and the results.")] = Path("bags/runs/benchmark"),
    robustness: Annotated[bool, typer.Option(help="Six tests of robustness: 722 runs a controller.")] = True,
    uptime_seeds: Annotated[
        int, typer.Option(help="Runs of 60 s with knock-downs, each with a seed of its own; 0 for none.", min=0)
    ] = 10,
    seed: Annotated[int, typer.Option(help="Of noise, kicks and knock-downs.", min=0)] = 1,
    workers: Annotated[int, typer.Option(help="Runs at once; 0 for one a core.", min=0)] = 0,
    json_output: Json = False,
) -> None:
    """Score controllers of acrobot or pendubot by the public benchmark's protocol, to the letter.

    Swing-up from hanging in 10 s (score v2), six tests of robustness (v2), and time up under knock-downs (v3, of 2025).
    The rows of published methods are quoted; those were not run here. A policy file is a controller, too;
    of FILE.npz+lqr an LQR takes over near upright.

    Example: python -m pendulum_bags experiment benchmark --plant pendubot --controller tvlqr --no-robustness
    """
    from pendulum_bags.runs.run_folder import write_json
    from pendulum_bags.studies.benchmark_controllers import contender_names
    from pendulum_bags.studies.mechanism_benchmark import PUBLISHED, benchmark_plant
    from pendulum_bags.studies.mechanism_benchmark_figure import write_swing_up_figure
    from pendulum_bags.studies.mechanism_benchmark_runs import robustness_trials
    from pendulum_bags.studies.mechanism_benchmark_table import Bench, document, prepare, run_job, score_rows

    model = benchmark_plant(plant)
    names = [each.strip() for each in controller.split(",") if each.strip()] or list(contender_names())
    console = make_console(stderr=json_output, highlight=False)
    trials = robustness_trials(model, seed) if robustness else []
    jobs = [("swing_up", name, 0) for name in names]
    jobs += [("uptime", name, seed * 1000 + each) for name in names for each in range(uptime_seeds)]
    jobs += [("trial", name, index) for name in names for index in range(len(trials))]
    started = time.monotonic()
    console.print(f"designing {', '.join(names)}, then {len(jobs)} runs", style="dim")
    bench = Bench(plant, tuple(names), seed, compiled=len(jobs) > _FEW)
    # Forked processes inherit this.
    prepare(bench)
    results = results_at_once(console, "runs", [partial(run_job, bench, job) for job in jobs], workers)
    rows = score_rows(names, jobs, results, trials)
    out.mkdir(parents=True, exist_ok=True)
    picture = write_swing_up_figure(out / f"{plant}.png", model, rows)
    content = document(plant, seed, rows)
    write_json(out / f"{plant}.json", content)
    if json_output:
        print(json_text(content))
        return
    _print(console, plant, rows, [row for row in PUBLISHED if row.plant == plant])
    console.print(f"figure  {picture}\nresults {out / f'{plant}.json'}", soft_wrap=True)
    console.print(f"({time.monotonic() - started:.0f} s)")


def _print(console: Console, plant: str, rows: Sequence[Row], published: Sequence[Published]) -> None:
    from pendulum_bags.studies.mechanism_benchmark import CRITERIA
    from pendulum_bags.studies.mechanism_benchmark_runs import KINDS

    scores = ("score v2", "robustness v2", "score v3", Column(""))
    board = number_table(f"Double-pendulum benchmark, {plant}", "controller", *scores)

    def number(value: float | None) -> str:
        return "–" if value is None else f"{value:.3f}"

    lines = [
        (row.score, row.controller, number(row.score), number(row.robustness), row.uptime_text, "here") for row in rows
    ]
    lines += [
        (row.score or 0.0, row.method, number(row.score), number(row.robustness), number(row.uptime_score), "published")
        for row in published
    ]
    for _, *cells in sorted(lines, key=lambda line: -line[0]):
        board.add_row(*cells)
    console.print(board)
    costs = number_table("What the swing-ups cost", "controller", *(f"{one.title} \\[{one.unit}]" for one in CRITERIA))
    for row in rows:
        costs.add_row(row.controller, *(f"{row.criteria[one.name]:.4g}" for one in CRITERIA))
    console.print(costs)
    if any(row.shares for row in rows):
        held = number_table("Robustness: levels held \\[%]", "controller", *KINDS.values())
        for row in rows:
            held.add_row(row.controller, *(f"{100.0 * row.shares[kind]:.1f}" for kind in KINDS))
        console.print(held)
