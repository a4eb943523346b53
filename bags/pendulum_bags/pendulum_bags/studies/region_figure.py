"""The map of starts as a picture that a greyscale print keeps: shares as greys, curves told apart by their dashes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pendulum_bags.studies.region_map import RegionResult
from pendulum_msgs_py.contract.angles import UPRIGHT

__all__ = ["region_sentence", "write_region_figure"]


def write_region_figure(path: Path, result: RegionResult) -> Path:
    """Draw the map and return the path.

    Args:
        path: The picture; its ending says of what kind.
        result: The map.
    """
    from matplotlib import patheffects
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(7.2, 5.8), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    x, v = result.theta - UPRIGHT, result.theta_dot
    shades = ax.pcolormesh(x, v, 100.0 * result.share, cmap="Greys", vmin=0.0, vmax=100.0, shading="nearest")
    # Full black would hide the curves.
    shades.set_clim(0.0, 150.0)
    bar = figure.colorbar(shades, ax=ax, boundaries=np.linspace(0.0, 100.0, 101), ticks=[0, 25, 50, 75, 100])
    plants = result.settings.plants
    bar.set_label("plants that reach upright [%]" if plants > 1 else "reaches upright [%]")
    halo = [patheffects.withStroke(linewidth=3.5, foreground="white")]
    legend = []
    if result.believed.any() and not result.believed.all():
        edge = result.believed.astype(float)
        ax.contour(x, v, edge, levels=[0.5], colors="black", linestyles="dashed", linewidths=1.4)
        legend.append(Line2D([], [], color="black", ls="--", lw=1.4, label="edge for the believed plant"))
    ax.plot(*result.ellipse.T, color="black", lw=1.8, path_effects=halo)
    legend.append(Line2D([], [], color="black", lw=1.8, label=f"proven: $x^T S x \\leq$ {result.level:.3g}"))
    ax.plot([0.0], [0.0], "o", mfc="white", mec="black", ms=6)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(v[0], v[-1])
    ax.set_xlabel("theta - pi at the start [rad]")
    ax.set_ylabel("theta' at the start [rad/s]")
    title = f"Starts from which LQR at {result.limit:g} N m reaches upright"
    ax.set_title(title + (f", {plants} plants" if plants > 1 else ""), loc="left", fontsize=11)
    figure.legend(handles=legend, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path)
    return path


def region_sentence(result: RegionResult) -> str:
    """Return what the map says."""
    plants = result.settings.plants
    runs = plants * result.share.size
    grid = (result.theta[-1] - result.theta[0]) * (result.theta_dot[-1] - result.theta_dot[0])
    parts = [f"{runs} runs, {result.limit:g} N m at most: "]
    mean = 100.0 * float(result.share.mean())
    parts.append(f"{mean:.1f} % of them reach upright from a grid of {grid:.3g} rad^2/s")
    if plants > 1:
        sure = 100.0 * float(np.mean(result.share == 1.0))
        never = 100.0 * float(np.mean(result.share == 0.0))
        parts.append(f"; from {sure:.1f} % of the starts every plant does, from {never:.1f} % none")
    parts.append(". ")
    if np.isfinite(result.share_in_ellipse):
        parts.append(f"Inside the ellipse of the linear analysis {100.0 * result.share_in_ellipse:.2f} % reach it")
        parts.append(
            ", the believed plant from every start."
            if not result.counterexamples
            else f"; the believed plant does not from {result.counterexamples} starts."
        )
    else:
        parts.append("The ellipse of the linear analysis holds no start of this grid.")
    if result.moving > 0.0:
        parts.append(f" {100.0 * result.moving:.2g} % neither arrived nor rest; a longer --duration may decide.")
    return "".join(parts)
