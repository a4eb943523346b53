"""What ``identify --plant MECHANISM`` does and prints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pendulum_msgs_py.errors import DataError

if TYPE_CHECKING:
    from pendulum_bags.identification.mechanism_result import MechanismResult

__all__ = ["run"]


def run(
    plant: str,
    data: Sequence[Path],
    mappings: Sequence[str | None],
    held_out: Sequence[Path],
    window: float | None,
    out: Path | None,
    name: str,
    as_json: bool,
) -> None:
    """Identify, print, write; exit with 3 where the fit is refused.

    Args:
        plant: Preset or plant file of a mechanism.
        data: Recordings to fit.
        mappings: One for each recording, those to score after those to fit.
        held_out: Recordings to score.
        window: Length of the windows [s].
        out: Plant file to write.
        name: Name of the plant in it.
        as_json: Print JSON.

    Raises:
        DataError: The plant has one joint, or a recording cannot be read.
    """
    from pendulum_bags.identification.joint_recordings import read_joints
    from pendulum_bags.identification.mechanism_result import identify_mechanism
    from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism

    start = load_mechanism(plant)
    if len(start.joints) == 1:
        raise DataError(f"plant {start.name!r} has one joint; expected a mechanism, or no --plant for one joint")
    paths = [*data, *held_out]
    everything = [read_joints(path, start.coordinates, rules) for path, rules in zip(paths, mappings, strict=True)]
    result = identify_mechanism(start, everything[: len(data)], held_out=everything[len(data) :], window=window)
    if out is not None and not result.refused:
        result.write(out, name=name)
    if as_json:
        typer.echo(json.dumps(result.to_dict(), indent=2))
    else:
        _print(result, out)
    if result.refused:
        raise typer.Exit(3)


def _print(result: MechanismResult, out: Path | None) -> None:
    from pendulum_bags.identification.result import ALARMS
    from pendulum_msgs_py.programs.terminal import WholeTable, make_console

    console = make_console()
    model = result.model
    title = f"{model.plant.mechanism.name}, identified by output error: {result.extras}"
    table = WholeTable("parameter", "value", "95 % interval", "unit", title=title)
    for key in result.fit.free:
        interval = result.intervals[key]
        table.add_row(key, f"{model[key]:.5g}", f"{interval.low:.4g} to {interval.high:.4g}", model.unit(key))
    console.print(table)
    joints = (f"{joint.name} \\[m{joint.unit}]" for joint in model.plant.coordinates.joints)
    title = f"Free run over windows of {result.window:g} s, the start of each fitted: rms"
    errors = WholeTable("recording", *joints, "of straight lines", title=title)
    for label, found in (("", result.training), ("held out ", result.held_out)):
        for recording, score in found.items():
            cells = [f"{1e3 * value:.2f}" for value in score.rms]
            errors.add_row(f"{label}{recording}", *cells, f"{100.0 * score.share:.1f} %")
    console.print(errors)
    for sentence in result.sentences():
        style = "bold red" if sentence.startswith(ALARMS) else None
        console.print(f"- {sentence}", style=style, markup=False, highlight=False)
    if out is not None and not result.refused:
        console.print(f"wrote {out}", highlight=False)
