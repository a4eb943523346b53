"""``python -m pendulum_bags excite``: design an excitation, show what it will tell, and play it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.executables import cli_main

__all__ = ["app", "main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def excite(
    plant: Annotated[str, typer.Option(help="Prior guess: preset or plant file.")] = "dfki",
    parameters: Annotated[
        str, typer.Option(help="What to learn, separated by commas.")
    ] = "inertia,damping,gravity,coulomb_friction",
    kind: Annotated[str, typer.Option(help="multisine, chirp, prbs, or best of all.")] = "best",
    duration: Annotated[float, typer.Option(help="[s]")] = 20.0,
    rate: Annotated[float, typer.Option(help="Samples and torque values per second [Hz].")] = 100.0,
    max_effort: Annotated[
        float | None, typer.Option(help="[N m]; by default half the plant's limit.")
    ] = None,
    max_speed: Annotated[float, typer.Option(help="[rad/s]")] = 10.0,
    max_angle: Annotated[float, typer.Option(help="Distance from hanging down [rad].")] = 2.5,
    noise: Annotated[float, typer.Option(help="Standard deviation of the angle sensor [rad].")] = 1e-3,
    seed: Annotated[int, typer.Option(help="Of the search.")] = 0,
    trials: Annotated[int, typer.Option(help="Candidates to try, and again to improve the best.")] = 60,
    out: Annotated[Path, typer.Option(help="CSV (time, torque) to write.")] = Path("excitation.csv"),
    play: Annotated[bool, typer.Option(help="Play it through the disturbance node when designed.")] = False,
    namespace: Annotated[str, typer.Option(help="Of the plant, for --play.")] = "/sim",
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Design the torque over time that tells most about a plant within limits, starting at rest.

    Example: python -m pendulum_bags excite --plant dfki --max-effort 4 --max-angle 2 --out excitation.csv
    """
    from pendulum_bags.identification.excitation import KINDS, Limits, design_excitation
    from pendulum_bags.identification.model import UNITS
    from pendulum_msgs_py.plant_parameters import load_plant

    prior = load_plant(plant)
    limits = Limits(0.5 * prior.effort_limit if max_effort is None else max_effort, max_speed, max_angle)
    wanted = tuple(name.strip() for name in parameters.split(",") if name.strip())
    design = design_excitation(
        prior,
        limits,
        parameters=wanted,
        kinds=KINDS if kind == "best" else (kind,),
        duration=duration,
        period=1.0 / rate,
        noise=noise,
        seed=seed,
        trials=trials,
    )
    design.write(out)
    command = [
        *(sys.executable, "-m", "pendulum_lqr", "disturbance", "--ros-args", "-r", f"__ns:={namespace}"),
        *("-p", "kind:=from_bag", "-p", f"file:={out.resolve()}", "-p", "autostart:=true"),
        *("-p", f"duration:={float(duration)}"),
    ]
    if as_json:
        content = {
            "kind": design.kind,
            "file": str(out),
            "predicted_half_width": design.predicted,
            "relative_half_width": design.relative,
            "peak_effort": float(abs(design.effort).max()),
            "peak_speed": float(abs(design.velocity).max()),
            "peak_angle": float(abs(design.position).max()),
        }
        typer.echo(json.dumps(content, indent=2))
    else:
        from rich.console import Console
        from rich.table import Table

        console = Console()
        table = Table(
            title=f"{design.kind}, {duration:g} s: predicted 95 % intervals, if the prior plant is true"
        )
        for heading in ("parameter", "half width", "relative", "unit"):
            table.add_column(heading)
        for name, width in design.predicted.items():
            table.add_row(name, f"{width:.3g}", f"{100.0 * design.relative[name]:.2g} %", UNITS[name])
        console.print(table)
        console.print(
            f"peaks: {abs(design.effort).max():.3g} N m, {abs(design.velocity).max():.3g} rad/s, "
            f"{abs(design.position).max():.3g} rad from hanging",
            highlight=False,
        )
        console.print(
            f"wrote {out}; play it, while a controller answers the plant, with\n  python {' '.join(command[1:])}",
            highlight=False,
            soft_wrap=True,
        )
    if play:
        # The node is a program of its own, as on a robot: this command ends when it does.
        raise typer.Exit(subprocess.run(command, check=False).returncode)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    return cli_main(app, argv, name="python -m pendulum_bags excite")


if __name__ == "__main__":
    raise SystemExit(main())
