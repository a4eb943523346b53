"""``python -m pendulum_bags identify``: find the parameters of a pendulum from recordings."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from pendulum_bags.commands.recording_options import Dt, Mappings, Topics, WriteMapping, readings_of, show_guesses
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.friction_terms import FRICTION_TERMS
from pendulum_msgs_py.programs.executables import cli_main, typed_options
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_msgs_py.programs.typed_commands import as_typed

if TYPE_CHECKING:
    from pendulum_bags.identification.result import IdentificationResult
    from pendulum_bags.identification.simulation_result import SimulationResult
    from pendulum_bags.identification.thesis import ThesisResult
    from pendulum_bags.recordings.reading import Reading
    from pendulum_bags.runs.datasets import Recording

__all__ = ["app", "main"]

Hold = Annotated[
    str | None,
    typer.Option(help="Input of a CSV between its samples: zero (a held command) or linear (measured)."),
]
_OF_READING = frozenset({"mapping", "write_mapping", "topic", "dt"})
_FOR_SEVERAL_JOINTS = frozenset({"plant", *_OF_READING, "hold", "window", "held_out", "out", "name", "page", "as_json"})
_FOR_SIMULATION = _FOR_SEVERAL_JOINTS - {"name", "page"} | {"model", "parameter", "model_mapping"}
_FOR_REGRESSION = frozenset({"method", *_OF_READING, "hold", "experiment", "skew", "out", "page", "as_json", "verbose"})
_FOR_REGRESSION_ALONE = frozenset({"experiment", "skew", "verbose"})

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command()
def identify(
    context: typer.Context,
    data: Annotated[list[Path], typer.Argument(help="Recordings of one plant, of any format.")],
    method: Annotated[str, typer.Option(help="output_error, or thesis (two linear regressions).")] = "output_error",
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    hold: Hold = None,
    effort: Annotated[str, typer.Option(help="Of a bag: applied (what the plant received) or measured.")] = "applied",
    experiment: Annotated[
        str, typer.Option(help="With --method thesis: inertia_damping or gravity; auto asks the recording.")
    ] = "auto",
    skew: Annotated[
        float | None,
        typer.Option(
            help="With --method thesis: longest time between velocity and effort of one sample [s]; by default "
            "0.0005 for bags, half a sampling period for files."
        ),
    ] = None,
    friction: Annotated[
        str,
        typer.Option(
            help="auto, viscous, coulomb, stribeck, load, stribeck_load, gear_load, "
            f"{''.join(f'{name}, ' for name in FRICTION_TERMS if name != 'load')}..."
        ),
    ] = "auto",
    window: Annotated[float | None, typer.Option(help="Length of the shooting windows [s].")] = None,
    mass: Annotated[float | None, typer.Option(help="Moving mass [kg], to check or fix the scale.")] = None,
    length: Annotated[float | None, typer.Option(help="Joint axis to centre of mass [m].")] = None,
    inertia: Annotated[float | None, typer.Option(help="About the joint axis [kg m^2], if known.")] = None,
    fix_scale: Annotated[bool, typer.Option(help="Take the scale of torque from mass and length.")] = False,
    held_out: Annotated[
        list[Path] | None, typer.Option(help="Recordings to score only; may be given more than once.")
    ] = None,
    out: Annotated[
        Path | None,
        out_option("Plant file to write (*.yaml), with a .json and figures next to it; of --model, the same file."),
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the plant in that file.")] = "identified",
    effort_limit: Annotated[float, typer.Option(help="Largest torque of the actuator [N m].")] = 13.0,
    plant: Annotated[
        str | None,
        typer.Option(
            help="For several joints: mechanism to start from, such as double_pendulum, or a plant file; data are "
            "bags, or CSV files with all joints."
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(help="MJCF or URDF file in which numbers are identified; --out writes the same file with them."),
    ] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            help="With --model: number to fit, such as joint/arm/damping, body/link/mass or actuator/motor/gear, with "
            "=LOW:HIGH to bound it; may be given more than once. By default those that the recordings show."
        ),
    ] = None,
    model_mapping: Annotated[
        Path | None, typer.Option(help="With --model: its mapping file, as of --simulation.")
    ] = None,
    page: Annotated[bool, typer.Option(help="With --out: write figures and a page too.")] = True,
    as_json: Json = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="With --method thesis: the full table of every trial's regression, too.")
    ] = False,
) -> None:
    """Identify a pendulum from recordings.

    Example: python -m pendulum_bags identify run1.csv run2.csv --mass 0.6 --length 0.5 --out plant.yaml

    Several joints: python -m pendulum_bags identify run1.csv run2.csv --plant double_pendulum --mapping columns.yaml
    --held-out run3.csv --out plant.yaml

    Numbers of a MuJoCo model: python -m pendulum_bags identify run1.csv --model robot.xml --out new.xml
    """
    from pendulum_bags.runs.read_recording import read_recording

    paths = [*data, *(held_out or [])]
    readings = readings_of(paths, _mappings(mapping, len(data), len(paths)), topic, dt)
    # Guesses are shown even if an error follows.
    context.call_on_close(partial(show_guesses, make_console(stderr=True), readings, write_mapping))
    if model is not None:
        _refuse_unheeded(context, "--model", _FOR_SIMULATION)
        found_in_file = _of_model(model, model_mapping, plant, parameter, readings, len(data), window, hold, out)
        written = found_in_file.write(out) if out and not found_in_file.refused else None
        _finish(found_in_file, written, False, as_json)
        return
    if parameter or model_mapping:
        raise DataError("--parameter and --model-mapping have no effect without --model; expected it with them")
    if plant is not None:
        _refuse_unheeded(context, "--plant", _FOR_SEVERAL_JOINTS)
        from pendulum_bags.identification.identify import RATIOS, identify_joints
        from pendulum_bags.identification.joint_recordings import read_joints
        from pendulum_msgs_py.plants.plant_parameters import load_mechanism

        start = load_mechanism(plant)
        if len(start.joints) == 1:
            raise DataError(f"plant {start.name!r} has one joint; expected a mechanism, or no --plant for one joint")
        logs = [read_joints(reading, start.coordinates, hold=hold) for reading in readings]
        if start.coordinates.volts:
            make_console(stderr=True).print(RATIOS, highlight=False)
        joints = identify_joints(start, logs[: len(data)], held_out=logs[len(data) :], window=window)
        _finish(joints, joints.write(out, name=name) if out and not joints.refused else None, page, as_json)
        return
    if method not in {"output_error", "thesis"}:
        raise DataError(f"method is {method!r}; expected output_error or thesis")
    if effort not in {"applied", "measured"}:
        raise DataError(f"effort is {effort!r}; expected applied or measured")
    if method == "thesis":
        _refuse_unheeded(context, "--method thesis", _FOR_REGRESSION)
        recordings = [read_recording(reading, effort="measured", hold=hold) for reading in readings]
        result = _thesis(recordings, experiment, skew, out, page)
        if as_json:
            typer.echo(json_text(result.to_dict()))
        else:
            _print_thesis(result, verbose=verbose)
        return
    if unheeded := typed_options(context, _FOR_REGRESSION_ALONE):
        raise DataError(
            f"{', '.join(unheeded)} has no effect with --method {method}; expected it with --method thesis only"
        )
    from pendulum_bags.identification.identify import identify as run
    from pendulum_bags.identification.options import Geometry, Options

    options = Options(window=window, friction=friction, geometry=Geometry(mass, length, inertia), fix_scale=fix_scale)
    everything = [read_recording(reading, effort=effort, hold=hold) for reading in readings]
    found = run(everything[: len(data)], options, held_out=everything[len(data) :])
    written = found.write(out, name=name, effort_limit=effort_limit) if out and not found.refused else None
    _finish(found, written, page, as_json, contradicts=found.geometry is not None and found.geometry.contradicts)


def _of_model(
    path: Path,
    mapping: Path | None,
    plant: str | None,
    parameters: Sequence[str] | None,
    readings: Sequence[Reading],
    count: int,
    window: float | None,
    hold: str | None,
    out: Path | None,
) -> SimulationResult:
    """Return the numbers of a model file, fitted to the first ``count`` readings and scored on the others."""
    from pendulum_bags.identification.joint_recordings import read_joints
    from pendulum_bags.identification.simulation_model import MujocoMotion
    from pendulum_bags.identification.simulation_result import identify_simulation
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism
    from pendulum_sim.foreign.model_source import ModelSource
    from pendulum_sim.foreign.mujoco_mapping import load_mujoco_mapping

    coordinates = None if plant is None else load_mechanism(plant).coordinates
    entries = load_mujoco_mapping(mapping, () if coordinates is None else coordinates.joints) if mapping else None
    if all(one.motion.joints[0].drive is None for one in readings) and coordinates is None:
        coordinates = replace(ONE_JOINT, driven=())
    source = ModelSource(path)
    if out is not None:
        source.check_target(out)
    motion = MujocoMotion(source, entries, coordinates)
    logs = [read_joints(reading, motion.coordinates, hold=hold) for reading in readings]
    wanted = dict(map(_wanted, parameters or ()))
    options = {"mapping": str(mapping)} if mapping else {}
    if plant is not None:
        options["plant"] = plant
    return identify_simulation(motion, logs[:count], wanted, held_out=logs[count:], window=window, simulation=options)


def _wanted(text: str) -> tuple[str, tuple[float, float] | None]:
    """Return path and domain of a ``--parameter``."""
    name, equals, ends = text.partition("=")
    if not equals:
        return name, None
    try:
        low, high = (float(end) for end in ends.split(":"))
    except ValueError:
        low, high = 1.0, 0.0
    if not low < high:
        raise DataError(f"--parameter is {text!r}; expected PATH, or PATH=LOW:HIGH with two numbers, LOW the smaller")
    return name, (low, high)


def _finish(
    result: IdentificationResult, written: Path | None, page: bool, as_json: bool, *, contradicts: bool = False
) -> None:
    """Write the page, print the result; exit with 3 where it is not credible."""
    if written is not None and page:
        from pendulum_bags.identification.page import write_page

        write_page(result, written.with_suffix(""))
    if as_json:
        typer.echo(json_text(result.to_dict()))
    else:
        _print_result(result, written)
    if result.refused or contradicts:
        raise typer.Exit(3)


def _refuse_unheeded(context: typer.Context, way: str, heeded: Collection[str]) -> None:
    """Refuse options that would have no effect."""
    if unheeded := typed_options(context, set(context.params) - {"data", *heeded}):
        raise DataError(
            f"{', '.join(unheeded)} has no effect with {way}; expected none but "
            + ", ".join(f"--{name.replace('as_', '').replace('_', '-')}" for name in sorted(heeded))
        )


def _mappings(given: Sequence[str] | None, recordings: int, total: int | None = None) -> list[str | None]:
    """Return the mapping of each recording, those to score after those to fit."""
    count = total or recordings
    if not given:
        return [None] * count
    if len(given) == 1:
        return [given[0]] * count
    if len(given) not in {recordings, count}:
        raise DataError(
            f"--mapping is given {len(given)} times for {recordings} recordings; expected once for all, "
            "or once for each"
        )
    return [*given, *[given[-1]] * (count - len(given))]


def _thesis(
    recordings: Sequence[Recording],
    experiment: str,
    skew: float | None,
    out: Path | None,
    page: bool,
) -> ThesisResult:
    from pendulum_bags.identification.thesis import fit_gravity, fit_inertia_damping, static_holds

    if experiment not in {"auto", "inertia_damping", "gravity"}:
        raise DataError(f"experiment is {experiment!r}; expected auto, inertia_damping or gravity")
    if experiment == "auto":
        experiment = "gravity" if all(len(static_holds(r)) >= 4 for r in recordings) else "inertia_damping"
    gravity = experiment == "gravity"
    result = fit_gravity(recordings) if gravity else fit_inertia_damping(recordings, skew=skew)
    if out is not None:
        write_json(out.with_suffix(".json"), result.to_dict())
        if page:
            from pendulum_bags.identification.page import write_thesis_page

            write_thesis_page(result, recordings, out.with_suffix(""))
    return result


def _print_thesis(result: ThesisResult, *, verbose: bool) -> None:
    from pendulum_bags.identification.model import UNITS
    from pendulum_msgs_py.programs.terminal import WholeTable

    console = make_console()
    title = f"Average over {len(result.trials)} trial{'s' if len(result.trials) != 1 else ''}"
    table = WholeTable("coefficient", "value", "95 % interval", "unit", title=title)
    for key, value in result.average.items():
        low, high = result.intervals[key]
        table.add_row(key, f"{value:.5g}", f"{low:.5g} to {high:.5g}", UNITS[key])
    console.print(table)
    headings = ("trial", *(f"{name} \\[{UNITS[name]}]" for name in result.trials[0].names), "R^2")
    trials = WholeTable(*headings, title="Regression of each trial: value and standard error")
    for regression in result.trials:
        figures = zip(regression.values, regression.errors, strict=True)
        cells = (f"{value:.5g} +- {error:.2g}" for value, error in figures)
        trials.add_row(regression.trial, *cells, f"{regression.r_squared:.5f}")
    console.print(trials)
    for sentence in result.sentences:
        console.print(f"- {sentence}", markup=False, highlight=False)
    if not verbose:
        console.print("--verbose prints the full table of each regression", highlight=False)
        return
    for regression in result.trials:
        console.print(f"[bold]{regression.trial}[/bold]")
        print(_narrow(regression.summary))


def _narrow(summary: str) -> str:
    """Remove blanks from the head of statsmodels' summary, which its labels widened."""
    lines, width = [line.rstrip() for line in summary.splitlines()], 78
    rules = [index for index, line in enumerate(lines) if line and not line.strip("=")]
    excess = len(lines[rules[0]]) - width if len(rules) > 1 else 0
    if excess > 0:
        lines[rules[0]] = "=" * width
        for index in range(rules[0] + 1, rules[1]):
            if len(lines[index]) > width:
                lines[index] = re.sub(rf" {{{excess}}}(?= *\S+$)", "", lines[index], count=1)
    return "\n".join(lines)


