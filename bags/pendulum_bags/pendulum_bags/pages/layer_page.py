"""A page for some layers of the verdict: results, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.pages.html import render
from pendulum_bags.verdict import LayerResult, name_in
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import BagError

__all__ = ["evidence_table", "write_layer_page"]


def write_layer_page(
    path: Path,
    title: str,
    layers: Sequence[LayerResult],
    figures: Sequence[Figure],
    tables: Sequence[Table] = (),
    notes: Sequence[str] = (),
    *,
    emulated: bool = False,
) -> Path:
    """Write a page of layers, their evidence, tables, figures and notes; return its path.

    If the hardware was emulated, all texts say so. A BagError if the file cannot be written.
    """
    shown = [*(evidence_table(layer) for layer in layers), *tables]
    figures, layers, shown, notes = name_in((figures, layers, shown, notes), emulated=emulated)
    text = render("layer.html.j2", figures, title=title, layers=layers, tables=shown, notes=notes, emulated=emulated)
    with writing(f"page {path}", BagError):
        write_atomically(path, text)
    return path


def evidence_table(result: LayerResult) -> Table:
    """Return the evidence of a layer."""
    rows = []
    for row in result.evidence:
        ends = ("–" if end is None else quantity(end) for end in (row.low, row.high))
        interval = "–" if row.low is None and row.high is None else " to ".join(ends)
        name = row.quantity + (f" [{row.unit}]" if row.unit else "")
        estimate = "–" if row.estimate is None else quantity(row.estimate)
        rows.append((name, estimate, interval, row.expected or "–", row.mark.value if row.expected else "–", row.note))
    head = ("quantity", "estimate", "interval", "expected", "result", "note")
    return Table(f"Evidence: {result.layer.title}", result.sentence, head, rows, "Verdict")
