"""``experiment monte_carlo``: how sure is the regulation, given what is not known about the plant?"""

# ruff: noqa: ARG001 (`settings_of` reads the options from the context)
from __future__ import annotations

import time
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.console import Console

from pendulum_bags.figures.terminal_table import number_table
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counted_progress
from pendulum_msgs_py.programs.executables import typed_options
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_sim.batches.devices import DEVICES, resolve_device

if TYPE_CHECKING:
    from pendulum_bags.studies.closed_loops import ClosedLoops
    from pendulum_bags.studies.monte_carlo import MonteCarlo

    Study = TypeVar("Study", bound=ClosedLoops)

__all__ = ["monte_carlo", "settings_of"]

Plant = Annotated[str, typer.Option(help="Preset or plant file; the controller is designed on it.")]
Uncertain = Annotated[
    str,
    typer.Option(
        help="identified (covariance of the plant file), or shares: inertia=0.3,damping=0.05. Of several joints "
        "also one share for all; default 0.05."
    ),
]
Q = Annotated[tuple[float, float], typer.Option(help="Diagonal of Q.")]
R = Annotated[float, typer.Option(help="R.")]
Scheduler = Annotated[str, typer.Option(help="Dask scheduler, tcp://HOST:PORT.")]
Device = Annotated[
    str,
    typer.Option(
        help=f"Where the batches run: {', '.join(DEVICES)}; auto takes a GPU where there is one. Equal to rounding.",
        callback=resolve_device,
    ),
]
Workers = Annotated[int, typer.Option(help="Processes of a local Dask cluster; 0 for none.", min=0)]


def monte_carlo(
    context: typer.Context,
    out: Annotated[
        Path | None,
        out_option("Folder; an interrupted one is gone on with, more runs are added. Default: bags/runs/monte_carlo."),
    ] = None,
    plant: Plant = "thesis",
    uncertainty: Uncertain = "inertia=0.3,damping=0.05,gravity=0.05",
    runs: Annotated[
        int, typer.Option(help="Number of closed-loop runs; of several joints by default 100000.", min=1)
    ] = 1_000_000,
    seed: Annotated[int, typer.Option(help="Seed of everything.", min=0)] = 1,
    bound: Annotated[
        float, typer.Option(help="Distance from upright that a run should not leave [rad]; of several joints 0.2.")
    ] = 0.02,
    start: Annotated[float, typer.Option(help="Largest distance of the start from upright [rad].", min=0.0)] = 0.0,
    amplitude: Annotated[
        float, typer.Option(help="Largest noise torque [N m]; of several joints a tenth of each limit.")
    ] = 2.5,
    hold_time: Annotated[float, typer.Option(help="Time for which a noise sample is held [s].")] = 0.01,
    duration: Annotated[float, typer.Option(help="Length of each run [s].")] = 5.0,
    q: Q = (100.0, 0.01),
    r: R = 0.1,
    sobol: Annotated[int, typer.Option(help="Base sample of Sobol indices, a power of two; 0 for none.", min=0)] = 1024,
    scheduler: Scheduler = "",
    workers: Workers = 0,
    device: Device = "cpu",
    replay: Annotated[int, typer.Option(help="Only replay this run, and write its motion as CSV.")] = -1,
    json_output: Json = False,
) -> None:
    """Run a million closed loops over uncertain parameters, noise and starts; probabilities, worst cases, sensitivity.

    Of a plant of several joints, such as cart_pole, all joints have to stay; its own LQR holds it.
    Results do not depend on the number of workers, bit for bit; each chunk is a Parquet file.

    Example: python -m pendulum_bags experiment monte_carlo --runs 100000 --out /tmp/mc
    """
    from pendulum_bags.studies.chunks import cluster_client
    from pendulum_bags.studies.monte_carlo import MonteCarlo, run_monte_carlo
    from pendulum_bags.studies.monte_carlo import sobol as sobol_indices

    folder = out or Path("bags", "runs", "monte_carlo")
    console = make_console(stderr=json_output, highlight=False)
    settings = settings_of(context, MonteCarlo)
    if replay >= 0:
        _replay(console, settings, replay, folder)
        return
    started = time.monotonic()
    with counted_progress(console, "chunks", settings.chunks, folder) as on_progress:
        connect = partial(cluster_client, scheduler, workers)
        result = run_monte_carlo(folder, settings, connect=connect, on_progress=on_progress)
    if sobol:
        found = sobol_indices(settings, base=sobol)
        # One joint has one output, as it always had.
        result["sobol"] = found[0] if settings.nominal.is_pendulum else found
    elapsed = time.monotonic() - started
    if json_output:
        print(json_text(result))
        return
    _print(console, settings, result)
    console.print(f"replay  add --replay {result['worst'][0]['run']}\nruns    {folder}")
    console.print(f"({elapsed:.0f} s)")


