"""The report of plants of several joints: one answer, and the figures and tests of each joint in its own unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.report.analysis_figures import equivalence, timing
from pendulum_bags.report.animation import joint_animation
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.joint_figures import joint_differences, joint_spectra, joints_together
from pendulum_bags.report.page import Page, facts_of_tests
from pendulum_bags.report.provenance import provenance_table, seed_of, settings_table
from pendulum_bags.report.tables import tests_table
from pendulum_bags.runs.run_data import surrogate_of, timing_warning
from pendulum_bags.verdict import Answer

__all__ = ["joint_page", "of_joint"]

_Shown = TypeVar("_Shown", Figure, Table)


def joint_page(comparisons: Mapping[str, Comparison], answer: Answer, *, title: str) -> Page:
    """Return the page of the comparisons of at least one joint, by name."""
    first = next(iter(comparisons.values()))
    data = ReportData(first, {"seed": seed_of(first.pairs[0].simulation)}, answer=answer)
    differences = joint_differences(comparisons)
    figures = [
        *(of_joint(joint, equivalence(comparison.verdict)) for joint, comparison in comparisons.items()),
        joints_together(comparisons),
        *([] if isinstance(differences, str) else [differences]),
        joint_spectra(comparisons),
        timing(data),
    ]
    warning = timing_warning(first.plants)
    return Page(
        title=title,
        answer=answer,
        hardware=first.hardware_name,
        emulated=first.is_emulated,
        is_paired=all(comparison.is_paired for comparison in comparisons.values()),
        facts=_facts(comparisons),
        figures=figures,
        tables=[
            _motions(comparisons),
            *(of_joint(joint, tests_table(one)) for joint, one in comparisons.items()),
        ],
        provenance=[table for table in (provenance_table(data), settings_table(data)) if table is not None],
        animation=joint_animation(comparisons, str(data.run.get("design_plant", ""))),
        notes=[*([warning] if warning else []), *dict.fromkeys(n for c in comparisons.values() for n in c.left_out)],
        runs=len(first.pairs),
        surrogate=surrogate_of(first.pairs[0].hardware),
        missing=[("Difference under the same noise", differences)] if isinstance(differences, str) else [],
    )


def of_joint(joint: str, shown: _Shown) -> _Shown:
    """Return a figure or a table with the name of its joint; as it is where that has none."""
    if not joint:
        return shown
    title = f"{shown.title}: {joint}"
    if isinstance(shown, Table):
        return replace(shown, title=title)
    return replace(shown, title=title, name=f"{shown.name}_{joint}")


def _facts(comparisons: Mapping[str, Comparison]) -> list[tuple[str, str]]:
    first = next(iter(comparisons.values()))
    facts = [("runs", str(len(first.pairs))), ("seed", seed_of(first.pairs[0].simulation))]
    for joint, comparison in comparisons.items():
        facts += facts_of_tests(comparison, f", {joint}")
    return facts


def _motions(comparisons: Mapping[str, Comparison]) -> Table:
    rows: list[tuple[str, ...]] = []
    for joint, comparison in comparisons.items():
        pair = comparison.pairs[0]
        both = (pair.simulation.window, pair.hardware.window)
        unit = both[0].unit
        rows.append((f"std of {joint} [{unit}]", *(quantity(float(one.position.std(ddof=1))) for one in both)))
        rows.append((f"std of its velocity [{unit}/s]", *(quantity(float(one.velocity.std(ddof=1))) for one in both)))
        if any(np.ptp(one.effort) > 0.0 for one in both):
            largest = (quantity(float(np.abs(one.effort).max())) for one in both)
            rows.append((f"largest |u| at {joint} [{both[0].effort_unit}]", *largest))
    first = next(iter(comparisons.values()))
    for label, key, digits in (("sampling rate [Hz]", "rate_hz", 4), ("missed deadlines", "missed_deadlines", 6)):
        rows.append((label, *(quantity(float(first.plants[side][key]), "", digits) for side in ("sim", "hw"))))
    of = "" if len(first.pairs) == 1 else f" of the first of {len(first.pairs)} runs"
    sentence = f"Spreads are of all samples{of}; the tests take both motions {first.seen}, so their ratios may differ."
    return Table("Joints under noise", sentence, ("", "simulation", "hardware"), rows, "Verdict")
