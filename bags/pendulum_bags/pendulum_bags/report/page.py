"""The report as one HTML file that needs nothing else: no network, no folder beside it."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from pendulum_bags.figures.embed import packed_plotly, script_json
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.render_plotly import graphs_of
from pendulum_bags.figures.table import Table
from pendulum_bags.report.animation import animation_of
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.emulator_table import emulator_table
from pendulum_bags.report.provenance import provenance_table, settings_table
from pendulum_bags.report.terms import Terms
from pendulum_bags.report.wording import name_in
from pendulum_bags.runs.run_data import timing_warning
from pendulum_bags.verdict import Answer
from pendulum_bags.verdict.terminal import SIGNS

__all__ = ["render_page"]

SECTIONS = (
    "Verdict",
    "Frequency response",
    "Paired comparison",
    "Repeated runs",
    "Plants under noise",
    "The thesis's analysis",
    "Dynamic phase",
    "Timing",
    "Experiment 1: inertia and damping",
    "Experiment 2: gravity",
    "Model",
    "A real pendulum",
)
"""Order of the sections; one that only a figure or table names comes after these."""


def render_page(
    data: ReportData,
    figures: Sequence[Figure],
    tables: Sequence[Table],
    missing: Sequence[tuple[str, str]],
    *,
    title: str,
    made_at: str,
    pictures: Mapping[str, bytes] | None = None,
) -> str:
    """Return the HTML text of the report.

    Args:
        data: What it is made from.
        figures: Figures, drawn on the page by a script.
        tables: Tables.
        missing: Figures that the data do not allow, each with the reason.
        title: What the page is about.
        made_at: When it was made.
        pictures: The figures as PNG by name, for paper and for readers without scripts.
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
    sections = []
    graphs: dict[str, Any] = {}
    packed = {name: base64.b64encode(content).decode("ascii") for name, content in (pictures or {}).items()}
    named = [figure.section for figure in figures] + [table.section for table in tables]
    for heading in dict.fromkeys((*SECTIONS, *named)):
        items: list[dict[str, Any]] = []
        for figure in figures:
            if figure.section == heading:
                parts = graphs_of(figure)
                names = [f"{figure.name}-{i}" for i in range(len(parts))]
                graphs.update(zip(names, parts, strict=True))
                items.append({"figure": figure, "graphs": names, "picture": packed.get(figure.name)})
        items += [{"table": table} for table in tables if table.section == heading]
        if items:
            sections.append({"title": heading, "anchor": _anchor(heading), "entries": items})
    emulated = data.comparison.is_emulated
    return environment.get_template("report.html.j2").render(
        title=title,
        emulated=emulated,
        terms=terms,
        made_at=made_at,
        answer=data.answer,
        sentence=_without_mark(data.answer),
        signs=SIGNS,
        left_out=data.comparison.left_out,
        unpaired=data.comparison.unpaired_verdict.sentence,
        hardware=data.comparison.hardware_name,
        noise_note=name_in(_noise_note(data), emulated=emulated),
        is_paired=data.comparison.is_paired,
        timing_warning=timing_warning(data.comparison.plants),
        facts=name_in(_facts(data), emulated=emulated),
        sections=sections,
        missing=missing,
        provenance=[
            name_in(table, emulated=emulated)
            for table in (provenance_table(data), emulator_table(data), settings_table(data))
            if table is not None
        ],
        animation=script_json(animation_of(data)),
        graphs=script_json(graphs),
        plotly=packed_plotly(),
        style=read("report.css"),
        script=read("report.js"),
        diagram=read("block_diagram.svg"),
    )


def _facts(data: ReportData) -> list[tuple[str, str]]:
    comparison = data.comparison
    pair = comparison.pairs[0]
    plants = comparison.plants
    facts = [
        ("runs", str(len(comparison.pairs))),
        ("std of θ, simulation", quantity(plants["sim"]["std_theta"], "rad")),
        ("std of θ, hardware", quantity(plants["hw"]["std_theta"], "rad")),
    ]
    if comparison.is_paired:
        facts.append(("paths apart (rms)", quantity(float(pair.as_dict()["rms_position"]), "rad")))
    delay = 1e3 * comparison.delay
    when = f"{abs(delay):.1f} ms {'later' if delay >= 0.0 else 'earlier'} than the simulation"
    facts.append(("hardware answers", when if math.isfinite(delay) else "with no delay that could be told"))
    facts.append(("seed", str(data.summary.get("seed", "unknown"))))
    return facts


def _without_mark(answer: Answer) -> str:
    """Return the answer's sentence without the mark that stands above it."""
    text = answer.sentence.removeprefix(f"{answer.mark.value.capitalize()}: ")
    return text[0].upper() + text[1:]


def _noise_note(data: ReportData) -> str:
    """Say how long each side held its noise, where that differs: it matters more than the plant."""
    hold = data.comparison.unpaired["noise_hold_time"]
    sim, hw = hold["sim"], hold["hw"]
    if not sim or not hw or abs(sim - hw) < 1e-6:
        return ""
    return (
        f"The simulation by the thesis's own protocol holds each noise sample for {1e3 * sim:.3g} ms, the hardware for "
        f"{1e3 * hw:.3g} ms; noise that is held longer moves the pendulum more, whatever the plant."
    )


def _anchor(text: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in text.lower()).strip("-")
