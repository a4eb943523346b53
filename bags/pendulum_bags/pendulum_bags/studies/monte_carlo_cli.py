"""``experiment monte_carlo``: how sure is the regulation, given what is not known about the plant?"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.counted_progress import counted_progress
from pendulum_msgs_py.programs.executables import typed_options
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

if TYPE_CHECKING:
    from pendulum_bags.studies.chunks import Connect

__all__ = ["monte_carlo"]


_OF_ONE_JOINT = {"q", "r", "sobol"}
"""Options that plants of several joints do not have."""


def monte_carlo(
    context: typer.Context,
    out: Annotated[
        Path | None,
        out_option("Folder; an interrupted one is gone on with, more runs are added. Default: bags/runs/monte_carlo."),
    ] = None,
    plant: Annotated[str, typer.Option(help="Preset or plant file; the controller is designed on it.")] = "thesis",
    uncertainty: Annotated[
        str,
        typer.Option(
            help="identified (covariance of the plant file), or shares: inertia=0.3,damping=0.05. Of several joints "
            "also one share for all; default 0.05."
        ),
    ] = "inertia=0.3,damping=0.05,gravity=0.05",
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
    q: Annotated[tuple[float, float], typer.Option(help="Diagonal of Q.")] = (100.0, 0.01),
    r: Annotated[float, typer.Option(help="R.")] = 0.1,
    sobol: Annotated[int, typer.Option(help="Base sample of Sobol indices, a power of two; 0 for none.", min=0)] = 1024,
    scheduler: Annotated[str, typer.Option(help="Dask scheduler, tcp://HOST:PORT.")] = "",
    workers: Annotated[int, typer.Option(help="Processes of a local Dask cluster; 0 for none.", min=0)] = 0,
    replay: Annotated[int, typer.Option(help="Only replay this run, and write its motion as CSV.")] = -1,
    json_output: Json = False,
) -> None:
    """Run a million closed loops over uncertain parameters, noise and starts; probabilities, worst cases, sensitivity.

    Of a plant of several joints, such as cart_pole, all joints have to stay; its own LQR holds it.
    Results do not depend on the number of workers, bit for bit; each chunk is a Parquet file.

    Example: python -m pendulum_bags experiment monte_carlo --runs 100000 --out /tmp/mc
    """
    from pendulum_bags.studies import monte_carlo as engine
    from pendulum_bags.studies.chunks import cluster_client
    from pendulum_bags.studies.uncertain import parse_uncertainty
    from pendulum_msgs_py.plants.plant_parameters import is_mechanism

    folder = out or Path("bags", "runs", "monte_carlo")
    console = make_console(stderr=json_output, highlight=False)
    connect = partial(cluster_client, scheduler, workers)
    if is_mechanism(plant):
        _joints(context, console, folder, connect, replay, json_output=json_output)
        return
    settings = engine.MonteCarlo(
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
    )
    if replay >= 0:
        _replay(console, settings, replay, folder)
        return
    started = time.monotonic()
    with counted_progress(console, "chunks", settings.chunks, folder) as on_progress:
        result = engine.run_monte_carlo(folder, settings, connect=connect, on_progress=on_progress)
    if sobol:
        result["sobol"] = engine.sobol(settings, base=sobol)
    elapsed = time.monotonic() - started
    if json_output:
        print(json.dumps(result, indent=2))
    else:
        _print(console, result, folder)
        console.print(f"({elapsed:.0f} s)")


def _joints(
    context: typer.Context, console: Console, folder: Path, connect: Connect, number: int, *, json_output: bool
) -> None:
    """Run the Monte Carlo of a plant of several joints, with the options that were typed."""
    from pendulum_bags.studies import joint_monte_carlo as engine
    from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism

    given, plant = context.params, context.params["plant"]
    if typed := typed_options(context, _OF_ONE_JOINT):
        raise ParameterError(f"{typed[0]} is for a plant of one joint, and {plant} has several: its own LQR holds it")
    told = given["uncertainty"] if typed_options(context, {"uncertainty"}) else "0.05"
    chosen = {
        name: given[name]
        for name in ("runs", "seed", "bound", "start", "amplitude", "hold_time", "duration")
        if typed_options(context, {name})
    }
    settings = engine.JointMonteCarlo(plant=plant, shares=engine.joint_shares(told, plant), **chosen)
    if number >= 0:
        joints = load_mechanism(plant).coordinates.joints
        header = [f"{joint.name}_{joint.unit}" for joint in joints]
        header += [f"{joint.name}_{joint.velocity_unit.replace('/', '_')}" for joint in joints]
        header += [f"{joint.name}_effort_{joint.effort_unit.replace(' ', '_').lower()}" for joint in joints]
        _tell_replay(console, folder, number, settings.dt, header, *engine.replay_joints(settings, number))
        return
    started = time.monotonic()
    with counted_progress(console, "chunks", settings.chunks, folder) as on_progress:
        result = engine.run_joint_monte_carlo(folder, settings, connect=connect, on_progress=on_progress)
    if json_output:
        print(json.dumps(result, indent=2))
        return
    low, high = result["probability_interval"]
    console.print(
        f"{result['runs']} runs: {' and '.join(result['joints'])} stay within {settings.bound:g} rad or m of upright "
        f"with probability {result['probability_inside']:.5f} (95 % interval {low:.5f} to {high:.5f})"
    )
    told = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in settings.shares.items()) or "nothing"
    console.print(f"uncertain: {told}")
    _print_quantiles(console, result["quantiles"], result["units"])
    table = WholeTable(title="Worst runs", title_justify="left")
    names = [f"max_{joint}" for joint in result["joints"]]
    for heading in ("run", "noise seed", *(f"{name} \\[{result['units'][name]}]" for name in names)):
        table.add_column(heading, justify="right")
    for row in result["worst"][:5]:
        table.add_row(str(row["run"]), f"{row['noise_seed']:.0f}", *(f"{row[name]:.5f}" for name in names))
    console.print(table)
    console.print(f"replay  add --replay {result['worst'][0]['run']}\nruns    {folder}")
    console.print(f"({time.monotonic() - started:.0f} s)")


def _replay(console: Console, settings: Any, number: int, folder: Path) -> None:
    from pendulum_bags.studies.monte_carlo import replay

    header = ["theta_rad", "theta_dot_rad_s", "effort_n_m"]
    _tell_replay(console, folder, number, settings.dt, header, *replay(settings, number))


def _tell_replay(
    console: Console, folder: Path, number: int, dt: float, header: Sequence[str], row: Mapping[str, float], motion: Any
) -> None:
    """Write the motion of a run as CSV, and print what was drawn for it."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"replay_{number}.csv"
    table = np.column_stack([dt * np.arange(len(motion)), motion])
    np.savetxt(path, table, delimiter=",", header=",".join(["time_s", *header]), comments="")
    for name, value in row.items():
        console.print(f"{name:<14} {value:.9g}")
    console.print(f"motion  {path}")


