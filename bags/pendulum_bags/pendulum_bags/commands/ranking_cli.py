"""``ranking``: check whether the simulation would have picked the right controller."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.commands.recording_options import (
    Dt,
    Mappings,
    Start,
    Stop,
    Topics,
    WriteMapping,
    readings_of,
    show_guesses,
)
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["main"]


def ranking(
    context: typer.Context,
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Studies, bags with the record of controller and side, folders as "
            "FOLDER/simulation/CONTROLLER/FILE and FOLDER/hardware/CONTROLLER/FILE, or tables (.csv, .yaml) with "
            "controller, side, and file, cost or score."
        ),
    ] = None,
    trial: Annotated[
        list[str] | None,
        typer.Option(help="CONTROLLER,SIDE,FILE: a recording and what it is of; once for each."),
    ] = None,
    out: Annotated[Path | None, out_option("Folder for page, figure and numbers; none by default.")] = None,
    weights: Annotated[
        tuple[float, float, float], typer.Option(help="q11, q22 and r of the cost, mean of q11 e^2 + q22 v^2 + r u^2.")
    ] = (100.0, 0.01, 0.1),
    plant: Annotated[str, typer.Option(help="Plant whose LQR weighs recordings of several joints.")] = "",
    use_simulation: Annotated[
        bool | None,
        typer.Option(
            help="Narrow the intervals of the costs on hardware by simulated runs under the same and under further "
            "seeds; by default where real hardware ran under the seeds of the simulation.",
        ),
    ] = None,
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    start: Start = None,
    stop: Stop = None,
    json_output: Json = False,
) -> None:
    """Rank controllers on both sides: costs, SRCC, Spearman, MMRV, regret of the simulation's pick, wrong pairs.

    Several runs of a controller give intervals. Recordings are to stay upright: --start leaves a swing-up out.

    Example: python -m pendulum_bags ranking trials.csv --out /tmp/ranking
    """
    from pendulum_bags.ranking.collect import collect_contenders
    from pendulum_bags.ranking.fewer_runs import narrow_all, print_narrowed
    from pendulum_bags.ranking.joint_choice import COST
    from pendulum_bags.ranking.present import Words, print_ranking, same_choice, write_ranking
    from pendulum_bags.ranking.ranking import rank
    from pendulum_bags.ranking.trials import table_rows, trial_rows, trials_below, trials_of

    (template,) = readings_of([Path()], mapping, topic, dt, start, stop)
    folders = [path for path in paths or () if path.is_dir()]
    trials = [
        one
        for table in paths or ()
        if table not in folders
        for one in trials_of(table_rows(table), str(table), table.parent, template)
    ]
    trials += trials_of(trial_rows(trial or ()), "--trial", Path(), template)
    trials += [one for folder in folders for one in trials_below(folder, template)]
    readings = [one.reading for one in trials if one.reading is not None]
    if readings:
        context.call_on_close(partial(show_guesses, make_console(stderr=json_output), readings, write_mapping))
    contenders, case = collect_contenders(folders, weights, trials, plant=plant)
    found = rank(contenders, of_scores=any(one.is_score for one in trials))
    words = Words()
    if trials:
        words = Words(
            "record more runs of each controller",
            "python -m pendulum_bags frequency_response SIMULATION MACHINE",
            "Numbers of the tables." if not readings else COST if plant else words.cost,
        )
    emulated = all(one.emulated for one in contenders)
    seeded = any(one.shared_seeds for one in contenders)
    use = (not emulated and seeded) if use_simulation is None else use_simulation
    narrowed = narrow_all(contenders) if use else {}
    page = write_ranking(out, found, words=words, emulated=emulated, case=case) if out is not None else None
    if json_output:
        content = {**found.to_json(), "layer": same_choice(found, words, case).to_json()}
        if use:
            content["narrowed"] = {name: one.to_json() for name, one in narrowed.items()}
        print(json_text(content))
        return
    console = make_console(highlight=False)
    print_ranking(console, found, words)
    if use:
        print_narrowed(console, narrowed)
    if page is not None:
        console.print(f"\npage    {page}", soft_wrap=True)


main = command_line(ranking, "python -m pendulum_bags ranking")
