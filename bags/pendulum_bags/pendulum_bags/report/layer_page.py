"""A page of its own for some layers of the verdict: their answers, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from importlib import resources
from pathlib import Path
from typing import Any

from pendulum_bags.figures.embed import packed_plotly, script_json
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.render_plotly import graphs_of
from pendulum_bags.figures.table import Table
from pendulum_bags.report.terms import Terms
from pendulum_bags.verdict import LayerResult, Mark
from pendulum_bags.verdict.evidence import evidence_table
from pendulum_msgs_py.errors import BagError

__all__ = ["write_layer_page"]

_OUTCOMES = {
    Mark.YES.value: "yes",
    Mark.NO.value: "no",
    Mark.UNDECIDED.value: "undecided",
    Mark.NOT_MEASURED.value: "undecided",
}


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
    import jinja2

    templates = resources.files("pendulum_bags.report").joinpath("templates")

    def read(name: str) -> str:
        return templates.joinpath(name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(read), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    terms = Terms()
    environment.filters["marked"] = terms.mark
    graphs: dict[str, Any] = {}
    entries = []
    for figure in figures:
        parts = graphs_of(figure)
        names = [f"{figure.name}-{i}" for i in range(len(parts))]
        graphs.update(zip(names, parts, strict=True))
        entries.append({"figure": figure, "graphs": names})
    text = environment.get_template("layer.html.j2").render(
        title=title,
        layers=layers,
        outcomes=_OUTCOMES,
        tables=[*(evidence_table(layer) for layer in layers), *tables],
        entries=entries,
        notes=notes,
        terms=terms,
        made_at=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        graphs=script_json(graphs),
        plotly=packed_plotly(),
        style=read("report.css"),
        script=read("report.js"),
    )
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BagError(f"page {path} cannot be written: {error.strerror or error}") from error
    return path
