"""Tables whose figures are never cut, on a terminal of any width and in a file.

Rich shortens cells to an ellipsis (``11.7…``) and treats a pipe as a terminal of 80 columns, so every program prints
through :func:`make_console` and :class:`WholeTable`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Column, Table

__all__ = ["WholeTable", "make_console"]

_NO_BOUND = 10_000
"""Width of a file or pipe [columns]."""


def make_console(*, stderr: bool = False, highlight: bool = True) -> Console:
    """Return a console of the terminal's width, or unbounded if the output is no terminal; ``COLUMNS`` overrides it."""
    console = Console(stderr=stderr, highlight=highlight)
    if not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
        console.width = _NO_BOUND
    return console


class WholeTable(Table):
    """A table that breaks cells at spaces only, and continues below with its first column if it is too wide.

    A single word that is wider than the console is folded.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if not self.columns:
            return
        sizes = [_measure(column, console, options) for column in self.columns]
        # A column needs padding of one on each side and a border; the table one more border.
        room = options.max_width - 1
        for number, block in enumerate(_blocks([size.minimum + 3 for size in sizes], room)):
            widths = _widths([sizes[index] for index in block], room - 3 * len(block))
            yield self._part(block, widths, with_title=number == 0)

    def _part(self, block: Sequence[int], widths: Sequence[int], *, with_title: bool) -> Table:
        part = Table(
            title=self.title if with_title else None,
            box=self.box,
            title_justify=self.title_justify,
            title_style=self.title_style,
            header_style=self.header_style,
        )
        cells = []
        for index, width in zip(block, widths, strict=True):
            column = self.columns[index]
            part.add_column(column.header, justify=column.justify, style=column.style, width=width, overflow="fold")
            cells.append(list(column.cells))
        for row, content in zip(self.rows, zip(*cells, strict=True), strict=True):
            part.add_row(*content, style=row.style, end_section=row.end_section)
        return part


def _measure(column: Column, console: Console, options: ConsoleOptions) -> Measurement:
    free = options.update(max_width=_NO_BOUND)
    found = [Measurement.get(console, free, cell) for cell in (column.header, *column.cells)]
    longest = max(size.maximum for size in found)
    return Measurement(longest if column.no_wrap else max(size.minimum for size in found), longest)


def _blocks(least: Sequence[int], room: int) -> list[list[int]]:
    """Return which columns stand side by side: the first, and as many others as fit."""
    blocks = [[0]]
    for index in range(1, len(least)):
        if len(blocks[-1]) > 1 and sum(least[other] for other in blocks[-1]) + least[index] > room:
            blocks.append([0])
        blocks[-1].append(index)
    return blocks


def _widths(sizes: Sequence[Measurement], room: int) -> list[int]:
    """Return widths between longest word and longest line, the narrowest growing first.

    If not even the longest words fit, the widest columns shrink.
    """
    widths = [size.minimum for size in sizes]
    while sum(widths) > room and max(widths) > 1:
        widths[widths.index(max(widths))] -= 1
    while sum(widths) < room:
        wanting = [index for index, size in enumerate(sizes) if widths[index] < size.maximum]
        if not wanting:
            break
        widths[min(wanting, key=lambda index: widths[index])] += 1
    return widths
