"""``experiment region_of_attraction``: from which starts does the loop reach upright, under the torque limit?"""

# ruff: noqa: ARG001 (`settings_of` reads the options from the context)
from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from pendulum_bags.commands.monte_carlo_cli import Device, Plant, Q, R, Scheduler, Uncertain, Workers, settings_of
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.programs.counted_progress import counted_progress
from pendulum_msgs_py.programs.options import Json, out_option
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["region_of_attraction"]


def region_of_attraction(
    context: typer.Context,
    out: Annotated[
        Path | None,
        out_option("Folder; an interrupted map is gone on with. Default: bags/runs/region_of_attraction."),
    ] = None,
    plant: Plant = "thesis",
    uncertainty: Uncertain = "inertia=0.3,damping=0.05,gravity=0.05",
    plants: Annotated[
        int, typer.Option(help="Plants tried at each start; 1 for the believed one; of several joints 10.", min=1)
    ] = 100,
    effort_limit: Annotated[
        float, typer.Option(help="Torque limit of the loop [N m]; 0 for the plant's own.", min=0.0)
    ] = 0.0,
    points: Annotated[int, typer.Option(help="Points along each axis of the grid; of several joints 41.", min=3)] = 61,
    angle_span: Annotated[float, typer.Option(help="Half width of the grid about upright [rad].")] = 3.141592653589793,
    velocity_span: Annotated[float, typer.Option(help="Half width of the grid in velocity [rad/s].")] = 10.0,
    duration: Annotated[float, typer.Option(help="Length of each run [s].")] = 8.0,
    q: Q = (100.0, 0.01),
    r: R = 0.1,
    axes: Annotated[
        str,
        typer.Option(help="Of several joints: both axes, as cart,pole or pole,pole_dot; default the first two joints."),
    ] = "",
    spans: Annotated[
        tuple[float, float], typer.Option(help="Of several joints: half widths of the grid [rad, m, rad/s or m/s].")
    ] = (1.0, 1.0),
    seed: Annotated[int, typer.Option(help="Seed of the plants.", min=0)] = 1,
    scheduler: Scheduler = "",
    workers: Workers = 0,
    device: Device = "cpu",
    json_output: Json = False,
) -> None:
    """Map the starts from which the LQR reaches upright under a torque limit, over everything not known of the plant.

    Example: python -m pendulum_bags experiment region_of_attraction --plant dfki --plants 20 --out /tmp/region
    """
    from pendulum_bags.studies.chunks import cluster_client
    from pendulum_bags.studies.region_figure import region_sentence, write_region_figure
    from pendulum_bags.studies.region_map import RegionMap, run_map

    folder = out or Path("bags", "runs", "region_of_attraction")
    console = make_console(stderr=json_output, highlight=False)
    both = tuple(part.strip() for part in axes.split(",") if part.strip())
    settings = settings_of(context, RegionMap, axes=both)
    started = time.monotonic()
    with counted_progress(console, "chunks", settings.chunks, folder) as on_progress:
        connect = partial(cluster_client, scheduler, workers)
        result = run_map(folder, settings, connect=connect, on_progress=on_progress)
    picture = write_region_figure(folder / "region.png", result)
    if json_output:
        print(json_text(result.to_json()))
        return
    console.print(region_sentence(result))
    elapsed = time.monotonic() - started
    console.print(f"\npicture {picture}\nmap     {folder / 'map.parquet'}\n({elapsed:.0f} s)", soft_wrap=True)
