"""``study``: studies of public data, from a clone of it to a page."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None, no_args_is_help=True)


@app.callback()
def study() -> None:
    """Study public data of real machines: would the simulation have picked the right controller?

    Example: python -m pendulum_bags study real_ai_gym --data real_ai_gym_leaderboard
    """


@app.command(name="real_ai_gym")
def real_ai_gym(
    data: Annotated[Path, typer.Option(help="Clone of github.com/dfki-ric-underactuated-lab/real_ai_gym_leaderboard.")],
    out: Annotated[Path | None, out_option("Folder for page, figures and numbers; none by default.")] = None,
    json_output: Json = False,
) -> None:
    """Score all trials of contests on real acrobots and pendubots, and rank controllers by the contests' simulation.

    Example: python -m pendulum_bags study real_ai_gym --data real_ai_gym_leaderboard --out contests
    """
    from pendulum_bags.studies.real_ai_gym import comparisons, read_trials
    from pendulum_bags.studies.real_ai_gym_page import study_tables, study_text, to_json, write_study

    trials = read_trials(data)
    found = comparisons(data, trials)
    page = write_study(out, trials, found) if out is not None else None
    if json_output:
        print(json_text(to_json(trials, found)))
        return
    console = make_console(highlight=False)
    for table in study_tables(found):
        shown = number_table(table.title, *(head.replace("[", "\\[") for head in table.head), left=2)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown, table.sentence)
    console.print(*study_text(trials, found), sep="\n", markup=False)
    if page is not None:
        console.print(f"\npage    {page}", soft_wrap=True)


main = partial(cli_main, app, name="python -m pendulum_bags study")
