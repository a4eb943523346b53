"""Figures as PNG and PDF, drawn by matplotlib."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pendulum_bags.figures.figure import ROLES, Figure, Panel, Trace, thinned
from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import BagError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["write_figures"]

_DASHES: dict[str, Any] = {"solid": "-", "dash": (0, (5, 2)), "dot": (0, (1, 1.4)), "dashdot": (0, (6, 2, 1, 2))}
_MARKERS = {"circle": "o", "square": "s", "triangle": "^", "cross": "x"}
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    # Text stays searchable. Type 42 fonts would double the time of drawing.
    "pdf.fonttype": 3,
    "path.simplify": True,
    "path.simplify_threshold": 0.5,
}
_WIDTH = 6.6
_RESOLUTION = 150
_MANY = 12
"""Number of figures from which a second process, which takes a second to start, draws half of them."""


def write_figures(figures: Sequence[Figure], folder: Path, formats: Sequence[str] = ("png", "pdf")) -> list[Path]:
    """Draw figures into a folder, by matplotlib's suffixes; return the files, a BagError if it fails."""
    with writing(f"figures in {folder}", BagError):
        folder.mkdir(parents=True, exist_ok=True)
        if not formats:
            return []
        if len(figures) < _MANY:
            return _write(figures, folder, formats)
        ordered = sorted(figures, key=lambda figure: -len(figure.panels))
        ours, theirs = ordered[::2], ordered[1::2]
        other = get_context("spawn").Process(target=_write_aside, args=(theirs, folder, formats), daemon=True)
        other.start()
        try:
            written = _write(ours, folder, formats)
            other.join()
        finally:
            other.terminate()
        if other.exitcode != 0:  # it was ended, or has what this one reports
            return written + _write(theirs, folder, formats)
        return written + [folder / f"{figure.name}.{suffix}" for figure in theirs for suffix in formats]


