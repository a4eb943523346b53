"""The page of a measured frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pendulum_bags.figures.figure import Figure
from pendulum_bags.report.layer_page import write_layer_page
from pendulum_bags.report.tables import Table

if TYPE_CHECKING:
    from pendulum_bags.frequency_response.analyse import Analysis

__all__ = ["ASSUMPTIONS", "design_rows", "write_page"]

_THEOREM = (
    "The certificate is Vinnicombe's theorem with the upper 95 % limit of the measurement. It speaks of the linear "
    "machine around upright, with one unstable pole, sampled at the machine's rate under zero-order hold, so half a "
    "period of hold and all delays are in it. It is one-sided: what is not certified may still be stable."
)
_LIMITS = (
    "It does not speak of torque that saturates, of dry friction at rest (a stuck joint does not move as a line says), "
    "or of motions far from upright. Between measured frequencies the plant is interpolated, below the lowest its "
    "stiffness, damping and inertia are continued, and the error of both widens the discs."
)
ASSUMPTIONS = (_THEOREM, _LIMITS)
"""What the certificate rests on, and where it ends."""


def design_rows(analysis: Analysis) -> list[tuple[str, ...]]:
    """Return the table of designs as text: row, design, margin, loop distance, modulus on the hardware, certified."""
    rows: list[tuple[str, ...]] = []
    for number, design in enumerate(analysis.designs, 1):
        found = design.certificate
        how = "by its margin" if found.by_gap else "by frequency" if found.by_frequency else "no"
        if found.undecided:
            how = "undecided: measure longer"
        rows.append(
            (
                str(number),
                design.name,
                f"{found.margin:.3f}",
                f"{found.distance:.2f} at {found.at:.2g} Hz" if found.stable_on_model else "unstable on the model",
                f"{found.worst_modulus:.2f}",
                f"yes, {how}" if found.certified else how,
            )
        )
    return rows


def write_page(path: Path, analysis: Analysis, figures: Sequence[Figure]) -> Path:
    """Write the page and return its path."""
    tables = []
    if analysis.designs:
        tables.append(
            Table(
                "Which designs carry over",
                f"Designed on plant {analysis.plant}. Certified: margin above the gap's upper limit, "
                "or loop distance below "
                "1 at every frequency.",
                ("row", "design", "margin b(P, K)", "loop distance", "modulus margin on the hardware", "certified"),
                design_rows(analysis),
                "",
            )
        )
    return write_layer_page(path, "Frequency response", analysis.layers, figures, tables, ASSUMPTIONS)
