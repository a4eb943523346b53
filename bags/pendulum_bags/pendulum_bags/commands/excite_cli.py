"""``python -m pendulum_bags excite``: design an excitation, predict what it will determine, and play it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, cli_main
from pendulum_msgs_py.programs.options import Json, RunningDomain, out_option
from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["app", "main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def excite(
    plant: Annotated[str, typer.Option(help="Prior guess: preset or plant file.")] = "dfki",
    parameters: Annotated[
        str, typer.Option(help="Parameters to determine, separated by commas.")
    ] = "inertia,damping,gravity,coulomb_friction",
    kind: Annotated[str, typer.Option(help="multisine, chirp, prbs, or best of all.")] = "best",
    duration: Annotated[float, typer.Option(help="[s]")] = 20.0,
    rate: Annotated[float, typer.Option(help="Samples and torque values per second [Hz].")] = 100.0,
    max_effort: Annotated[float | None, typer.Option(help="[N m]; by default half the plant's limit.")] = None,
    max_speed: Annotated[float, typer.Option(help="[rad/s]")] = 10.0,
    max_angle: Annotated[float, typer.Option(help="Distance from hanging down [rad].")] = 2.5,
    noise: Annotated[float, typer.Option(help="Standard deviation of the angle sensor [rad].")] = 1e-3,
    seed: Annotated[int, typer.Option(help="Of the search.")] = 0,
    trials: Annotated[int, typer.Option(help="Candidates to try, and again to improve the best.")] = 60,
    out: Annotated[Path, out_option("CSV (time, torque) to write.")] = Path("excitation.csv"),
    play: Annotated[bool, typer.Option(help="Play it when it is designed, and record.")] = False,
    on: Annotated[
        str,
        typer.Option(
            help="With --play: sim or emulator, started for it and run in lockstep; or running, the plant in "
            "--namespace."
        ),
    ] = "sim",
    simulate: Annotated[
        str,
        typer.Option(help="With --on sim: the plant that is simulated, a sealed one too; by default the prior guess."),
    ] = "",
    bag: Annotated[
        Path | None,
        typer.Option(help="With --play: bag to write; by default the name of --out without .csv."),
    ] = None,
    namespace: Annotated[str, typer.Option(help="With --on running: of the plant.")] = "/sim",
    arm: Annotated[
        bool, typer.Option(help="With --on running: arm the plant, and disarm it at the end. It will move.")
    ] = False,
    domain: RunningDomain = None,
    as_json: Json = False,
) -> None:
    """Design the torque signal that determines a plant's parameters best within limits, from rest.

    With --play it is played once, from rest to rest. No other program may command the plant meanwhile.

    Example: python -m pendulum_bags excite --plant dfki --max-effort 1.5 --max-angle 2 --out excitation.csv --play
    """
    from pendulum_bags.identification.excitation import KINDS, Limits, design_excitation
    from pendulum_bags.identification.model import UNITS
    from pendulum_msgs_py.plants.plant_parameters import load_plant

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
    if on not in {"sim", "emulator", "running"}:
        raise DataError(f"on is {on!r}; expected sim, emulator or running")
    if max_effort is not None and max_effort > prior.effort_limit:
        raise DataError(
            f"max_effort is {max_effort:g} N m; expected at most {prior.effort_limit:g} N m, the plant's limit"
        )
    if simulate and (not play or on != "sim"):
        raise DataError("simulate names a plant; expected it with --play and --on sim, which simulates one")
    design.write(out)
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
        typer.echo(json_text(content))
    else:
        from pendulum_msgs_py.programs.terminal import WholeTable, make_console

        console = make_console()
        title = f"{design.kind}, {duration:g} s: predicted 95 % intervals, if the prior plant is true"
        table = WholeTable("parameter", "half width", "relative", "unit", title=title)
        for name, width in design.predicted.items():
            table.add_row(name, f"{width:.3g}", f"{100.0 * design.relative[name]:.2g} %", UNITS[name])
        console.print(table)
        console.print(
            f"peaks: {abs(design.effort).max():.3g} N m, {abs(design.velocity).max():.3g} rad/s, "
            f"{abs(design.position).max():.3g} rad from hanging",
            highlight=False,
        )
        console.print(f"wrote {out}", highlight=False)
    if not play:
        return
    from pendulum_bags.experiments.excitation import ExcitationPlay, play_in_lockstep, play_on_running_plant

    target = bag or out.with_suffix("")
    period = float(design.time[1] - design.time[0])
    prediction = {"kind": design.kind, "plant": plant, "predicted": design.predicted, "noise": noise}
    signal = ExcitationPlay(
        out, period * len(design.time), period, limits.effort, limits.speed, limits.angle, prediction
    )
    try:
        if on == "running":
            play_on_running_plant(target, signal, f"/{namespace.strip('/')}", arm=arm, domain=domain)
        else:
            play_in_lockstep(
                target,
                signal,
                side="sim" if on == "sim" else "hw",
                plant=simulate or plant,
                design_plant=plant,
                noise=noise,
                seed=seed,
                domain=domain,
            )
    except KeyboardInterrupt:
        typer.echo("interrupted: the torque is zero, all programs have ended", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    typer.echo(as_typed(f"played and recorded; next\n  python -m pendulum_bags identify {target}"), err=as_json)


main = partial(cli_main, app, name="python -m pendulum_bags excite")