def settings_of(context: typer.Context, kind: type[Study], **others: Any) -> Study:
    """Return the settings that the options of a command make.

    Of a plant of several joints those count that were typed: the defaults of the options are those of one joint.

    Args:
        kind: Of the study; its options have the names of its settings.

    Raises:
        ParameterError: An option was typed that is not for this plant.
    """
    from pendulum_bags.studies.uncertain import parse_uncertainty
    from pendulum_msgs_py.plants.plant_parameters import is_mechanism

    given, plant = context.params, context.params["plant"]
    several = is_mechanism(plant)
    if several and (typed := typed_options(context, kind.ONE_ONLY)):
        raise ParameterError(f"{typed[0]} is for a plant of one joint, and {plant} has several: its own LQR holds it")
    if not several and (typed := typed_options(context, kind.SEVERAL_ONLY)):
        raise ParameterError(f"{typed[0]} is for a plant of several joints, and {plant} has one")
    names = {each.name for each in fields(kind)}.intersection(given) - {"plant", "uncertainty", *others}
    chosen = {name: given[name] for name in names if not several or typed_options(context, {name})}
    text = given["uncertainty"] if not several or typed_options(context, {"uncertainty"}) else "0.05"
    return kind.of(plant, uncertainty=parse_uncertainty(text, plant), **{**chosen, **others})


def _replay(console: Console, settings: MonteCarlo, number: int, folder: Path) -> None:
    import numpy as np

    from pendulum_bags.studies.monte_carlo import replay

    header = ["theta_rad", "theta_dot_rad_s", "effort_n_m"]
    if not settings.nominal.is_pendulum:
        joints = settings.nominal.coordinates.joints
        header = [f"{joint.name}_{joint.unit}" for joint in joints]
        header += [f"{joint.name}_{joint.velocity_unit.replace('/', '_')}" for joint in joints]
        header += [f"{joint.name}_effort_{joint.effort_unit.replace(' ', '_').lower()}" for joint in joints]
    row, motion = replay(settings, number)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"replay_{number}.csv"
    table = np.column_stack([settings.dt * np.arange(len(motion)), motion])
    np.savetxt(path, table, delimiter=",", header=",".join(["time_s", *header]), comments="")
    for name, value in row.items():
        console.print(f"{name:<14} {value:.9g}")
    console.print(f"motion  {path}")


def _print(console: Console, settings: MonteCarlo, result: dict[str, Any]) -> None:
    from pendulum_bags.identification.model import UNITS

    uncertainty, joints = settings.uncertainty, result["joints"]
    one, unit = settings.nominal.is_pendulum, settings.nominal.coordinates.units[0]
    low, high = result["probability_interval"]
    console.print(
        f"{result['runs']} runs: {' and '.join(joints)} {'stays' if len(joints) == 1 else 'stay'} within "
        f"{settings.bound:g} {unit} of upright with probability {result['probability_inside']:.5f} "
        f"(95 % interval {low:.5f} to {high:.5f})"
    )
    uncertain = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in uncertainty.shares.items()) or "nothing"
    source = f"{', correlated' if uncertainty.correlation else ''} ({uncertainty.source})" if one else ""
    console.print(f"uncertain: {uncertain}{source}")
    units = {**UNITS, **result["units"]}

    def with_unit(name: str) -> str:
        return f"{name} \\[{units[name]}]" if name in units else name

    quantiles = result["quantiles"]
    table = number_table("Quantiles", "", *next(iter(quantiles.values())), left=0)
    for name, values in quantiles.items():
        table.add_row(with_unit(name), *(f"{value:.5g}" for value in values.values()))
    console.print(table)
    names = [*(uncertainty.shares if one else ()), "noise_seed", *(f"max_{joint}" for joint in joints)]
    formats = {"noise_seed": ".0f", **{f"max_{joint}": ".5f" for joint in joints}}
    headings = ("noise seed" if name == "noise_seed" else with_unit(name) for name in names)
    table = number_table("Worst runs", "run", *headings, left=0)
    for row in result["worst"][:5]:
        table.add_row(str(row["run"]), *(format(row[name], formats.get(name, ".4g")) for name in names))
    console.print(table)
    found = result.get("sobol", [])
    for output in found if isinstance(found, list) else [found]:
        table = number_table(f"Sobol indices of {output['output']}", "factor", "first order", "total", left=0)
        for entry in output["indices"]:
            table.add_row(
                entry["factor"],
                f"{entry['first']:.4f} ± {entry['first_confidence']:.4f}",
                f"{entry['total']:.4f} ± {entry['total_confidence']:.4f}",
            )
        console.print(table)
