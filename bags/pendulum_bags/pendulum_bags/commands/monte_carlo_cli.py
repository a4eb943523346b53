"""``experiment monte_carlo``: how sure is the regulation, given what is not known about the plant?"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    from pendulum_bags.studies.joint_monte_carlo import JointMonteCarlo
    from pendulum_bags.studies.monte_carlo import MonteCarlo

__all__ = ["monte_carlo", "options_of_several"]

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

_OF_ONE_JOINT = {"q", "r", "sobol"}
"""Options that plants of several joints do not have."""


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
    from pendulum_bags.studies.monte_carlo import MonteCarlo
    from pendulum_bags.studies.monte_carlo import sobol as sobol_indices
    from pendulum_bags.studies.random_runs import run_monte_carlo
    from pendulum_bags.studies.uncertain import parse_uncertainty
    from pendulum_msgs_py.plants.plant_parameters import is_mechanism

    folder = out or Path("bags", "runs", "monte_carlo")
    console = make_console(stderr=json_output, highlight=False)
    settings: MonteCarlo | JointMonteCarlo
    if is_mechanism(plant):
        settings = _joints(context)
    else:
        settings = MonteCarlo(
            plant=plant,
            runs=runs,
            seed=seed,
            uncertainty=parse_uncertainty(uncertainty, plant),
            q=q,
            r=r,
            amplitude=amplitude,
            hold_time=hold_time,
            start=start,
            duration=duration,
            bound=bound,
            device=device,
        )
    if replay >= 0:
        _replay(console, settings, replay, folder)
        return
    started = time.monotonic()
    with counted_progress(console, "chunks", settings.chunks, folder) as on_progress:
        connect = partial(cluster_client, scheduler, workers)
        result = run_monte_carlo(folder, settings, connect=connect, on_progress=on_progress)
    if sobol and isinstance(settings, MonteCarlo):
        result["sobol"] = sobol_indices(settings, base=sobol)
    elapsed = time.monotonic() - started
    if json_output:
        print(json_text(result))
        return
    if isinstance(settings, MonteCarlo):
        _print_one(console, result)
    else:
        _print_several(console, result)
    console.print(f"replay  add --replay {result['worst'][0]['run']}\nruns    {folder}")
    console.print(f"({elapsed:.0f} s)")


def options_of_several(
    context: typer.Context, of_one_joint: Collection[str], shared: Collection[str]
) -> tuple[str, dict[str, Any]]:
    """Return the uncertainty, and the other options that were typed, of a command on a plant of several joints.

    Args:
        context: Of the command; the defaults of its options are those of one joint.
        of_one_joint: Options that plants of several joints do not have.
        shared: Those that they have.

    Raises:
        ParameterError: One was typed that is not for several joints.
    """
    given = context.params
    if typed := typed_options(context, of_one_joint):
        raise ParameterError(
            f"{typed[0]} is for a plant of one joint, and {given['plant']} has several: its own LQR holds it"
        )
    uncertainty = given["uncertainty"] if typed_options(context, {"uncertainty"}) else "0.05"
    return uncertainty, {name: given[name] for name in shared if typed_options(context, {name})}


def _joints(context: typer.Context) -> JointMonteCarlo:
    """Return the settings for a plant of several joints, of the options that were typed."""
    from pendulum_bags.studies.joint_monte_carlo import JointMonteCarlo, joint_shares

    plant = context.params["plant"]
    shared = ("runs", "seed", "bound", "start", "amplitude", "hold_time", "duration", "device")
    uncertainty, chosen = options_of_several(context, _OF_ONE_JOINT, shared)
    return JointMonteCarlo(plant=plant, shares=joint_shares(uncertainty, plant), **chosen)


def _replay(console: Console, settings: MonteCarlo | JointMonteCarlo, number: int, folder: Path) -> None:
    """Write the motion of a run as CSV, and print what was drawn for it."""
    import numpy as np

    from pendulum_bags.studies.monte_carlo import MonteCarlo
    from pendulum_bags.studies.random_runs import replay

    if isinstance(settings, MonteCarlo):
        header = ["theta_rad", "theta_dot_rad_s", "effort_n_m"]
    else:
        joints = settings.load().coordinates.joints
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


def _print_result(
    console: Console,
    result: dict[str, Any],
    stays: str,
    shares: Mapping[str, float],
    source: str,
    units: Mapping[str, str],
) -> None:
    """Print the probability, what is uncertain, and the quantiles."""
    low, high = result["probability_interval"]
    console.print(
        f"{result['runs']} runs: {stays} of upright with probability {result['probability_inside']:.5f} "
        f"(95 % interval {low:.5f} to {high:.5f})"
    )
    uncertain = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in shares.items()) or "nothing"
    console.print(f"uncertain: {uncertain}{source}")
    quantiles = result["quantiles"]
    table = number_table("Quantiles", "", *next(iter(quantiles.values())), left=0)
    for name, values in quantiles.items():
        table.add_row(_with_unit(name, units), *(f"{value:.5g}" for value in values.values()))
    console.print(table)


def _with_unit(name: str, units: Mapping[str, str]) -> str:
    """Return the name of a parameter or an outcome with its unit, as a cell of a table."""
    return f"{name} \\[{units[name]}]" if name in units else name


def _print_several(console: Console, result: dict[str, Any]) -> None:
    settings, units = result["settings"], result["units"]
    stays = f"{' and '.join(result['joints'])} stay within {settings['bound']:g} rad or m"
    _print_result(console, result, stays, settings["shares"], "", units)
    names = [f"max_{joint}" for joint in result["joints"]]
    table = number_table("Worst runs", "run", "noise seed", *(_with_unit(name, units) for name in names), left=0)
    for row in result["worst"][:5]:
        table.add_row(str(row["run"]), f"{row['noise_seed']:.0f}", *(f"{row[name]:.5f}" for name in names))
    console.print(table)


def _print_one(console: Console, result: dict[str, Any]) -> None:
    from pendulum_bags.identification.model import UNITS

    settings, units = result["settings"], {**UNITS, "max_theta": "rad", "std_theta": "rad", "max_effort": "N m"}
    uncertain = settings["uncertainty"]
    names = list(uncertain["shares"])
    source = f"{', correlated' if uncertain['correlation'] else ''} ({uncertain['source']})"
    stays = f"theta stays within {settings['bound']:g} rad"
    _print_result(console, result, stays, uncertain["shares"], source, units)
    headings = ("run", *(_with_unit(name, units) for name in names), "noise seed", "max theta \\[rad]")
    table = number_table("Worst runs", *headings, left=0)
    for row in result["worst"][:5]:
        table.add_row(
            str(row["run"]),
            *(f"{row[name]:.4g}" for name in names),
            f"{row['noise_seed']:.0f}",
            f"{row['max_theta']:.5f}",
        )
    console.print(table)
    if "sobol" in result:
        table = number_table(f"Sobol indices of {result['sobol']['output']}", "factor", "first order", "total", left=0)
        for entry in result["sobol"]["indices"]:
            table.add_row(
                entry["factor"],
                f"{entry['first']:.4f} ± {entry['first_confidence']:.4f}",
                f"{entry['total']:.4f} ± {entry['total_confidence']:.4f}",
            )
        console.print(table)
