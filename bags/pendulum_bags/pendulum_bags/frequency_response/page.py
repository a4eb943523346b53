"""The page of a measured frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.table import Table
from pendulum_bags.frequency_response.designs import design_rows
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.report.layer_page import write_layer_page

__all__ = ["ASSUMPTIONS", "write_page"]

_THEOREM = (
    "The certificate is Vinnicombe's theorem with the upper 95 % limit of the measurement. It speaks of the linear "
    "machine around upright, with as many unstable poles as the model, sampled at the machine's rate under zero-order "
    "hold, so half a period of hold and all delays are in it. It is one-sided: what is not certified may still be "
    "stable."
)
_LIMITS = (
    "It does not speak of torque that saturates, of dry friction at rest (a stuck joint does not move as a line says), "
    "or of motions far from upright. Between measured frequencies the plant is interpolated, below the lowest its "
    "stiffness, damping and inertia are continued (of several joints, its ratio to the model), and the error of both "
    "widens the discs. What begins only below the lowest frequency was not seen."
)
ASSUMPTIONS = (_THEOREM, _LIMITS)
"""What the certificate rests on, and where it ends."""


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
                design_rows(analysis.designs),
                "",
            )
        )
    return write_layer_page(path, "Frequency response", analysis.layers, figures, tables, ASSUMPTIONS)
