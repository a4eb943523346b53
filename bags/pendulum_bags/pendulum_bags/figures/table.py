"""A table of a page: heading, sentence, cells as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Table"]

_NUMERIC = re.compile(r"^[−–±]?[\d.]*(×10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?$")


@dataclass(frozen=True)
class Table:
    """A table.

    Args:
        title: Heading.
        sentence: What it shows.
        head: Column headings; the first column holds row names.
        rows: Cells as text.
        section: Heading of the section it belongs to.
    """

    title: str
    sentence: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    section: str

    @property
    def numeric(self) -> list[bool]:
        """Return for each column whether it holds numbers only, which then align to the right."""
        return [all(_NUMERIC.match(row[i]) for row in self.rows) for i in range(len(self.head))]
