"""Tables of numbers for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Column

from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = ["number_table", "plants_table"]


def number_table(title: str, *headings: str | Column, left: int = 1) -> WholeTable:
    """Return a table without rows; after the first columns, which hold names, all columns align to the right.

    Args:
        title: Above the table.
        headings: Of the columns; a column that is given as one stays as it is.
        left: How many columns hold names.
    """
    columns = (
        Column(heading, justify="right") if isinstance(heading, str) and i >= left else heading
        for i, heading in enumerate(headings)
    )
    return WholeTable(*columns, title=title, title_justify="left")


def plants_table(
    title: str, headings: Sequence[str], plants: Sequence[Mapping[str, Any]], rows: Sequence[tuple[str, str, str]]
) -> WholeTable:
    """Return a table with a column for each plant.

    Args:
        title: Above the table.
        headings: Of the plants.
        plants: Their figures, by key.
        rows: Label, key and format of each row.
    """
    table = number_table(title, "", *headings)
    for label, key, form in rows:
        values = (plant.get(key) for plant in plants)
        table.add_row(label, *("–" if value is None else format(value, form) for value in values))
    return table
