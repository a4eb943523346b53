"""What plant does a controller see under each strategy of the actuator? Identified from the runs themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.studies.study_file import Study
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.reader import read_bag

__all__ = ["analyse", "apparent_plant", "commanded_recording", "print_table"]

_SETTLED = 0.5
"""Start of a run that is left out of its spread [s]."""


def analyse(folder: Path, study: Study) -> list[dict[str, Any]]:
    """Return one row for each run: identified damping and inertia, spread, and the gap to the first simulated plant."""
    motions: dict[str, tuple[Array, Array]] = {}
    rows: list[dict[str, Any]] = []
    for run in study.runs:
        place = folder / "runs" / run.name
        if run.spec is None or not (place / "bag").is_dir():
            continue
        recording = commanded_recording(place / "bag", run.spec)
        row: dict[str, Any] = {"plant": run.labels["plant"], "seed": run.labels["seed"], "side": run.spec.side}
        row["strategy"] = run.spec.strategy if run.spec.side == "hw" else "none: torque as commanded"
        row.update(apparent_plant(recording))
        settled = recording.time >= _SETTLED
        error = recording.position[settled] - UPRIGHT
        assert recording.velocity is not None
        row["std_theta"] = float(error.std(ddof=1))
        row["std_theta_dot"] = float(recording.velocity[settled].std(ddof=1))
        row["mean_theta"] = float(error.mean())
        motions[run.name] = (recording.time, recording.position - UPRIGHT)
        row["run"] = run.name
        rows.append(row)
    _add_gaps(rows, motions)
    if rows:
        write_figures([_figure(rows, motions)], folder / "figures")
    return rows


def commanded_recording(bag_folder: Path, spec: RunSpec) -> Recording:
    """Return the motion of a run with the commanded (not applied) torque of controller and disturbance as its input."""
    with read_bag(bag_folder) as bag:
        states = bag[f"{spec.namespace}/joint_states"]
        command = bag[f"{spec.namespace}/effort_command"]
        disturbance = bag[f"{spec.namespace}/disturbance"]
    limit = load_plant(spec.design_plant).effort_limit
    stamps, at, where = np.intersect1d(states["stamp_ns"], command["stamp_ns"], return_indices=True)
    pushes = disturbance["effort"][np.searchsorted(disturbance["stamp_ns"], stamps, side="right") - 1]
    wanted = np.clip(command["effort"][where] + pushes, -limit, limit)
    return Recording(
        (stamps - stamps[0]) / NANOSECONDS,
        states["position"][at],
        states["velocity"][at],
        wanted,
        hold="zero",
        meta={"source": str(bag_folder)},
    )


def apparent_plant(recording: Recording) -> dict[str, Any]:
    """Return damping, inertia and delay of the rigid plant that explains a motion best, with 95 % intervals."""
    from pendulum_bags.identification.identify import identify
    from pendulum_bags.identification.output_error import Options

    options = Options(friction="viscous", angle_offset=False, torque_offset=True, multi_start=False)
    result = identify([recording], options)
    found: dict[str, Any] = {}
    for name in ("damping", "inertia", "gravity", "transport_delay"):
        interval = result.uncertainty.intervals.get(name)
        found[name] = float(result.model[name])
        found[f"{name}_interval"] = None if interval is None else [float(interval.low), float(interval.high)]
    return found


def print_table(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the table."""
    headings = ("", "damping\nN m s/rad", "inertia\nkg m^2", "std theta\nrad", "std ratio\nto sim", "paired rms\nrad")
    table = number_table("The plant that the controller sees, by strategy", *headings)
    for row in rows:
        low, high = row["damping_interval"] or (math.nan, math.nan)
        inertia_low, inertia_high = row["inertia_interval"] or (math.nan, math.nan)
        table.add_row(
            row["plant"],
            f"{row['damping']:.2f}\n{low:.2f} to {high:.2f}",
            f"{row['inertia']:.3f}\n{inertia_low:.3f} to {inertia_high:.3f}",
            f"{row['std_theta']:.5f}",
            "–" if row.get("std_ratio") is None else f"{row['std_ratio']:.2f}",
            "–" if row.get("paired_rms") is None else f"{row['paired_rms']:.5f}",
        )
    console.print(table)
    console.print(sentence(rows), markup=False)


def sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table's result as a sentence."""
    hardware = [row for row in rows if row["side"] == "hw"]
    if not hardware:
        return "There is no run on the hardware."
    most, least = (choose(hardware, key=itemgetter("damping")) for choose in (max, min))
    text = (
        f"The controller sees a damping of {most['damping']:.3g} N m s/rad under {most['plant']} and of "
        f"{least['damping']:.3g} N m s/rad under {least['plant']}: the same machine, the same gains."
    )
    gaps = [row for row in hardware if row.get("paired_rms") is not None]
    if gaps:
        best, worst = (choose(gaps, key=itemgetter("paired_rms")) for choose in (min, max))
        text += (
            f" Under the same noise, {best['plant']} is nearest to the simulation ({best['paired_rms']:.2g} rad rms), "
            f"{worst['plant']} farthest ({worst['paired_rms']:.2g} rad rms)."
        )
    return text


def _add_gaps(rows: Sequence[dict[str, Any]], motions: Mapping[str, tuple[Array, Array]]) -> None:
    """Add to each hardware run its distance from the simulation under the same seed."""
    for row in rows:
        twin = next((other for other in rows if other["side"] == "sim" and other["seed"] == row["seed"]), None)
        if row["side"] == "sim" or twin is None:
            row["std_ratio"] = row["paired_rms"] = None
            continue
        time, angle = motions[row["run"]]
        inside = time >= _SETTLED
        simulated = np.interp(time[inside], *motions[twin["run"]])
        row["std_ratio"] = row["std_theta"] / twin["std_theta"]
        row["paired_rms"] = float(np.sqrt(np.mean((angle[inside] - simulated) ** 2)))


def _figure(rows: Sequence[Mapping[str, Any]], motions: Mapping[str, tuple[Array, Array]]) -> Figure:
    twin = next((row for row in rows if row["side"] == "sim"), None)
    panels: list[Panel] = []
    for row in rows:
        if row["side"] == "sim":
            continue
        traces = []
        for source, label, role in ((twin, "simulation", "sim"), (row, "hardware", "hw")):
            if source is not None:
                time, angle = motions[source["run"]]
                shown = time <= _SHOWN
                legend = "" if panels else label
                traces.append(Trace(time[shown], 1e3 * angle[shown], legend, role))
        low, high = row["damping_interval"] or (math.nan, math.nan)
        title = f"{row['plant']}: damping {row['damping']:.2f} ({low:.2f} to {high:.2f}) N m s/rad"
        panels.append(Panel("time [s]", "theta - pi [mrad]", traces, title=title))
    title = "One controller, one noise, one machine: the strategy changes the plant"
    return Figure("strategies", title, sentence(rows), panels, section="strategies", panel_height=210)


_SHOWN = 3.0
"""Stretch of the motions that is drawn [s]."""
