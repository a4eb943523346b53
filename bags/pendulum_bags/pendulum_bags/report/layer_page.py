"""A page of its own for some layers of the verdict: their answers, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.table import Table
from pendulum_bags.report.html import minute, render
from pendulum_bags.verdict import LayerResult
from pendulum_bags.verdict.evidence import evidence_table
from pendulum_msgs_py.errors import BagError

__all__ = ["write_layer_page"]


def write_layer_page(
    path: Path,
    title: str,
    layers: Sequence[LayerResult],
    figures: Sequence[Figure],
    tables: Sequence[Table] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write the page and return its path.

    Args:
        path: File.
        title: Heading.
        layers: Answers, at the top.
        figures: Drawn in order.
        tables: Before the figures, behind the evidence of each layer.
        notes: Sentences at the end.

    Raises:
        BagError: The file cannot be written.
    """
    text = render(
        "layer.html.j2",
        figures,
        title=title,
        layers=layers,
        tables=[*(evidence_table(layer) for layer in layers), *tables],
        notes=notes,
        made_at=minute(),
    )
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BagError(f"page {path} cannot be written: {error.strerror or error}") from error
    return path