def _print_result(result: IdentificationResult, out: Path | None) -> None:
    from pendulum_msgs_py.programs.terminal import WholeTable

    console = make_console()
    style = "bold red" if result.refused else "bold"
    console.print(result.verdict, style=style, markup=False, highlight=False)
    if result.refused:
        _print_sentences(console, result.sentences()[1:])
        return
    for one in result.tables():
        if one.rows:
            table = WholeTable(*map(escape, one.head), title=one.title)
            for row in one.rows:
                table.add_row(*row)
            console.print(table)
            if one.sentence:
                console.print(one.sentence, highlight=False)
    _print_sentences(console, result.sentences())
    if out is not None:
        console.print(f"wrote {out}", highlight=False)
        sentence, command = result.next_step(str(out))
        console.print(f"{sentence}\n  {as_typed(command)}", markup=False, highlight=False, soft_wrap=True)


def _print_sentences(console: Console, sentences: Sequence[str]) -> None:
    from pendulum_bags.identification.result import ALARMS

    for sentence in sentences:
        style = "bold red" if sentence.startswith(ALARMS) else None
        console.print(f"- {sentence}", style=style, markup=False, highlight=False)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code: 0, 2 for an error, 3 for a fit not to be believed."""
    # Small matrices: BLAS threads only slow them down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return cli_main(app, argv, name="python -m pendulum_bags identify")
