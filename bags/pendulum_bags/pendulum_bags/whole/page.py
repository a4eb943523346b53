"""The page of a whole answer: that of the given plant, and the tests, responses and rankings of the identified one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from pendulum_bags.experiments.deadline import slowness
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.table import Table
from pendulum_bags.frequency_response.figures import bode
from pendulum_bags.frequency_response.write import designs_tables
from pendulum_bags.pages.layer_page import evidence_table
from pendulum_bags.ranking.joint_choice import COST
from pendulum_bags.ranking.present import Words, ranking_figure, ranking_tables
from pendulum_bags.report.analysis_figures import equivalence
from pendulum_bags.report.joint_page import of_joint
from pendulum_bags.report.page import Page
from pendulum_bags.report.tables import tests_table
from pendulum_bags.report.write import write_joint_report, write_report
from pendulum_bags.verdict import Answer, Layer, Mark
from pendulum_bags.whole.carry_out import Findings, Simulated

__all__ = ["leave_files_out", "write_whole_report"]

_ERRORS = (
    "A yes needs all tests that were measured: it errs no more often than the one that should have said no, at most in "
    "5 % of experiments on a margin. A no needs one test, so their errors add up: 5 % of the first, 2.5 % of the "
    "second and of the fourth, and the stable designs that the third does not certify."
)
_FILES = 20.0
"""Processor time to write the page and the files of its figures [s]."""


def write_whole_report(
    folder: Path, summary: Mapping[str, Any], found: Findings, answer: Answer, answers: Sequence[Answer]
) -> Path:
    """Write ``report.html`` and ``figures/`` of a run; return the page."""
    given = found.given

    def extend(page: Page) -> Page:
        figures, tables = list(page.figures), list(page.tables)
        for plant, own in zip(found.plants, answers, strict=True):
            _add(figures, tables, plant, own, given=plant is given)
        others = [(plant.name, own) for plant, own in zip(found.plants[1:], answers[1:], strict=True)]
        errors = [_ERRORS] if given.layers else []
        return replace(page, figures=figures, tables=tables, others=others, notes=[*page.notes, *errors, *found.notes])

    # Files for print take three times as long as the page: omitted after an early end.
    formats = () if found.interrupted or found.spent else ("png", "pdf")
    if "" not in given.comparisons:
        return write_joint_report(
            folder, given.comparisons, folders=[folder], formats=formats, answer=answer, extend=extend
        )
    return write_report(
        folder,
        summary,
        comparison=given.comparison,
        answer=answer,
        certified=given.analysis,
        extend=extend,
        formats=formats,
    )


def leave_files_out(found: Findings) -> None:
    """Mark a budget as spent, with a note, where it has no time left for the files of the figures."""
    if not (found.interrupted or found.spent) and found.deadline.total_left < _FILES * slowness():
        found.spent = True
        found.notes.append("The budget has no time left for files of the figures: report.html alone shows them.")


def _add(figures: list[Figure], tables: list[Table], plant: Simulated, answer: Answer, *, given: bool) -> None:
    section = "" if given else f"With {plant.name}"
    mine: list[Figure] = []
    listed: list[Table] = []
    if not given:
        for joint, one in plant.comparisons.items():
            mine.append(of_joint(joint, equivalence(one.verdict)))
            listed.append(of_joint(joint, tests_table(one)))
        listed += [
            evidence_table(one)
            for one in answer.layers
            if one.layer is not Layer.SAME_RUN and one.mark is not Mark.NOT_MEASURED
        ]
    if plant.analysis is not None:
        with threadpool_limits(1):
            mine.append(bode(plant.analysis))
        listed += designs_tables(plant.analysis)
    if plant.ranking is not None:
        mine.append(replace(ranking_figure(plant.ranking), section="Same choice"))
        words = Words() if "" in plant.comparisons else Words(cost=COST)
        listed += [replace(one, section="Same choice") for one in ranking_tables(plant.ranking, words)]
    for figure in mine:
        named = (
            figure
            if given
            else replace(figure, name=f"{figure.name}_identified", title=f"{figure.title}, {plant.name}")
        )
        figures.append(replace(named, section=section or figure.section))
    tables += [
        replace(one, title=one.title if given else f"{one.title}, {plant.name}", section=section or one.section)
        for one in listed
    ]
