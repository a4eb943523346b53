"""``replay``: drive a plant with recorded torque, or a controller with recorded states, and compare."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pendulum_bags.commands.identify_cli import Hold
from pendulum_bags.commands.recording_options import Dt, Mappings, Topics, WriteMapping, readings_of, show_guesses
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.plant_parameters import PRESET_NAMES, is_mechanism
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

if TYPE_CHECKING:
    from pendulum_bags.replay.controller_replay import ControllerReplay
    from pendulum_bags.replay.joint_replay import JointReplay
    from pendulum_bags.replay.result import InputReplay

__all__ = ["main"]


def replay(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(help="Recording of any format.")],
    params: Annotated[
        str,
        typer.Option(
            "--params", "-p", help=f"Plant file (an identified one for a voltage), or a preset: {PRESET_NAMES}."
        ),
    ] = "",
    controller: Annotated[
        str,
        typer.Option(help="Feed the states to this controller instead; 'recorded' for the one of the bag."),
    ] = "",
    set_value: Annotated[
        list[str] | None,
        typer.Option("--set", help="Parameter of the controller, such as --set 'q=[100.0, 0.01]'."),
    ] = None,
    window: Annotated[float, typer.Option(help="Length of the windows whose initial state is fitted [s].")] = 1.0,
    start: Annotated[float | None, typer.Option(help="Leave out what comes before [s].")] = None,
    stop: Annotated[float | None, typer.Option(help="Leave out what comes after [s].")] = None,
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    hold: Hold = None,
    effort: Annotated[str, typer.Option(help="Torque of a bag: applied (said by the plant) or measured.")] = "applied",
    prefix: Annotated[str, typer.Option(help="Namespace of a bag's topics, where it holds several plants: /sim.")] = "",
    out: Annotated[Path | None, out_option("Folder for figure and replay.json; none by default.")] = None,
    json_output: Json = False,
) -> None:
    """Drive a plant with a recorded input and compare the motion; or a controller with recorded states.

    Example: python -m pendulum_bags replay measured.csv --params dfki
    """
    from pendulum_bags.figures.render_files import write_figures
    from pendulum_bags.runs.run_folder import write_json

    result: InputReplay | ControllerReplay | JointReplay
    (reading,) = readings_of([recording], mapping, topic, dt, start, stop)
    # Guesses are shown even if an error follows.
    context.call_on_close(partial(show_guesses, make_console(stderr=True), [reading], write_mapping))
    if controller:
        from pendulum_bags.replay.controller_replay import parse_values, replay_controller

        result = replay_controller(
            reading,
            None if controller == "recorded" else controller,
            plant=params or None,
            values=parse_values(set_value or []),
            prefix=prefix or None,
        )
    elif params and Path(params).suffix != ".json" and is_mechanism(params):
        from pendulum_bags.replay.joint_replay import replay_joints

        if unheeded := [name for name, value in (("--hold", hold), ("--prefix", prefix)) if value]:
            raise DataError(f"{', '.join(unheeded)} has no effect with a plant of several joints; expected none of it")
        result = replay_joints(reading, params, window=window)
    else:
        from pendulum_bags.replay.input_replay import replay_recording

        result = replay_recording(
            reading,
            params or "thesis",
            window=window,
            hold=hold,
            effort=effort,
            namespace=prefix or None,
        )
    content = result.as_dict()
    objection = getattr(result, "objection", None)
    content["objection"] = objection
    if out is not None:
        files = write_figures([result.figure()], out)
        write_json(out / "replay.json", content)
    if json_output:
        print(json_text(content))
    else:
        _print(result, content, chosen=bool(params))
        if out is not None:
            print(f"\nfigure  {files[0]}")
    if objection is not None:
        raise typer.Exit(3)


def _print(result: InputReplay | ControllerReplay | JointReplay, content: dict[str, Any], *, chosen: bool) -> None:
    from pendulum_bags.figures.terminal_table import number_table

    console = make_console()
    if content["objection"] is not None:
        console.print(content["objection"], style="bold red", highlight=False, markup=False)
    if "horizons" in content:
        headings = ("samples", r"time \[s]", r"rms \[rad]", "predictions")
        table = number_table("Error of predictions from measured states, by horizon", *headings, left=0)
        for row in content["horizons"]:
            table.add_row(str(row["steps"]), f"{row['time_s']:.4g}", f"{row['rms_rad']:.3g}", str(row["starts"]))
        console.print(table)
        console.print(f"plant {content['plant']}" + ("" if chosen else " (--params names another)"), highlight=False)
        fit, diverges = content["free_run_fit_percent"], content["diverges_at_s"]
        console.print(
            f"free run: rms {content['free_run_rms_rad']:.4f} rad, fit {fit:.1f} %, "
            + ("never diverges" if diverges is None else f"diverges at {diverges:.2f} s")
        )
        console.print(
            f"windows of {content['window_s']:g} s: rms [bold]{content['rms_rad']:.4f} rad[/bold]",
            highlight=False,
        )
        return
    if "controller" in content:
        console.print(f"{content['controller']}: {content['description']}", highlight=False, markup=False)
    console.print(result.sentence(), highlight=False, markup=False)


main = command_line(replay, "python -m pendulum_bags replay")
