"""A page of sentences, tables and pictures, for what needs no plots to zoom into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.figures.table import Table
from pendulum_bags.pages.html import encoded, render_plain
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.whole_file import write_whole, writing

__all__ = ["Sentence", "write_sheet"]


@dataclass(frozen=True)
class Sentence:
    """A sentence at the top of a page.

    Attributes:
        text: Its text.
        alarming: Whether it is highlighted.
    """

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
    """Write the page and return its path.

    Args:
        path: File.
        title: Heading.
        sentences: Its sentences; the first one stands above everything.
        tables: Those with rows are shown, between the first picture and the others.
        pictures: PNG files; the first one stands under the first sentence.
        kicker: Line above the heading.
        listings: Heading and text of what another program printed.
        notes: Sentences before the pictures.

    Raises:
        DataError: The file cannot be written.
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
        write_whole(path, text)
    return path
