"""Tables of numbers for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Column

from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = ["number_table", "plants_table"]


def number_table(title: str, *headings: str | Column, left: int = 1) -> WholeTable:
    """Return a table without rows; after the first ``left`` columns, which hold names, columns align right."""
    columns = (
        Column(heading, justify="right") if isinstance(heading, str) and i >= left else heading
        for i, heading in enumerate(headings)
    )
    return WholeTable(*columns, title=title, title_justify="left")


def plants_table(
    title: str, headings: Sequence[str], plants: Sequence[Mapping[str, Any]], rows: Sequence[tuple[str, str, str]]
) -> WholeTable:
    """Return a table with a column per plant and rows of (label, key into ``plants``, format)."""
    table = number_table(title, "", *headings)
    for label, key, form in rows:
        values = (plant.get(key) for plant in plants)
        table.add_row(label, *("–" if value is None else format(value, form) for value in values))
    return table