def _write_aside(figures: Sequence[Figure], folder: Path, formats: Sequence[str]) -> None:
    """Write figures in a process of their own, which ignores SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _write(figures, folder, formats)
    except OSError:
        sys.exit(1)


def _write(figures: Sequence[Figure], folder: Path, formats: Sequence[str]) -> list[Path]:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    written = []
    with mpl.rc_context(_STYLE):
        for figure in figures:
            canvas = _draw(figure, Canvas)
            FigureCanvasAgg(canvas)
            for suffix in formats:
                path = folder / f"{figure.name}.{suffix}"
                canvas.savefig(path, dpi=_RESOLUTION, metadata=_metadata(figure, suffix))
                written.append(path)
    return written


def _metadata(figure: Figure, suffix: str) -> dict[str, Any] | None:
    """Name the figure inside the file; without the date equal data give equal files."""
    if suffix == "pdf":
        return {"Title": figure.title, "Subject": figure.sentence, "CreationDate": None}
    return {"Title": figure.title, "Description": figure.sentence} if suffix == "png" else None


def _draw(figure: Figure, canvas_type: Any) -> Any:
    count = len(figure.panels)
    inches = figure.panel_height / 100.0
    if figure.stacked:
        rows, columns, height = count, 1, 0.9 + inches * count
    else:
        columns = min(2, count)
        rows = -(-count // columns)
        height = 0.5 + (inches + 0.75) * rows
    canvas = canvas_type(figsize=(_WIDTH, height))
    axes = canvas.subplots(rows, columns, sharex=figure.stacked, squeeze=False).ravel()
    for ax, panel in zip(axes, figure.panels, strict=False):
        _draw_panel(ax, panel)
    for ax in axes[count:]:
        ax.set_visible(False)
    widest = max((len(name) for panel in figure.panels for name in panel.y_ticks), default=0)
    left = min(0.55, 0.13 + 0.0105 * widest)
    if figure.stacked:
        for ax in axes[: count - 1]:
            ax.set_xlabel("")
        canvas.align_ylabels(list(axes))
    handles: dict[str, Any] = {}
    for ax in axes[:count]:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    top = 0.42 if handles else 0.12
    if handles:
        across = 4 if max(map(len, handles)) < 24 else 2
        lines = -(-len(handles) // across)
        top += 0.17 * (lines - 1)
        canvas.legend(
            handles.values(),
            handles.keys(),
            loc="upper center",
            ncols=across,
            bbox_to_anchor=(0.5, 1.0),
            handlelength=3.0,
        )
    titled = any(panel.title for panel in figure.panels)
    canvas.subplots_adjust(
        left=left,
        right=0.98,
        bottom=0.5 / height,
        top=1.0 - (top + (0.2 if titled else 0.0)) / height,
        hspace=(0.3 if titled else 0.16) if figure.stacked else 0.55,
        wspace=0.42,
    )
    for ax, panel in zip(axes, figure.panels, strict=False):
        if panel.title and not _has_offset(ax):
            # The default position, set explicitly because computing it takes a seventh of the drawing.
            ax.set_title(panel.title, loc="left", y=1.0)
    return canvas


def _has_offset(ax: Axes) -> bool:
    formatter = ax.yaxis.get_major_formatter()
    formatter.format_ticks(ax.yaxis.get_majorticklocs().tolist())
    return bool(formatter.get_offset())


def _draw_panel(ax: Axes, panel: Panel) -> None:
    for trace in panel.traces:
        _draw_trace(ax, trace)
    for mark in panel.marks:
        line = ax.axhline if mark.axis == "y" else ax.axvline
        line(mark.value, color="#555555", linewidth=0.9, linestyle=(0, (3, 2)))
        if mark.label:
            small: Any = {"fontsize": 7.5, "color": "#333333"}
            if mark.axis == "y":
                place: Any = ("axes fraction", "data")
                ax.annotate(mark.label, (1.0, mark.value), xycoords=place, ha="right", va="bottom", **small)
            else:
                place = ("data", "axes fraction")
                ax.annotate(f" {mark.label}", (mark.value, 1.0), xycoords=place, ha="left", va="top", **small)
    ax.set_xlabel(panel.x_label)
    ax.set_ylabel(panel.y_label)
    if panel.title:
        ax.set_title(panel.title, loc="left")
    if panel.x_log:
        ax.set_xscale("log")
    if panel.y_log:
        ax.set_yscale("log")
    if panel.x_range:
        ax.set_xlim(*panel.x_range)
    if panel.y_range:
        ax.set_ylim(*panel.y_range)
    if panel.y_ticks:
        ax.set_yticks(range(len(panel.y_ticks)), panel.y_ticks)
    if panel.x_step:
        from matplotlib.ticker import MultipleLocator

        ax.xaxis.set_major_locator(MultipleLocator(panel.x_step))
    if panel.square:
        ax.set_aspect("equal", adjustable="datalim")


def _draw_trace(ax: Axes, trace: Trace) -> None:
    style = ROLES[trace.role]
    label = trace.label or "_nolegend_"
    line: Any = {"color": style.colour, "linewidth": style.width, "linestyle": _DASHES[style.dash], "label": label}
    marker: Any = _MARKERS[style.marker]
    if trace.kind == "points":
        ax.plot(trace.x, trace.y, linestyle="none", marker=marker, markersize=3.2, color=style.colour, label=label)
        return
    if trace.kind == "interval" and trace.low is not None and trace.high is not None:
        spread = [trace.x - trace.low, trace.high - trace.x]
        ax.errorbar(
            trace.x,
            trace.y,
            xerr=spread,
            fmt=marker,
            color=style.colour,
            elinewidth=style.width,
            capsize=3,
            label=label,
        )
        return
    if trace.kind == "band" and trace.low is not None and trace.high is not None:
        ax.fill_between(trace.x, trace.low, trace.high, color=style.colour, alpha=0.25, linewidth=0.0, label=label)
        return
    if trace.kind == "step":
        ax.step(trace.x, trace.y, where="post", **line)
        return
    x, y = thinned(trace.x, trace.y) if bool((trace.x[1:] >= trace.x[:-1]).all()) else (trace.x, trace.y)
    ax.plot(x, y, **line)
