"""``experiment leaderboard``: every controller, one board."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import results_at_once
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["leaderboard"]


def leaderboard(
    out: Annotated[Path, out_option("Folder of the page.")] = Path("bags/runs/leaderboard"),
    plants: Annotated[
        str, typer.Option(help="Rigid plants (presets or files) and hw, the emulated X5-9, separated by commas.")
    ] = "thesis,dfki",
    controllers: Annotated[
        str, typer.Option(help="Controllers and policy files (.npz), separated by commas; empty for all controllers.")
    ] = "",
    duration: Annotated[float, typer.Option(help="Length of each run [s].", min=1.0)] = 10.0,
    robustness: Annotated[bool, typer.Option(help="Try model errors, noise, delay, lag and pushes too.")] = True,
    workers: Annotated[int, typer.Option(help="Runs at once; 0 for one a core.", min=0)] = 0,
    json_output: Json = False,
) -> None:
    """Score every controller from hanging down to upright: three public scores, costs, robustness, one page.

    On hw each run is four nodes over DDS: about 7 s for the plain run of a controller, 2 min with the perturbations.

    Example: python -m pendulum_bags experiment leaderboard --plants thesis --controllers lqr,pid --no-robustness
    """
    from pendulum_bags.runs.run_folder import write_json
    from pendulum_bags.studies.leaderboard import HARDWARE, contenders, evaluate
    from pendulum_bags.studies.leaderboard_hardware import evaluate_hardware
    from pendulum_bags.studies.leaderboard_page import best_sentence, to_json, write_page
    from pendulum_lqr.controller_interface.controller import controller_class
    from pendulum_lqr.policies.policy_file import POLICY_SUFFIX, named_controller
    from pendulum_msgs_py.plants.plant_parameters import load_plant

    names = [name.strip() for name in controllers.split(",") if name.strip()] or contenders()
    machines = [name.strip() for name in plants.split(",") if name.strip()]
    for name in names:
        if not name.endswith(POLICY_SUFFIX):
            controller_class(name)
        elif [Path(other).name for other in names].count(Path(name).name) > 1:
            raise ParameterError(f"policy file {name} shares its name with another; expected a name for each")
        else:
            named_controller(name)
    for name in machines:
        if name != HARDWARE:
            load_plant(name)
    console = make_console(stderr=json_output, highlight=False)
    jobs = [
        partial(
            evaluate_hardware if machine == HARDWARE else partial(evaluate, machine),
            kind,
            parameters=parameters,
            duration=duration,
            robustness=robustness,
        )
        for machine in machines
        for kind, parameters in map(named_controller, names)
    ]
    entries = [
        replace(entry, controller=Path(name).stem if name.endswith(POLICY_SUFFIX) else name)
        for entry, name in zip(
            results_at_once(console, "controllers", jobs, workers), names * len(machines), strict=True
        )
    ]
    out.mkdir(parents=True, exist_ok=True)
    page = write_page(out / "leaderboard.html", entries, duration)
    write_json(out / "leaderboard.json", to_json(entries))
    if json_output:
        print(json_text(to_json(entries)))
        return
    headings = ("plant", "controller", "up", "v1", "v2", "v3", "time \\[s]", "robustness \\[%]")
    table = number_table("Leaderboard", *headings, left=2)
    for entry in sorted(entries, key=lambda one: (machines.index(one.plant), -one.scores.get("v2", -1.0))):
        held = list(entry.robustness.values())
        table.add_row(
            entry.plant,
            entry.controller,
            "yes" if entry.success else "no",
            *(f"{entry.scores[name]:.3f}" if entry.scores else "–" for name in ("v1", "v2", "v3")),
            f"{entry.costs['time']:.2f}" if entry.costs else "–",
            f"{100.0 * sum(held) / len(held):.0f}" if held else "–",
        )
    console.print(table)
    console.print(best_sentence(entries))
    console.print(f"page    {page}", soft_wrap=True)
