"""A page of sentences, tables and pictures, without interactive plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.figures.table import Table
from pendulum_bags.pages.html import encoded, render_plain
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import DataError

__all__ = ["Sentence", "write_sheet"]


@dataclass(frozen=True)
class Sentence:
    """A sentence at the top of a page, highlighted if ``alarming``."""

    text: str
    alarming: bool = False


def write_sheet(
    path: Path,
    title: str,
    sentences: Sequence[Sentence],
    tables: Sequence[Table],
    pictures: Sequence[Path],
    *,
    kicker: str = "",
    listings: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write a page and return its path; a DataError if it cannot be written.

    The first sentence is above everything, the first PNG picture under it. Tables with rows are between the first
    picture and the others. ``kicker`` is a line above the heading; ``listings`` are heading and text of another
    program's output; ``notes`` are sentences before the pictures.
    """
    text = render_plain(
        "sheet.html.j2",
        title=title,
        kicker=kicker,
        sentences=sentences,
        tables=[table for table in tables if table.rows],
        listings=listings,
        notes=notes,
        pictures=[(one.stem.replace("_", " "), encoded(one.read_bytes())) for one in pictures],
    )
    with writing(f"page {path}", DataError):
        write_atomically(path, text)
    return path
