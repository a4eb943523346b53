"""Figures as plotly.js graphs: plain dictionaries, arrays packed as base64 so that a page stays small."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.figures.figure import ROLES, Figure, Panel, Trace, thinned
from pendulum_bags.figures.numbers import quantity

__all__ = ["graphs_of"]

_GRID = "#e3e3e3"
_MARKERS = {"circle": "circle", "square": "square", "triangle": "triangle-up", "cross": "x-thin-open"}
_FONT = {"family": "system-ui, -apple-system, Segoe UI, Roboto, sans-serif", "size": 13, "color": "#222"}


def graphs_of(figure: Figure) -> list[dict[str, Any]]:
    """Return the plotly graphs (``data``, ``layout``) of a figure: one for stacked panels, else one per panel."""
    if figure.stacked:
        return [_graph(figure, list(figure.panels))]
    return [_graph(figure, [panel]) for panel in figure.panels]


def _graph(figure: Figure, panels: list[Panel]) -> dict[str, Any]:
    count = len(panels)
    gap = 0.0 if count == 1 else 0.05 + (0.03 if any(panel.title for panel in panels) else 0.0)
    share = (1.0 - gap * (count - 1)) / count
    data: list[dict[str, Any]] = []
    named: set[str] = set()
    titled = bool(panels[0].title)
    layout: dict[str, Any] = {
        "font": _FONT,
        "margin": {"l": 64, "r": 14, "t": 54 if titled else 34, "b": 48},
        "height": 84 + figure.panel_height * count + (40 if not figure.stacked else 0) + (20 if titled else 0),
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#fff",
        "hovermode": "x" if figure.stacked else "closest",
        "legend": {"orientation": "h", "x": 0, "y": 1, "yref": "container", "yanchor": "top", "font": {"size": 12}},
        "dragmode": "zoom",
        "shapes": [],
        "annotations": [],
    }
    for i, panel in enumerate(panels):
        suffix = "" if i == 0 else str(i + 1)
        top = 1.0 - i * (share + gap)
        last = i == count - 1
        axis = {"gridcolor": _GRID, "zeroline": False, "linecolor": "#888", "ticks": "outside", "tickcolor": "#888"}
        x_axis: dict[str, Any] = {**axis, "anchor": f"y{suffix}", "type": "log" if panel.x_log else "linear"}
        y_axis: dict[str, Any] = {
            **axis,
            "anchor": f"x{suffix}",
            "domain": [max(0.0, top - share), top],
            "title": {"text": panel.y_label.replace("\n", "<br>"), "font": {"size": 12}, "standoff": 6},
            "type": "log" if panel.y_log else "linear",
            "automargin": True,
        }
        if last:
            x_axis["title"] = {"text": panel.x_label, "font": {"size": 12}, "standoff": 8}
        else:
            x_axis["showticklabels"] = False
        if i:
            x_axis["matches"] = "x"
        for letter, target, limits, log in (
            ("x", x_axis, panel.x_range, panel.x_log),
            ("y", y_axis, panel.y_range, panel.y_log),
        ):
            if limits:
                target["range"] = [float(np.log10(v)) if log else float(v) for v in limits]
            if log:
                target.update(_log_ticks([getattr(trace, letter) for trace in panel.traces]))
        if panel.y_ticks:
            y_axis.update(tickmode="array", tickvals=list(range(len(panel.y_ticks))), ticktext=list(panel.y_ticks))
        if panel.x_step:
            x_axis["dtick"] = panel.x_step
        if panel.square:
            y_axis["scaleanchor"] = f"x{suffix}"
        layout[f"xaxis{suffix}"], layout[f"yaxis{suffix}"] = x_axis, y_axis
        if panel.title:
            layout["annotations"].append(_note(panel.title, 0.0, top, "paper", "paper", "left", "bottom", size=13))
        for trace in panel.traces:
            data.append(_trace(trace, suffix, trace.label not in named))
            named.add(trace.label)
        _add_marks(layout, panel, suffix)
    layout["showlegend"] = any(trace.get("showlegend") for trace in data)
    return {"data": data, "layout": layout}


def _log_ticks(values: list[NDArray[np.float64]]) -> dict[str, Any]:
    joined = np.concatenate(values)
    joined = joined[joined > 0.0]
    if not joined.size:
        return {}
    low, high = math.floor(math.log10(joined.min())), math.ceil(math.log10(joined.max()))
    shares = (1.0, 2.0, 5.0) if high - low <= 3 else (1.0,)
    ticks = [share * 10.0**power for power in range(low, high + 1) for share in shares]
    return {"tickmode": "array", "tickvals": ticks, "ticktext": [quantity(tick, "", 1) for tick in ticks]}


def _add_marks(layout: dict[str, Any], panel: Panel, suffix: str) -> None:
    for mark in panel.marks:
        line = {"color": "#555", "width": 1, "dash": "dash"}
        if mark.axis == "y":
            shape = {"x0": 0, "x1": 1, "xref": f"x{suffix} domain", "y0": mark.value, "y1": mark.value}
            shape["yref"] = f"y{suffix}"
            note = _note(mark.label, 1.0, mark.value, f"x{suffix} domain", f"y{suffix}", "right", "bottom")
        else:
            shape = {"y0": 0, "y1": 1, "yref": f"y{suffix} domain", "x0": mark.value, "x1": mark.value}
            shape["xref"] = f"x{suffix}"
            # Towards the middle: a phone has no space at the right edge.
            side = "right" if panel.x_range and mark.value > sum(panel.x_range) / 2.0 else "left"
            note = _note(mark.label, mark.value, 1.0, f"x{suffix}", f"y{suffix} domain", side, "top")
        layout["shapes"].append({"type": "line", "line": line, **shape})
        if mark.label:
            layout["annotations"].append(note)


def _note(
    text: str, x: float, y: float, x_reference: str, y_reference: str, x_anchor: str, y_anchor: str, size: int = 11
) -> dict[str, Any]:
    return {
        "text": text,
        "x": x,
        "y": y,
        "xref": x_reference,
        "yref": y_reference,
        "xanchor": x_anchor,
        "yanchor": y_anchor,
        "showarrow": False,
        "font": {"size": size},
    }


def _trace(trace: Trace, suffix: str, first: bool) -> dict[str, Any]:
    style = ROLES[trace.role]
    x, y = trace.x, trace.y
    if trace.kind == "line" and bool((x[1:] >= x[:-1]).all()):
        x, y = thinned(x, y)
    graph: dict[str, Any] = {
        "type": "scatter",
        "x": _packed(x),
        "y": _packed(y),
        "name": trace.label,
        "legendgroup": trace.label,
        "showlegend": bool(trace.label) and first,
        "xaxis": f"x{suffix}",
        "yaxis": f"y{suffix}",
    }
    marker = {
        "color": style.colour,
        "symbol": _MARKERS[style.marker],
        "size": 5,
        "line": {"color": style.colour, "width": 1.4},
    }
    if trace.kind == "points":
        return {**graph, "mode": "markers", "marker": marker}
    if trace.kind == "interval" and trace.low is not None and trace.high is not None:
        bars = {
            "type": "data",
            "symmetric": False,
            "array": (trace.high - trace.x).tolist(),
            "arrayminus": (trace.x - trace.low).tolist(),
            "color": style.colour,
            "thickness": style.width,
            "width": 5,
        }
        return {**graph, "mode": "markers", "marker": {**marker, "size": 9}, "error_x": bars}
    if trace.kind == "band" and trace.low is not None and trace.high is not None:
        # A closed outline, forth and back, filled.
        outline = np.concatenate([trace.x, trace.x[::-1]]), np.concatenate([trace.low, trace.high[::-1]])
        red, green, blue = (int(style.colour[i : i + 2], 16) for i in (1, 3, 5))
        return {
            **graph,
            "x": _packed(outline[0]),
            "y": _packed(outline[1]),
            "mode": "lines",
            "line": {"width": 0},
            "fill": "toself",
            "fillcolor": f"rgba({red},{green},{blue},0.25)",
            "hoverinfo": "skip",
        }
    line: dict[str, Any] = {"color": style.colour, "dash": style.dash, "width": style.width + 0.2}
    if trace.kind == "step":
        line["shape"] = "hv"
    return {**graph, "mode": "lines", "line": line}


def _packed(values: NDArray[np.float64]) -> Any:
    """Return an array in plotly.js's form: 32 bit, base64; short ones stay readable lists."""
    if values.size <= 32 or not np.isfinite(values).all():
        return [float(value) if np.isfinite(value) else None for value in values]
    data = np.ascontiguousarray(values, dtype="<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(data.tobytes()).decode("ascii")}
