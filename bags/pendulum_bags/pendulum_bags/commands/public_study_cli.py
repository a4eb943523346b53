"""``study``: studies of public data, from a clone of it to a page."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import results_at_once
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
    policies: Annotated[
        Path | None,
        typer.Option(help="Clone of github.com/dfki-ric-underactuated-lab/double_pendulum, to run its controllers."),
    ] = None,
    plant: Annotated[
        list[str] | None,
        typer.Option(help="With --policies: a double pendulum to predict the machine with; several times if wanted."),
    ] = None,
    out: Annotated[Path | None, out_option("Folder for page, figures and numbers; none by default.")] = None,
    json_output: Json = False,
) -> None:
    """Score all trials of contests on real acrobots and pendubots, and rank controllers by the contests' simulation.

    Example: python -m pendulum_bags study real_ai_gym --data real_ai_gym_leaderboard --out contests
    """
    from pendulum_bags.studies.real_ai_gym import comparisons, read_trials
    from pendulum_bags.studies.real_ai_gym_page import Study, study_tables, study_text, to_json, write_study
    from pendulum_bags.studies.real_ai_gym_policies import board_jobs, prediction_jobs, refuse_other_plants

    if plant and policies is None:
        raise ParameterError(
            f"--plant is {plant[0]} without --policies; expected both: the plant runs these controllers"
        )
    refuse_other_plants(plant or [])
    trials = read_trials(data)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # what is no folder is refused before the runs
    console = make_console(highlight=False)
    study = Study(trials, comparisons(data, trials))
    if policies is not None:
        plants = plant or []
        board = results_at_once(console, "controllers", board_jobs(data, policies, plants))
        predictions = results_at_once(console, "predictions", prediction_jobs(data, policies, trials, plants))
        study = study._replace(board=board, predictions=predictions)
    page = write_study(out, study) if out is not None else None
    if json_output:
        print(json_text(to_json(study)))
        return
    for table in study_tables(study):
        shown = number_table(table.title, *(head.replace("[", "\\[") for head in table.head), left=2)
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown, table.sentence)
    console.print(*study_text(study), sep="\n", markup=False)
    if page is not None:
        console.print(f"\npage    {page}", soft_wrap=True)


main = partial(cli_main, app, name="python -m pendulum_bags study")
