"""The report as one self-contained HTML file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.pages.html import render, script_json
from pendulum_bags.report.animation import animation_of
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.provenance import emulator_table, provenance_table, seed_of, settings_table
from pendulum_bags.runs.run_data import surrogate_of, timing_warning
from pendulum_bags.verdict import Answer
from pendulum_bags.verdict.naming import name_in
from pendulum_bags.verdict.terminal import SIGNS

__all__ = ["Page", "facts_of_tests", "page_of", "render_page"]

SECTIONS = (
    "Verdict",
    "Frequency response",
    "Same choice",
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


OF_ONE_RUN = ("Paired comparison", "Plants under noise", "The thesis's analysis", "Dynamic phase", "Timing")
"""Sections that show the first run only, where there are several, with a note."""
FOLDED = (
    "Repeated runs", "The thesis's analysis", "Dynamic phase", "Timing", "Experiment 1: inertia and damping",
    "Experiment 2: gravity", "Model", "A real pendulum",
)  # fmt: skip
"""Sections that are closed when the page opens."""
_LEADS = ("both_together", "joints_together")
"""Figures whose first panel is also next to the answer."""
_MOST_SEEDS = 3
"""Seeds at the head of a page; the table of provenance has them all."""


@dataclass(frozen=True)
class Page:
    """The contents of a report.

    Attributes:
        emulated: Whether the hardware was emulated; all texts then name it so.
        provenance: Tables of data sources.
        surrogate: The surrogate of the hardware, if none was measured.
        animation: Output of :func:`pendulum_bags.report.animation.animation_of`; None for no animation.
        runs: Number of runs; sections that show the first of several have a note.
    """

    title: str
    answer: Answer
    hardware: str
    emulated: bool
    is_paired: bool
    facts: Sequence[tuple[str, str]]
    figures: Sequence[Figure]
    tables: Sequence[Table]
    provenance: Sequence[Table]
    surrogate: str
    animation: Mapping[str, Any] | None = None
    notes: Sequence[str] = ()
    missing: Sequence[tuple[str, str]] = ()
    runs: int = 1
    unpaired: str = ""
    noise_note: str = ""
    others: Sequence[tuple[str, Answer]] = ()


def page_of(
    data: ReportData,
    figures: Sequence[Figure],
    tables: Sequence[Table],
    missing: Sequence[tuple[str, str]],
    *,
    title: str,
) -> Page:
    """Return the page of plants of one joint."""
    comparison = data.comparison
    warning = timing_warning(comparison.plants)
    return Page(
        title=title,
        answer=data.answer,
        hardware=comparison.hardware_name,
        emulated=comparison.is_emulated,
        is_paired=comparison.is_paired,
        facts=_facts(data),
        figures=figures,
        tables=tables,
        provenance=[
            table for table in (provenance_table(data), emulator_table(data), settings_table(data)) if table is not None
        ],
        animation=animation_of(data),
        notes=[*([warning] if warning else []), *comparison.notes],
        missing=missing,
        runs=len(comparison.pairs),
        unpaired=comparison.unpaired_verdict.sentence,
        noise_note=_noise_note(data),
        surrogate=surrogate_of(comparison.pairs[0].hardware),
    )


def render_page(page: Page, pictures: Mapping[str, bytes]) -> str:
    """Return the HTML text of a report; the pictures are its figures as PNG, by name."""
    figures, tables, facts, noise_note, provenance = name_in(
        (page.figures, page.tables, page.facts, page.noise_note, page.provenance), emulated=page.emulated
    )
    lead = next((_lead(figure) for figure in figures if figure.name in _LEADS), None)
    sections = []
    named = [figure.section for figure in figures] + [table.section for table in tables]
    for heading in dict.fromkeys((*SECTIONS, *named)):
        shown, listed = ([one for one in ones if one.section == heading] for ones in (figures, tables))
        if shown or listed:
            sections.append({"title": heading, "anchor": _anchor(heading), "figures": shown, "tables": listed})
    return render(
        "report.html.j2",
        [*figures, *([lead] if lead else [])],
        pictures,
        lead=lead,
        folded=FOLDED,
        page=page,
        sentence=_without_mark(page.answer),
        signs=SIGNS,
        noise_note=noise_note,
        of_one_run=OF_ONE_RUN,
        facts=facts,
        sections=sections,
        provenance=provenance,
        animation=script_json(page.animation),
    )


def _lead(figure: Figure) -> Figure:
    return replace(figure, name="lead", title="The motion under one noise", sentence="", panels=figure.panels[:1])


def facts_of_tests(comparison: Comparison, of: str = "") -> list[tuple[str, str]]:
    """Return the tested quantities but distances, each with its margin, as the tests have them."""
    found = []
    for test in comparison.verdict.tests:
        if test.quantity.startswith("distance"):
            continue
        unit = "" if test.unit == "-" else f" {test.unit}"
        value = test.interval.estimate
        value_text = f"{quantity(value)}{unit}" if math.isfinite(value) else "–"
        found.append((f"{test.quantity}{of}", f"{value_text} ({test.margin_text().removeprefix('margin ')}{unit})"))
    return found


def _facts(data: ReportData) -> list[tuple[str, str]]:
    comparison = data.comparison
    facts = [("runs", str(len(comparison.pairs))), *facts_of_tests(comparison)]
    seeds = [seed_of(pair.hardware) for pair in comparison.pairs]
    if comparison.of_files:
        return facts
    if len(seeds) == 1:
        facts.append(("seed", str(data.summary.get("seed", "unknown"))))
    else:
        facts.append(("seeds", ", ".join(seeds[:_MOST_SEEDS]) + (", …" if len(seeds) > _MOST_SEEDS else "")))
    return facts


def _without_mark(answer: Answer) -> str:
    text = answer.sentence.removeprefix(f"{answer.mark.value.capitalize()}: ")
    return text[0].upper() + text[1:]


def _noise_note(data: ReportData) -> str:
    """Return how long each side held its noise, if different: that matters more than the plant."""
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
