"""``python -m pendulum_bags excite``: design an excitation, predict what it will determine, and play it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pendulum_bags.arrays import Array
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, command_line
from pendulum_msgs_py.programs.options import Json, RunningDomain, out_option
from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["main"]


def excite(
    plant: Annotated[str, typer.Option(help="Prior guess: preset or plant file.")] = "dfki",
    parameters: Annotated[
        str,
        typer.Option(
            help="Parameters to determine, separated by commas; empty for inertia, damping, gravity and "
            "coulomb_friction, or of several joints for all that their motion can tell apart."
        ),
    ] = "",
    joint: Annotated[
        str, typer.Option(help="Of several joints the driven one that is excited; default the first.")
    ] = "",
    kind: Annotated[str, typer.Option(help="multisine, chirp, prbs, or best of all.")] = "best",
    duration: Annotated[float, typer.Option(help="[s]")] = 20.0,
    rate: Annotated[float, typer.Option(help="Samples and torque values per second [Hz].")] = 100.0,
    max_effort: Annotated[float | None, typer.Option(help="[N m or N]; by default half the joint's limit.")] = None,
    max_speed: Annotated[float, typer.Option(help="Of every joint [rad/s or m/s].")] = 10.0,
    max_angle: Annotated[float, typer.Option(help="Distance from hanging down [rad].")] = 2.5,
    max_travel: Annotated[float, typer.Option(help="Of a slide, to either side [m].")] = 0.3,
    noise: Annotated[float, typer.Option(help="Standard deviation of the position sensors [rad or m].")] = 1e-3,
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

    Of several joints it drives one motor from hanging, and the intervals are those of a fit to all positions.
    With --play it is played once, from rest to rest. No other program may command the plant meanwhile.

    Example: python -m pendulum_bags excite --plant dfki --max-effort 1.5 --max-angle 2 --out excitation.csv --play
    """
    from pendulum_bags.identification.excitation import KINDS, Limits, design_excitation
    from pendulum_bags.identification.joint_model import JointModel
    from pendulum_bags.identification.model import UNITS
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism

    prior = load_mechanism(plant)
    driven, joints = prior.coordinates.driven_names, prior.coordinates.joints
    if joint and joint not in driven:
        raise DataError(f"joint is {joint!r}; expected one that is driven: {', '.join(driven) or 'none is'}")
    strongest = prior.effort_limits[driven.index(joint) if joint else 0] if driven else 0.0
    limits = Limits(0.5 * strongest if max_effort is None else max_effort, max_speed, max_angle, max_travel)
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
        joint=joint,
    )
    unit = prior.coordinates.drive_unit
    if on not in {"sim", "emulator", "running"}:
        raise DataError(f"on is {on!r}; expected sim, emulator or running")
    if max_effort is not None and max_effort > strongest:
        raise DataError(
            f"max_effort is {max_effort:g} {unit}; expected at most {strongest:g} {unit}, the plant's limit"
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
            "peak_speed": _peaks(design.velocity) if len(joints) > 1 else float(abs(design.velocity).max()),
            "peak_angle": _peaks(design.position) if len(joints) > 1 else float(abs(design.position).max()),
        }
        typer.echo(json_text(content))
    else:
        from pendulum_msgs_py.programs.terminal import WholeTable, make_console

        console = make_console()
        title = f"{design.kind}, {duration:g} s: predicted 95 % intervals, if the prior plant is true"
        table = WholeTable("parameter", "half width", "relative", "unit", title=title)
        for name, width in design.predicted.items():
            of = UNITS[name] if prior.is_pendulum else JointModel.of(prior).unit(name)
            table.add_row(name, f"{width:.3g}", f"{100.0 * design.relative[name]:.2g} %", of)
        console.print(table)
        reached = ", ".join(
            f"{f'{each.name} ' if len(joints) > 1 else ''}{v:.3g} {each.velocity_unit}, {q:.3g} {each.unit} from "
            "hanging"
            for each, q, v in zip(joints, *map(_peaks, (design.position, design.velocity)), strict=True)
        )
        console.print(f"peaks: {abs(design.effort).max():.3g} {unit}, {reached}", highlight=False)
        console.print(f"wrote {out}", highlight=False)
    if not play:
        return
    from pendulum_bags.experiments.excitation import ExcitationPlay, play_in_lockstep, play_on_running_plant

    target = bag or out.with_suffix("")
    period = float(design.time[1] - design.time[0])
    prediction = {"kind": design.kind, "plant": plant, "predicted": design.predicted, "noise": noise}
    excited = "" if prior.is_pendulum else joint or driven[0]
    signal = ExcitationPlay(
        out,
        period * len(design.time),
        period,
        limits.effort,
        limits.speed,
        tuple(limits.of(prior).tolist()),
        prediction,
        prior.coordinates,
        excited,
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
    of_plant = "" if prior.is_pendulum else f" --plant {plant}"
    typer.echo(
        as_typed(f"played and recorded; next\n  python -m pendulum_bags identify {target}{of_plant}"), err=as_json
    )


def _peaks(motion: Array) -> list[float]:
    """Return the largest value of each joint."""
    return [float(value) for value in np.atleast_1d(np.abs(motion).max(axis=0))]


main = command_line(excite, "python -m pendulum_bags excite")
