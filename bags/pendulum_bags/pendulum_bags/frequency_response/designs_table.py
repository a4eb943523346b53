"""Designs and their certificates on the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from pendulum_bags.frequency_response.designs import DesignResult, design_rows
from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = ["designs_table"]


def designs_table(designs: Sequence[DesignResult]) -> WholeTable:
    """Return a table with a row for each design: margin, loop distance, modulus on the hardware, certified or not."""
    table = WholeTable(title="\nDesigns", title_justify="left")
    for heading in ("row", "design", "margin b", "loop distance", "modulus on hw", "certified"):
        table.add_column(heading)
    for row in design_rows(designs):
        table.add_row(*row)
    return table