def _print_quantiles(console: Console, quantiles: Mapping[str, Mapping[str, float]], units: Mapping[str, str]) -> None:
    table = WholeTable(title="Quantiles", title_justify="left")
    for heading in ("", *next(iter(quantiles.values()))):
        table.add_column(heading, justify="right")
    for name, values in quantiles.items():
        unit = f" \\[{units[name]}]" if name in units else ""
        table.add_row(f"{name}{unit}", *(f"{value:.5g}" for value in values.values()))
    console.print(table)


def _units() -> dict[str, str]:
    """Return the units of parameters and outcomes."""
    from pendulum_bags.identification.model import UNITS

    return {**UNITS, "max_theta": "rad", "std_theta": "rad", "max_effort": "N m"}


def _with_unit(name: str) -> str:
    """Return the name of a parameter or an outcome with its unit, as a cell of a table."""
    known = _units()
    return f"{name} \\[{known[name]}]" if name in known else name


def _print(console: Console, result: dict[str, Any], folder: Path) -> None:
    settings = result["settings"]
    low, high = result["probability_interval"]
    console.print(
        f"{result['runs']} runs: theta stays within {settings['bound']:g} rad of upright with probability "
        f"{result['probability_inside']:.5f} (95 % interval {low:.5f} to {high:.5f})"
    )
    uncertain = settings["uncertainty"]
    told = ", ".join(f"{name} {100.0 * share:.2g} %" for name, share in uncertain["shares"].items()) or "nothing"
    correlated = ", correlated" if uncertain["correlation"] else ""
    console.print(f"uncertain: {told}{correlated} ({uncertain['source']})")
    _print_quantiles(console, result["quantiles"], _units())
    table = WholeTable(title="Worst runs", title_justify="left")
    names = list(uncertain["shares"])
    for heading in ("run", *map(_with_unit, names), "noise seed", "max theta \\[rad]"):
        table.add_column(heading, justify="right")
    for row in result["worst"][:5]:
        table.add_row(
            str(row["run"]),
            *(f"{row[name]:.4g}" for name in names),
            f"{row['noise_seed']:.0f}",
            f"{row['max_theta']:.5f}",
        )
    console.print(table)
    if "sobol" in result:
        table = WholeTable(title=f"Sobol indices of {result['sobol']['output']}", title_justify="left")
        for heading in ("factor", "first order", "total"):
            table.add_column(heading, justify="right")
        for entry in result["sobol"]["indices"]:
            table.add_row(
                entry["factor"],
                f"{entry['first']:.4f} ± {entry['first_confidence']:.4f}",
                f"{entry['total']:.4f} ± {entry['total_confidence']:.4f}",
            )
        console.print(table)
    console.print(f"replay  add --replay {result['worst'][0]['run']}\nruns    {folder}")
