"""The map of starts as a picture for greyscale prints too: shares as greys, curves with different dashes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pendulum_bags.studies.region_map import RegionResult

__all__ = ["region_sentence", "write_region_figure"]


def write_region_figure(path: Path, result: RegionResult) -> Path:
    """Draw the map and return the path."""
    from matplotlib import patheffects
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(7.2, 5.8), dpi=150, layout="constrained")
    ax = figure.subplots()
    settings = result.settings
    x, y = settings.starts()
    labels = [f"{axis.name} from upright at the start [{axis.unit}]" for axis in settings.both]
    title, source = f"Starts from which the LQR of {settings.plant} reaches upright", "sampled, without dry friction"
    if settings.is_of_one:
        labels = ["theta - pi at the start [rad]", "theta' at the start [rad/s]"]
        limit = settings.nominal.effort_limit
        title, source = f"Starts from which LQR at {limit:g} N m reaches upright", "proven"
    shades = ax.pcolormesh(x, y, 100.0 * result.share, cmap="Greys", vmin=0.0, vmax=100.0, shading="nearest")
    # Full black would hide the curves.
    shades.set_clim(0.0, 150.0)
    bar = figure.colorbar(shades, ax=ax, boundaries=np.linspace(0.0, 100.0, 101), ticks=[0, 25, 50, 75, 100])
    plants = settings.plants
    bar.set_label("plants that reach upright [%]" if plants > 1 else "reaches upright [%]")
    halo = [patheffects.withStroke(linewidth=3.5, foreground="white")]
    legend = []
    if result.believed.any() and not result.believed.all():
        edge = result.believed.astype(float)
        ax.contour(x, y, edge, levels=[0.5], colors="black", linestyles="dashed", linewidths=1.4)
        legend.append(Line2D([], [], color="black", ls="--", lw=1.4, label="edge for the believed plant"))
    if result.level is not None:
        ax.plot(*result.section.T, color="black", lw=1.8, path_effects=halo)
        label = f"{source}: $x^T S x \\leq$ {result.level:.3g}"
        legend.append(Line2D([], [], color="black", lw=1.8, label=label))
    ax.plot([0.0], [0.0], "o", mfc="white", mec="black", ms=6)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    ax.set_title(title + (f", {plants} plants" if plants > 1 else ""), loc="left", fontsize=11)
    figure.legend(handles=legend, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path)
    return path


def region_sentence(result: RegionResult) -> str:
    """Return the map's result as a sentence."""
    plants = result.settings.plants
    runs, reached = plants * result.share.size, 100.0 * float(result.share.mean())
    sure, never = (100.0 * float(np.mean(result.share == share)) for share in (1.0, 0.0))
    parts = f"; from {sure:.1f} % of the starts every plant does, from {never:.1f} % none" if plants > 1 else ""
    if not result.settings.is_of_one:
        first, second = (f"{axis.name} within {axis.span:g} {axis.unit}" for axis in result.settings.both)
        text = f"{runs} runs, {first} and {second} of upright at rest: {reached:.1f} % come to rest upright{parts}"
        if result.level is None:
            return f"{text}. No state was found that the LQR surely catches."
        if not np.isfinite(result.share_inside):
            return f"{text}. The states that the LQR catches, by sampling, hold no start of this grid."
        inside = 100.0 * result.share_inside
        return f"{text}. Of the starts that the LQR catches, by sampling without dry friction, {inside:.2f} % do."
    grid = float(np.prod([axis[-1] - axis[0] for axis in result.axes]))
    limit = result.settings.nominal.effort_limit
    text = (
        f"{runs} runs, {limit:g} N m at most: {reached:.1f} % of them reach upright from a grid of {grid:.3g} "
        f"rad^2/s{parts}. "
    )
    if np.isfinite(result.share_inside):
        text += f"Inside the ellipse of the linear analysis {100.0 * result.share_inside:.2f} % reach it"
        text += (
            ", the believed plant from every start."
            if not result.counterexamples
            else f"; the believed plant does not from {result.counterexamples} starts."
        )
    else:
        text += "The ellipse of the linear analysis holds no start of this grid."
    if result.moving > 0.0:
        text += f" {100.0 * result.moving:.2g} % neither arrived nor rest; a longer --duration may decide."
    return text
