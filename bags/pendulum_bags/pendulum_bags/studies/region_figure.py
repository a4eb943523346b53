"""The map of starts as a picture that a greyscale print keeps: shares as greys, curves told apart by their dashes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.studies.joint_region import JointRegionResult
from pendulum_bags.studies.region_map import RegionResult
from pendulum_msgs_py.contract.angles import UPRIGHT

__all__ = ["joint_region_sentence", "region_sentence", "write_joint_region_figure", "write_region_figure"]


@dataclass(frozen=True)
class _Picture:
    """What a map of starts shows.

    Attributes:
        x, y: Deviations from upright along both axes, shape (n,) each.
        labels: Of both axes.
        share: Share of the plants, shape (n, n).
        believed: Whether the plant that is believed in reaches upright, same shape.
        plants: How many plants there were.
        curve: Edge of a region that something else tells, shape (k, 2).
        told: What that is, for the legend.
        title: Above all.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    labels: tuple[str, str]
    share: NDArray[np.float64]
    believed: NDArray[np.bool_]
    plants: int
    curve: NDArray[np.float64]
    told: str
    title: str


def write_region_figure(path: Path, result: RegionResult) -> Path:
    """Draw the map and return the path.

    Args:
        path: The picture; its ending says of what kind.
        result: The map.
    """
    return _draw(
        path,
        _Picture(
            result.theta - UPRIGHT,
            result.theta_dot,
            ("theta - pi at the start [rad]", "theta' at the start [rad/s]"),
            result.share,
            result.believed,
            result.settings.plants,
            result.ellipse,
            f"proven: $x^T S x \\leq$ {result.level:.3g}",
            f"Starts from which LQR at {result.limit:g} N m reaches upright",
        ),
    )


def write_joint_region_figure(path: Path, result: JointRegionResult) -> Path:
    """Draw the map of a plant of several joints and return the path.

    Args:
        path: The picture; its ending says of what kind.
        result: The map.
    """
    x, y = result.settings.starts()
    labels = [f"{axis.name} from upright at the start [{axis.unit}]" for axis in result.settings.both]
    return _draw(
        path,
        _Picture(
            x,
            y,
            (labels[0], labels[1]),
            result.share,
            result.believed,
            result.settings.plants,
            result.section,
            ""
            if result.caught is None
            else f"sampled, without dry friction: $x^T S x \\leq$ {result.caught.level:.3g}",
            f"Starts from which the LQR of {result.settings.plant} reaches upright",
        ),
    )


def _draw(path: Path, picture: _Picture) -> Path:
    from matplotlib import patheffects
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    figure = Figure(figsize=(7.2, 5.8), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    x, y = picture.x, picture.y
    shades = ax.pcolormesh(x, y, 100.0 * picture.share, cmap="Greys", vmin=0.0, vmax=100.0, shading="nearest")
    # Full black would hide the curves.
    shades.set_clim(0.0, 150.0)
    bar = figure.colorbar(shades, ax=ax, boundaries=np.linspace(0.0, 100.0, 101), ticks=[0, 25, 50, 75, 100])
    plants = picture.plants
    bar.set_label("plants that reach upright [%]" if plants > 1 else "reaches upright [%]")
    halo = [patheffects.withStroke(linewidth=3.5, foreground="white")]
    legend = []
    if picture.believed.any() and not picture.believed.all():
        edge = picture.believed.astype(float)
        ax.contour(x, y, edge, levels=[0.5], colors="black", linestyles="dashed", linewidths=1.4)
        legend.append(Line2D([], [], color="black", ls="--", lw=1.4, label="edge for the believed plant"))
    if picture.told:
        ax.plot(*picture.curve.T, color="black", lw=1.8, path_effects=halo)
        legend.append(Line2D([], [], color="black", lw=1.8, label=picture.told))
    ax.plot([0.0], [0.0], "o", mfc="white", mec="black", ms=6)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    ax.set_xlabel(picture.labels[0])
    ax.set_ylabel(picture.labels[1])
    ax.set_title(picture.title + (f", {plants} plants" if plants > 1 else ""), loc="left", fontsize=11)
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


def joint_region_sentence(result: JointRegionResult) -> str:
    """Return what the map of a plant of several joints says."""
    plants = result.settings.plants
    first, second = (f"{axis.name} within {axis.span:g} {axis.unit}" for axis in result.settings.both)
    text = (
        f"{plants * result.share.size} runs, {first} and {second} of upright at rest: "
        f"{100.0 * float(result.share.mean()):.1f} % come to rest upright"
    )
    if plants > 1:
        sure, never = (100.0 * float(np.mean(result.share == share)) for share in (1.0, 0.0))
        text += f"; from {sure:.1f} % of the starts every plant does, from {never:.1f} % none"
    if result.caught is None:
        return f"{text}. No state was found that the LQR surely catches."
    if not np.isfinite(result.share_in_section):
        return f"{text}. The states that the LQR catches, by sampling, hold no start of this grid."
    inside = 100.0 * result.share_in_section
    return f"{text}. Of the starts that the LQR catches, by sampling without dry friction, {inside:.2f} % do."
