"""Pages of HTML that need nothing else, no network and no folder beside them: all that they show is within them."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from functools import lru_cache
from importlib import resources
from types import MappingProxyType
from typing import Any

from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.render_plotly import graphs_of
from pendulum_bags.report.terms import Terms

__all__ = ["render", "script_json"]


def render(
    template: str, figures: Sequence[Figure], pictures: Mapping[str, bytes] = MappingProxyType({}), **content: Any
) -> str:
    """Return a page.

    Args:
        template: Name of its template.
        figures: All that it shows, each of another name.
        pictures: The same as PNG by name, for paper and for readers without scripts.
        content: What else the template asks for.
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
    graphs = {
        figure.name: {f"{figure.name}-{i}": graph for i, graph in enumerate(graphs_of(figure))} for figure in figures
    }
    return environment.get_template(template).render(
        **content,
        figures=figures,
        pictures={name: base64.b64encode(picture).decode("ascii") for name, picture in pictures.items()},
        terms=terms,
        made_at=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        graph_names={name: list(parts) for name, parts in graphs.items()},
        graphs=script_json({name: graph for parts in graphs.values() for name, graph in parts.items()}),
        plotly=_packed_plotly(),
        style=read("report.css"),
        script=read("report.js"),
        diagram=read("block_diagram.svg"),
    )


def script_json(value: Any) -> str:
    """Return JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


@lru_cache(maxsize=1)
def _packed_plotly() -> str:
    """Return plotly.js, gzipped and in base64: a third of its size, and browsers unpack gzip by themselves."""
    source = resources.files("plotly").joinpath("package_data").joinpath("plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, 9, mtime=0)).decode("ascii")
