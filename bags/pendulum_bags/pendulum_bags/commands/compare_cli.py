"""``compare``: compare simulation and hardware from two bags or from run folders, with a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pendulum_bags.commands.recording_options import (
    Dt,
    Mappings,
    Start,
    Stop,
    Topics,
    WriteMapping,
    readings_of,
    show_guesses,
)
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json, out_option

if TYPE_CHECKING:
    from rich.console import Console

    from pendulum_bags.comparison import Comparison
    from pendulum_bags.frequency_response.designs import DesignResult
    from pendulum_bags.recordings.reading import Reading
    from pendulum_bags.verdict import Answer

__all__ = ["main"]


Paths = Annotated[
    list[Path],
    typer.Argument(
        help="Recording of the simulation and of the hardware (bag, .mat, .csv, .npz, .parquet, ...; several of a run "
        "that was repeated), or run folders with sim and hw."
    ),
]
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


def compare(
    paths: Paths,
    margin: MarginOption = None,
    margins_file: MarginsFile = None,
    layers: LayersOption = None,
    machine: MachineOption = None,
    design: DesignOption = None,
    out: Annotated[
        Path | None,
        out_option("Folder for comparison.json and figures; none by default."),
    ] = None,
    own_protocol: Annotated[
        Path | None,
        typer.Option(help="Bag of a simulation with noise of its own, for the thesis's analysis."),
    ] = None,
    sim_prefix: Annotated[str | None, typer.Option(help="Namespace of the simulation's topics.")] = None,
    hw_prefix: Annotated[str | None, typer.Option(help="Namespace of the hardware's topics.")] = None,
    joint: Annotated[
        str | None, typer.Option(help="One joint of plants of several; by default all, and one answer.")
    ] = None,
    mapping: Mappings = None,
    write_mapping: WriteMapping = None,
    topic: Topics = None,
    dt: Dt = None,
    start: Start = None,
    stop: Stop = None,
    json_output: Json = False,
) -> None:
    """Compare simulation and hardware: statistics of the difference, equivalence tests, a verdict.

    Of recordings that say nothing of an experiment, what both recorded (a disturbance, a reference, an input) decides
    which tests there are.

    Where the hardware's frequency response was measured, it also lists which designs carry over. Plants of several
    joints are compared joint by joint.

    Example: python -m pendulum_bags compare runs/today/sim runs/today/hw --margin delay=8ms --margin spread_angle=20%
    """
    from pendulum_bags.comparison import Margins, compare_folders, compare_runs
    from pendulum_bags.frequency_response.designs import designs_table
    from pendulum_bags.runs.cached_bags import CachedBags
    from pendulum_bags.runs.run_data import joints_of, shared_joints
    from pendulum_bags.verdict.terminal import print_answer
    from pendulum_msgs_py.programs.terminal import make_console

    margins = Margins.of(margins_file, margin)
    readings: Sequence[Reading] = ()
    # Guesses are shown even if an error follows.
    with ExitStack() as guesses, CachedBags() as bags:
        if all((path / "sim").is_dir() and (path / "hw").is_dir() for path in paths):
            run = partial(compare_folders, paths, margin=margins)
            joints = dict.fromkeys(joints_of(paths[0] / "sim", open_bag=bags))
        elif len(paths) > 1:
            readings = readings_of(paths, mapping, topic, dt, start, stop)
            guesses.callback(show_guesses, make_console(stderr=json_output), readings, write_mapping)
            run = partial(
                compare_runs,
                *readings,
                sim_prefix=sim_prefix,
                hw_prefix=hw_prefix,
                own_protocol=own_protocol,
                margin=margins,
            )
            joints = shared_joints(readings, (sim_prefix, hw_prefix), open_bag=bags)
        else:
            raise DataError(
                f"got {', '.join(map(str, paths)) or 'no path'}; "
                "expected recordings of a simulation and of hardware, or run folders that hold sim and hw"
            )
        sources = [*(paths if len(paths) == 1 else ()), *(layers or ())]
        if joints or joint:
            if machine or design:
                raise DataError("--machine and --design are of plants of one joint; expected neither for several")
            # Bags of one joint are closed one by one.
            run = partial(run, open_bag=bags)
            run = partial(run, joints=joints) if readings else run
            results = {name: run(joint=name) for name in ([joint] if joint else joints)}
        else:
            results = {"": run()}
        answer, content, certified = _judge(results, sources, machine, design or ())
    run_folder = paths[0] if len(paths) == 1 else paths[0].parent
    of_run = len(paths) == 1 or [*paths] == [run_folder / "sim", run_folder / "hw"]
    margins_file = margins.keep(run_folder) if margins.stated and of_run else None
    if out is not None:
        _write(out, results, content)
    if json_output:
        print(json_text(content))
        return
    console = make_console()
    for name, result in results.items():
        if name:
            console.print(f"Joint {name}", style="bold")
        _print(console, result, content["joints"][name] if name else content)
    if certified:
        console.print(designs_table(certified))
    print_answer(console, answer)
    if margins_file:
        print(f"margins {margins_file} (report uses them)")
    if out is not None:
        print(f"\nwritten: {out / 'comparison.json'} and figures next to it")


def _judge(
    results: Mapping[str, Comparison], sources: Sequence[Path], machine: Path | None, designs: Sequence[str]
) -> tuple[Answer, dict[str, Any], Sequence[DesignResult]]:
    from pendulum_bags.frequency_response.carry_over import carry_over, layers_of
    from pendulum_bags.verdict.answer import answer_of

    if "" not in results:
        answer = answer_of(results, sources)
        joints = {joint: result.to_json() for joint, result in results.items()}
        return answer, {"joints": joints, "answer": answer.to_json()}, ()
    certified = carry_over(results[""], sources, machine, designs)
    answer = answer_of(results[""], sources, updated=layers_of(certified))
    content = {**results[""].to_json(), "answer": answer.to_json()}
    if certified is None:
        return answer, content, ()
    return answer, {**content, "designs": [one.to_json() for one in certified.designs]}, certified.designs


def _write(out: Path, results: Mapping[str, Comparison], content: dict[str, Any]) -> None:
    from pendulum_bags.figures.render_files import write_figures
    from pendulum_bags.report.figures import comparison_figures
    from pendulum_bags.report.joint_figures import joints_together
    from pendulum_bags.runs.run_folder import write_json

    write_json(out / "comparison.json", content)
    figures = comparison_figures(results[""]) if "" in results else [joints_together(results)]
    write_figures(figures, out / "figures")


def _print(console: Console, result: Comparison, content: dict[str, Any]) -> None:
    from pendulum_bags.figures.terminal_table import number_table, plants_table
    from pendulum_bags.runs.run_data import timing_warning
    from pendulum_bags.verdict.terminal import print_tests

    motion = result.pairs[0].simulation.window
    unit, what = motion.unit, "x" if motion.slides else "theta"
    plants = content["plants"]
    pooled = f", all samples of {len(result.pairs)} runs" if len(result.pairs) > 1 else ""
    noise = [] if result.of_files else [("noise held for \\[s]", "noise_hold_time", ".4f")]
    rows = [
        ("recorded \\[s]" if result.of_files else "noise recorded \\[s]", "duration_s", ".1f"),
        ("rate \\[Hz]", "rate_hz", ".1f"),
        ("missed deadlines", "missed_deadlines", ".0f"),
        *noise,
        (f"std of {what} \\[{unit}]", "std_theta", ".5f"),
        (f"std of {what}' \\[{unit}/s]", "std_theta_dot", ".5f"),
    ]
    if not result.of_files or all(plant["max_abs_u"] for plant in plants.values()):
        rows.append((f"max |u| \\[{motion.effort_unit}]", "max_abs_u", ".4f"))
    if any("rms_tracking_error" in plant for plant in plants.values()):
        rows.append(("rms of tracking error \\[rad]", "rms_tracking_error", ".5f"))
    when = "in the part that both have" if result.of_files else "during the noise"
    console.print(plants_table(f"Plants {when}{pooled}", list(plants), list(plants.values()), rows))
    blocks = [("paired", content["paired"])] if "position" in content["paired"] else []
    if not (blocks and result.of_files):
        blocks.append(("unpaired", content["unpaired"]))
    headings = (f"{title} \\[{of}]" for title, _ in blocks for of in (unit, f"{unit}/s"))
    statistics = number_table("Hardware minus simulation", "", *headings)
    for name in content["unpaired"]["position"]:
        cells = [f"{block[key][name]:.4g}" for _, block in blocks for key in ("position", "velocity")]
        statistics.add_row(name, *cells)
    console.print(statistics)
    for name, plant in plants.items():
        for sentence in dict.fromkeys(plant["damage"]):
            console.print(f"{name}: {sentence}", style="bold red", highlight=False, markup=False)
    if warning := timing_warning(plants):
        console.print(warning, style="bold red", highlight=False)
    if result.of_files:
        pass  # the notes say what both share
    elif result.is_paired:
        pair = result.pairs[0]
        delay = result.delay * 1e3
        answers = f"responds {abs(delay):.2f} ms {'later' if delay >= 0 else 'earlier'} than the simulation"
        console.print(
            f"Alignment: the disturbances agree at {pair.clock.delay * 1e3:.2f} ms"  # type: ignore[union-attr]
            f" (correlation {pair.clock.correlation:.3f}); "  # type: ignore[union-attr]
            f"{result.hardware_name} {answers if math.isfinite(delay) else 'shows no measurable delay'}."
        )
    else:
        console.print(f"Not paired: {content['paired']['reason']}.")
    for note in result.notes:
        console.print(note, style="yellow", highlight=False, markup=False)
    if result.operating is not None:
        console.print(result.operating.sentence, highlight=False)
    if result.verdict.tests:
        print_tests(console, result)


main = command_line(compare, "python -m pendulum_bags compare")
