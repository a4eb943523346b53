"""A figure as data with labels and units, defined once and rendered for files and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ROLES", "Figure", "Kind", "Mark", "Panel", "Style", "Trace", "thinned"]

Kind = Literal["line", "step", "points", "interval", "band"]


@dataclass(frozen=True)
class Style:
    """Style of a role, readable in greyscale too, in the colours of Okabe and Ito; ``width`` in [pt]."""

    colour: str
    dash: str = "solid"
    width: float = 1.4
    marker: str = "circle"


ROLES: dict[str, Style] = {
    "sim": Style("#0072b2", "solid", 1.3),
    "hw": Style("#d55e00", "dash", 1.5, "square"),
    "own": Style("#56b4e9", "dashdot", 1.2, "triangle"),
    "noise": Style("#b4b4b4", "solid", 0.8, "cross"),
    "own alone": Style("#0072b2", "solid", 1.1, "triangle"),
    "hw alone": Style("#d55e00", "solid", 1.1, "square"),
    "difference": Style("#222222", "solid", 1.1),
    "aligned": Style("#009e73", "dash", 1.2, "triangle"),
    "fit": Style("#222222", "dashdot", 1.4, "cross"),
    "reference": Style("#999999", "dash", 1.0, "cross"),
    "equivalent": Style("#009e73", "solid", 2.2, "circle"),
    "not equivalent": Style("#d55e00", "solid", 2.2, "cross"),
    "undecided": Style("#7a7a7a", "solid", 2.2, "square"),
    "trial 1": Style("#0072b2", "solid", 1.1, "circle"),
    "trial 2": Style("#d55e00", "dash", 1.2, "square"),
    "trial 3": Style("#009e73", "dot", 1.4, "triangle"),
    "trial 4": Style("#222222", "dashdot", 1.1, "cross"),
    "trial 5": Style("#cc79a7", "solid", 1.8, "circle"),
    "trial 6": Style("#56b4e9", "dash", 1.8, "square"),
    "model": Style("#222222", "dot", 1.6, "triangle"),
    "certified": Style("#009e73", "solid", 1.0, "circle"),
    "not certified": Style("#e69f00", "solid", 1.0, "triangle"),
    "not stabilising": Style("#9a9a9a", "solid", 1.0, "cross"),
    "stable": Style("#222222", "solid", 1.0, "circle"),
    "unstable": Style("#222222", "solid", 1.0, "cross"),
}


@dataclass(frozen=True)
class Trace:
    """One curve.

    Args:
        x: Shape (n,).
        y: Shape (n,); for ``interval`` the row of each interval.
        label: Legend entry; empty for none.
        role: Key of ``ROLES``.
        kind: ``line``, ``step`` (held until the next x), ``points``, ``interval`` (horizontal, from ``low`` to ``high``
            through x), or ``band`` (filled between ``low`` and ``high`` above each x).
        low, high: Ends of intervals or edges of a band, shape (n,).
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    label: str
    role: str
    kind: Kind = "line"
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Mark:
    """A labelled line across a panel at ``value``: vertical for the axis ``x``, horizontal for ``y``."""

    value: float
    axis: Literal["x", "y"] = "y"
    label: str = ""


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Args:
        title: Above the axes; empty for none.
        x_range, y_range: Limits; None to fit the data.
        y_ticks: Names at 0, 1, 2, ...; empty for numbers.
        x_step: Distance of the ticks on the x axis; None for the renderer's choice.
    """

    x_label: str
    y_label: str
    traces: Sequence[Trace]
    marks: Sequence[Mark] = ()
    title: str = ""
    x_log: bool = False
    y_log: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    y_ticks: Sequence[str] = ()
    square: bool = False
    x_step: float | None = None


@dataclass(frozen=True)
class Figure:
    """A figure: file stem (also its anchor), a sentence computed from the data, and panels, stacked or side by side."""

    name: str
    title: str
    sentence: str
    panels: Sequence[Panel]
    stacked: bool = True
    section: str = ""
    panel_height: int = 190


def thinned(x: ArrayLike, y: ArrayLike, most: int = 1200) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return about ``most`` points that plot the same, x ascending, shape (n,): first, least, greatest per bin."""
    xs, ys = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if xs.size <= most:
        return xs, ys
    bins = max(1, most // 2)
    size = xs.size // bins
    whole = ys[: bins * size].reshape(bins, size)
    rows = np.arange(bins)[:, None] * size
    keep = np.sort(np.concatenate((rows + whole.argmin(axis=1)[:, None], rows + whole.argmax(axis=1)[:, None]), axis=1))
    index = np.unique(np.concatenate(([0], keep.ravel(), np.arange(bins * size, xs.size), [xs.size - 1])))
    return xs[index], ys[index]
