"""``ranking``: check whether the simulation would have picked the right controller."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def ranking(
    folders: Annotated[
        list[Path],
        typer.Argument(help="Studies, or folders with bags that say which controller ran on which side."),
    ],
    out: Annotated[Path | None, out_option("Folder for page, figure and numbers; none by default.")] = None,
    weights: Annotated[
        tuple[float, float, float], typer.Option(help="q11, q22 and r of the cost, mean of q11 e^2 + q22 v^2 + r u^2.")
    ] = (100.0, 0.01, 0.1),
    use_simulation: Annotated[
        bool | None,
        typer.Option(
            help="Narrow the intervals of the costs on hardware by simulated runs under the same and under further "
            "seeds; by default where real hardware ran.",
        ),
    ] = None,
    json_output: Json = False,
) -> None:
    """Rank controllers on both sides: costs, SRCC, MMRV, regret of the simulation's pick, and pairs ranked wrongly.

    Example: python -m pendulum_bags ranking bags/runs/ranking --out /tmp/ranking
    """
    from pendulum_bags.ranking.collect import collect_contenders
    from pendulum_bags.ranking.fewer_runs import narrow_all, print_narrowed
    from pendulum_bags.ranking.present import print_ranking, same_choice, write_ranking
    from pendulum_bags.ranking.ranking import rank

    contenders, case = collect_contenders(folders, weights)
    found = rank(contenders)
    emulated = all(one.emulated for one in contenders)
    use = not emulated if use_simulation is None else use_simulation
    narrowed = narrow_all(contenders) if use else {}
    page = write_ranking(out, found, emulated=emulated, case=case) if out is not None else None
    if json_output:
        content = {**found.to_json(), "layer": same_choice(found, case=case).to_json()}
        if use:
            content["narrowed"] = {name: one.to_json() for name, one in narrowed.items()}
        print(json_text(content))
        return
    console = make_console(highlight=False)
    print_ranking(console, found)
    if use:
        print_narrowed(console, narrowed)
    if page is not None:
        console.print(f"\npage    {page}", soft_wrap=True)


main = partial(cli_main, app, name="python -m pendulum_bags ranking")
