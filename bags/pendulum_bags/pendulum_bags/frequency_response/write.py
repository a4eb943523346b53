"""Write the analysis of measured responses: numbers, layers of the verdict, figures and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.table import Table
from pendulum_bags.frequency_response.analyse import NUMBERS
from pendulum_bags.frequency_response.designs import design_rows
from pendulum_bags.frequency_response.figures import response_figures
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.pages.layer_page import write_layer_page
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.verdict import name_in, write_layer
from pendulum_lqr.responses.measured_response import write_response

__all__ = ["designs_tables", "write_analysis", "write_numbers"]

_THEOREM = (
    "The certificate is Vinnicombe's theorem with the upper 95 % limit of the measurement. It speaks of the linear "
    "machine around upright, with as many unstable poles as the model, sampled at the machine's rate under zero-order "
    "hold, so half a period of hold and all delays are in it. It is one-sided: what is not certified may still be "
    "stable."
)
_LIMITS = (
    "It does not cover torque that saturates, dry friction at rest (a stuck joint does not move as a line says), "
    "or motions far from upright. Between measured frequencies the plant is interpolated, below the lowest its "
    "stiffness, damping and inertia are continued (of several joints, its ratio to the model), and the error of both "
    "widens the discs. What begins only below the lowest frequency was not seen."
)


def write_numbers(folder: Path, analysis: Analysis) -> None:
    """Write responses, layers and numbers into a folder, from which designs can be certified later."""
    folder.mkdir(parents=True, exist_ok=True)
    for response in analysis.responses:
        write_response(folder / f"{response.label}_response.json", response)
    for layer in analysis.layers:
        write_layer(folder, layer)
    write_json(folder / NUMBERS, analysis.to_json())


def designs_tables(analysis: Analysis) -> list[Table]:
    """Return the table of certified designs, or nothing."""
    if not analysis.designs:
        return []
    return [
        Table(
            "Which designs carry over",
            f"Designed on plant {analysis.plant}. Certified: margin above the gap's upper limit, "
            "or loop distance below 1 at every frequency.",
            ("row", "design", "margin b(P, K)", "loop distance", "modulus margin on the hardware", "certified"),
            design_rows(analysis.designs),
        )
    ]


def write_analysis(
    folder: Path,
    analysis: Analysis,
    formats: Sequence[str] = ("png", "pdf"),
) -> Path:
    """Write responses, layers, numbers, figures and a page; return the page."""
    write_numbers(folder, analysis)
    # Thousands of small matrices: BLAS threads only slow them down.
    with threadpool_limits(1):
        figures = name_in(response_figures(analysis), emulated=analysis.is_emulated)
    write_figures(figures, folder / "figures", formats)
    tables = designs_tables(analysis)
    page = folder / "frequency_response.html"
    return write_layer_page(
        page, "Frequency response", analysis.layers, figures, tables, (_THEOREM, _LIMITS), emulated=analysis.is_emulated
    )
