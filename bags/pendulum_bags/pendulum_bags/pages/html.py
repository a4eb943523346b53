"""Self-contained HTML pages, without network or further files."""

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
from pendulum_bags.pages.terms import Terms

__all__ = ["encoded", "render", "render_plain", "script_json"]


def render(
    template: str, figures: Sequence[Figure], pictures: Mapping[str, bytes] = MappingProxyType({}), **content: Any
) -> str:
    """Return a page of a template, its variables, and figures (with different names) as plots.

    ``pictures`` are the same figures as PNG by name, for paper and for readers without scripts.
    """
    graphs = {
        figure.name: {f"{figure.name}-{i}": graph for i, graph in enumerate(graphs_of(figure))} for figure in figures
    }
    return _render(
        template,
        Terms(),
        **content,
        figures=figures,
        pictures={name: encoded(picture) for name, picture in pictures.items()},
        graph_names={name: list(parts) for name, parts in graphs.items()},
        graphs=script_json({name: graph for parts in graphs.values() for name, graph in parts.items()}),
        plotly=_packed_plotly(),
        script=_read("report.js"),
        diagram=_read("block_diagram.svg"),
    )


def render_plain(template: str, **content: Any) -> str:
    """Return a page of text, tables and pictures; it explains no terms."""
    return _render(template, Terms({}), **content)


def _render(template: str, terms: Terms, **content: Any) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_read), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["marked"] = terms.mark
    return environment.get_template(template).render(
        **content,
        terms=terms,
        made_at=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        style=_read("report.css"),
    )


def encoded(picture: bytes) -> str:
    """Return a picture in base64."""
    return base64.b64encode(picture).decode("ascii")


def script_json(value: Any) -> str:
    """Return JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


@lru_cache(maxsize=1)
def _packed_plotly() -> str:
    """Return plotly.js, gzipped and in base64: a third of its size, and browsers unpack it."""
    source = resources.files("plotly").joinpath("package_data").joinpath("plotly.min.js").read_bytes()
    return base64.b64encode(gzip.compress(source, 9, mtime=0)).decode("ascii")


def _read(name: str) -> str:
    return resources.files("pendulum_bags.pages").joinpath("templates").joinpath(name).read_text(encoding="utf-8")
