"""``experiment monte_carlo``: how sure is the regulation, given what is not known about the plant?"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from pendulum_msgs_py.programs.counted_progress import counted_progress
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["monte_carlo"]


def monte_carlo(
    out: Annotated[
        Path | None,
        out_option("Folder; an interrupted one is gone on with, more runs are added. Default: bags/runs/monte_carlo."),
    ] = None,
    plant: Annotated[str, typer.Option(help="Preset or plant file; the controller is designed on it.")] = "thesis",
    uncertainty: Annotated[
        str, typer.Option(help="identified (covariance of the plant file), or shares: inertia=0.3,damping=0.05.")
    ] = "inertia=0.3,damping=0.05,gravity=0.05",
    runs: Annotated[int, typer.Option(help="Number of closed-loop runs.", min=1)] = 1_000_000,
    seed: Annotated[int, typer.Option(help="Seed of everything.", min=0)] = 1,
    bound: Annotated[float, typer.Option(help="Distance from upright that a run should not leave [rad].")] = 0.02,
    start: Annotated[float, typer.Option(help="Largest distance of the start from upright [rad].", min=0.0)] = 0.0,
    amplitude: Annotated[float, typer.Option(help="Largest noise torque [N m].")] = 2.5,
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

    Results do not depend on the number of workers, bit for bit; each chunk is a Parquet file.

    Example: python -m pendulum_bags experiment monte_carlo --runs 100000 --out /tmp/mc
    """
    from pendulum_bags.studies import monte_carlo as engine
    from pendulum_bags.studies.chunks import cluster_client
    from pendulum_bags.studies.uncertain import parse_uncertainty
    from pendulum_msgs_py.plants.plant_parameters import require_one_joint

    require_one_joint(plant, "simulate_mechanisms of pendulum_sim.mechanism_batch, which runs many plants of several")
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
    folder = out or Path("bags", "runs", "monte_carlo")
    console = make_console(stderr=json_output, highlight=False)
    if replay >= 0:
        _replay(console, settings, replay, folder)
        return
    started = time.monotonic()
    connect = partial(cluster_client, scheduler, workers)
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


def _replay(console: Console, settings: Any, number: int, folder: Path) -> None:
    import numpy as np

    from pendulum_bags.studies.monte_carlo import replay

    row, motion = replay(settings, number)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"replay_{number}.csv"
    times = settings.dt * np.arange(len(motion))
    np.savetxt(
        path, np.column_stack([times, motion]), delimiter=",", header="time_s,theta_rad,theta_dot_rad_s,effort_n_m",
        comments="",
    )  # fmt: skip
    for name, value in row.items():
        console.print(f"{name:<14} {value:.9g}")
    console.print(f"motion  {path}")


def _with_unit(name: str) -> str:
    """Return the name of a parameter or an outcome with its unit, as a cell of a table."""
    from pendulum_bags.identification.model import UNITS

    known = {**UNITS, "max_theta": "rad", "std_theta": "rad", "max_effort": "N m"}
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
    table = WholeTable(title="Quantiles", title_justify="left")
    shares = next(iter(result["quantiles"].values()))
    for heading in ("", *shares):
        table.add_column(heading, justify="right")
    for name, values in result["quantiles"].items():
        table.add_row(_with_unit(name), *(f"{value:.5g}" for value in values.values()))
    console.print(table)
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
