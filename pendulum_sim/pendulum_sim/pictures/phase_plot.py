"""``phase_plot``: draw the thesis's overdamped phase plot, with fixed points and their stability."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option

__all__ = ["main"]


def phase_plot(
    plant: Annotated[str, typer.Option(help="Preset or path of a plant file.")] = "thesis",
    torque: Annotated[float, typer.Option(help="Constant torque u_0 [N m].")] = 0.0,
    output: Annotated[Path, out_option("Figure to write (.png, .svg, .pdf).")] = Path("phase_plot.png"),
    as_json: Json = False,
) -> None:
    """Draw x' over x of b x' + G sin(x) = u_0 and list its fixed points, for a plant that is overdamped.

    Example: python -m pendulum_sim phase_plot --plant thesis --torque 0.5 --out phase.png
    """
    # Imported late: --help does not need matplotlib.
    from pendulum_msgs_py.programs.terminal import WholeTable, make_console
    from pendulum_sim.pictures.figures import overdamped_points, plot_overdamped_phase, save_figure

    parameters = load_plant(plant)
    points = overdamped_points(parameters, torque)
    path = save_figure(plot_overdamped_phase(parameters, torque), output)
    if as_json:
        listed = [{**asdict(point), "rate": rate} for point, rate in points]
        typer.echo(json.dumps({"figure": str(path), "fixed_points": listed}))
        return
    table = WholeTable(title=f"fixed points of {parameters.name}, u_0 = {torque:g} N m")
    for column in ("theta \\[rad]", "stability", "rate \\[1/s]"):
        table.add_column(column, justify="left" if column == "stability" else "right")
    for point, rate in points:
        table.add_row(f"{point.theta:.6f}", "stable" if point.stable else "unstable", f"{rate:+.6f}")
    console = make_console()
    console.print(table if points else "no fixed point: the torque exceeds gravity, the pendulum turns over")
    console.print(f"figure: {path}", soft_wrap=True)


main = command_line(phase_plot, "python -m pendulum_sim phase_plot")
