"""``compare``: compare simulation and hardware from two bags or from run folders, with a verdict."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.executables import cli_main

if TYPE_CHECKING:
    from pendulum_bags.comparison import Comparison
    from pendulum_bags.frequency_response.designs import DesignResult
    from pendulum_bags.verdict import Answer

__all__ = ["main"]

app = typer.Typer(add_completion=False, rich_markup_mode=None)

Paths = Annotated[list[Path], typer.Argument(help="Simulation and hardware bag, or run folders with sim and hw.")]
MarginOption = Annotated[
    list[str] | None,
    typer.Option(
        "--margin",
        help="Largest difference that does not matter to your task: mean_angle=0.3deg, spread_angle=20%, delay=8ms, "
        "path_angle=0.2deg ...; may be given several times.",
    ),
]
MarginsFile = Annotated[
    Path | None, typer.Option("--margins", help="File of margins, as bags/pendulum_bags/comparison/margins.yaml.")
]

DesignOption = Annotated[
    list[str] | None,
    typer.Option(
        "--design",
        help="Design whose certificate for the measured machine is wanted: 'q=100,0.01 r=0.1', 'k=33,0.2', a "
        "controller's name or a policy file (.npz); several times if wanted. By default those that were certified when "
        "it was measured, and the policy that ran.",
    ),
]
MachineOption = Annotated[
    Path | None,
    typer.Option(
        "--machine",
        help="Measured response of the hardware (hw_response.json of experiment frequency_response, or its folder); "
        "by default that of the run folder or of --layers.",
    ),
]
LayersOption = Annotated[
    list[Path] | None,
    typer.Option("--layers", help="Folder of a frequency_response or ranking experiment; several times if wanted."),
]


@app.command()
def compare(
    paths: Paths,
    margin: MarginOption = None,
    margins_file: MarginsFile = None,
    layers: LayersOption = None,
    machine: MachineOption = None,
    design: DesignOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for comparison.json and figures; none by default."),
    ] = None,
    own_protocol: Annotated[
        Path | None,
        typer.Option(help="Bag of a simulation with noise of its own, for the thesis's analysis."),
    ] = None,
    sim_prefix: Annotated[str | None, typer.Option(help="Namespace of the simulation's topics.")] = None,
    hw_prefix: Annotated[str | None, typer.Option(help="Namespace of the hardware's topics.")] = None,
    json_output: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Compare simulation and hardware under noise: statistics of the difference, equivalence tests, a verdict.

    Where the hardware's frequency response was measured, it also lists which designs carry over.

    Example: python -m pendulum_bags compare runs/today/sim runs/today/hw --margin delay=8ms --margin spread_angle=20%
    """
    from pendulum_bags.comparison import Margins, compare_folders, compare_runs
    from pendulum_bags.frequency_response.carry_over import carry_over, layers_of
    from pendulum_bags.verdict.answer import answer_of

    margins = Margins.of(margins_file, margin)
    if all((path / "sim").is_dir() and (path / "hw").is_dir() for path in paths):
        result = compare_folders(paths, margin=margins)
    elif len(paths) == 2:
        result = compare_runs(
            paths[0],
            paths[1],
            sim_prefix=sim_prefix,
            hw_prefix=hw_prefix,
            own_protocol=own_protocol,
            margin=margins,
        )
    else:
        raise DataError(
            f"got {len(paths)} paths ({', '.join(map(str, paths))}); "
            "expected a simulation and a hardware bag, or run folders that hold sim and hw"
        )
    kept = [*(paths if len(paths) == 1 else ()), *(layers or ())]
    certified = carry_over(result, kept, machine, design or ())
    answer = answer_of(result, kept, anew=layers_of(certified))
    content = {**result.to_json(), "answer": answer.to_json()}
    if certified is not None:
        content["designs"] = [one.to_json() for one in certified.designs]
    if out is not None:
        _write(out, result, content)
    if json_output:
        print(json.dumps(content, indent=2, allow_nan=False))
    else:
        _print(result, answer, content, certified.designs if certified else ())
        if out is not None:
            print(f"\nwritten: {out / 'comparison.json'} and figures beside it")


def _write(out: Path, result: Comparison, content: dict[str, Any]) -> None:
    from pendulum_bags.figures.render_files import write_figures
    from pendulum_bags.report.figures import comparison_figures
    from pendulum_bags.runs.run_folder import write_json

    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "comparison.json", content)
    write_figures(comparison_figures(result), out / "figures")


def _print(result: Comparison, answer: Answer, content: dict[str, Any], designs: Sequence[DesignResult]) -> None:
    from pendulum_bags.frequency_response.designs_table import designs_table
    from pendulum_bags.runs.run_data import timing_warning
    from pendulum_bags.verdict.terminal import print_answer
    from pendulum_msgs_py.programs.terminal import WholeTable, make_console

    console = make_console()
    plants = content["plants"]
    table = WholeTable(title="Plants during the noise", title_justify="left")
    for heading in ("", *plants):
        table.add_column(heading, justify="left" if not heading else "right")
    for label, key, form in (
        ("rate \\[Hz]", "rate_hz", ".1f"),
        ("missed deadlines", "missed_deadlines", ".0f"),
        ("noise held for \\[s]", "noise_hold_time", ".4f"),
        ("std of theta \\[rad]", "std_theta", ".5f"),
        ("std of theta' \\[rad/s]", "std_theta_dot", ".5f"),
        ("max |u| \\[N m]", "max_abs_u", ".4f"),
    ):
        table.add_row(label, *(_number(plant.get(key), form) for plant in plants.values()))
    if any("rms_tracking_error" in plant for plant in plants.values()):
        errors = (_number(plant.get("rms_tracking_error"), ".5f") for plant in plants.values())
        table.add_row("rms of tracking error \\[rad]", *errors)
    console.print(table)
    blocks = [("paired", content["paired"])] if "position" in content["paired"] else []
    blocks.append(("unpaired", content["unpaired"]))
    statistics = WholeTable(title="Hardware minus simulation", title_justify="left")
    statistics.add_column("")
    for title, _ in blocks:
        statistics.add_column(f"{title} \\[rad]", justify="right")
        statistics.add_column(f"{title} \\[rad/s]", justify="right")
    for name in content["unpaired"]["position"]:
        cells = [f"{block[key][name]:.4g}" for _, block in blocks for key in ("position", "velocity")]
        statistics.add_row(name, *cells)
    console.print(statistics)
    if warning := timing_warning(plants):
        console.print(warning, style="bold red", highlight=False)
    if result.is_paired:
        pair = result.pairs[0]
        delay = result.delay * 1e3
        late = "later" if delay >= 0 else "earlier"
        console.print(
            f"Alignment: the disturbances agree at {pair.clock.delay * 1e3:.2f} ms"  # type: ignore[union-attr]
            f" (correlation {pair.clock.correlation:.3f}); "  # type: ignore[union-attr]
            f"{result.hardware_name} answers {abs(delay):.2f} ms {late} than the simulation."
        )
    else:
        console.print(f"Not paired: {content['paired']['reason']}.")
    for note in result.left_out:
        console.print(note, style="yellow", highlight=False, markup=False)
    if designs:
        console.print(designs_table(designs))
    print_answer(console, answer, result.verdict, emulated=result.is_emulated)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m pendulum_bags compare")
