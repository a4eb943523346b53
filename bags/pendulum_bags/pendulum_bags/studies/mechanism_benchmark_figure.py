"""The swing-ups of a benchmark as a picture that is readable in a greyscale print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pendulum_bags.studies.mechanism_benchmark import is_above_line, line_height
from pendulum_bags.studies.mechanism_benchmark_runs import DURATION
from pendulum_bags.studies.mechanism_benchmark_table import Row
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["write_swing_up_figure"]

_POSES = 12
_APART = 1.4
"""Distance of two poses, in lengths of the arms."""


def write_swing_up_figure(path: Path, plant: PlantParameters, rows: Sequence[Row]) -> Path:
    """Draw the best swing-up as a row of poses, and height and torque of all over time; return the path."""
    from matplotlib.figure import Figure

    best = max(rows, key=lambda row: row.score)
    figure = Figure(figsize=(8.0, 6.0), dpi=150, layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, height_ratios=(0.75, 1.0, 1.0))
    chain = in_arithmetic(plant.mechanism.chain, np)
    times, states, _ = best.run.rows
    above = np.flatnonzero(is_above_line(plant, states))
    end = min(times[-1], best.criteria["swingup_time"] + 0.6) if above.size else 3.0
    reach = plant.value("length_1") + plant.value("length_2")
    line = line_height(plant)
    for index, t in enumerate(np.linspace(0.0, end, _POSES)):
        k = int(np.searchsorted(times, t))
        points = chain(tuple(states[k, :2]), plant.packed)
        x = np.array([float(point[0]) for point in points]) + _APART * reach * index
        z = [float(point[2]) for point in points]
        top.plot(x, z, "o-", color="black", lw=2.0, ms=3.0, markerfacecolor="white")
        top.annotate(f"{t:.2f} s", (_APART * reach * index, -1.15 * reach), ha="center", va="top", fontsize=7)
    top.axhline(line, color="0.4", ls="--", lw=0.9)
    top.set_ylim(-1.5 * reach, 1.15 * reach)
    top.set_aspect("equal")
    top.set_axis_off()
    top.set_title(f"{plant.name}: {best.controller}, score v2 {best.score:.3f}", loc="left", fontsize=11)
    for index, row in enumerate(rows):
        style = {"color": str(0.55 * index / max(1, len(rows) - 1)), "ls": ("-", "--", "-.", ":")[index % 4]}
        t, x, u = row.run.rows
        height = chain((x[:, 0], x[:, 1]), plant.packed)[-1][2]
        middle.plot(t, height, lw=1.4, label=f"{row.controller} ({row.score:.3f})", **style)
        bottom.plot(t, u[:, plant.coordinates.driven[0]], lw=1.2, **style)
    middle.axhline(line, color="0.4", ls="--", lw=0.9)
    middle.annotate("line of success", (DURATION, line - 0.04 * reach), ha="right", va="top", fontsize=8, color="0.3")
    middle.set_ylabel("height of the tip [m]")
    bottom.set_ylabel(f"torque at the {plant.coordinates.driven_names[0]} [N m]")
    bottom.set_xlabel("time [s]")
    for ax in (middle, bottom):
        ax.set_xlim(0.0, DURATION)
        ax.grid(color="0.9")
    figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path)
    return path
