"""A table of a page: heading, sentence, cells as text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Table"]

_NUMERIC = re.compile(r"^[-+−–±]?[\d.]*(×10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?$")


@dataclass(frozen=True)
class Table:
    """A table of texts, whose first column holds row names; ``folded`` on a page for its length."""

    title: str
    sentence: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    section: str = ""
    folded: bool = False

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds numbers only, which then align to the right."""
        return [all(_NUMERIC.match(row[i]) for row in self.rows) for i in range(len(self.head))]

    @property
    def is_wide(self) -> bool:
        """Whether a row is too wide for a phone, which then stacks its cells."""
        return len(self.head) > 4 or (len(self.head) == 4 and not all(self.numeric[1:]))
