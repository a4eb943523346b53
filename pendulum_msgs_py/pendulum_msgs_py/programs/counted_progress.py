"""Progress of work that is counted in pieces, in the terminal."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED

__all__ = ["counted_progress", "counting_bar", "results_at_once", "resumable"]

_Result = TypeVar("_Result")


def counting_bar(console: Console, *columns: ProgressColumn) -> Progress:
    """Return a bar that counts pieces and leaves nothing behind; in a file or a pipe it draws nothing.

    Args:
        console: Where to draw.
        columns: Columns at its right end.
    """
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def results_at_once(
    console: Console, unit: str, jobs: Sequence[Callable[[], _Result]], workers: int = 0
) -> list[_Result]:
    """Return what each job returns, run in processes of their own, with a progress bar.

    Args:
        console: Where to draw.
        unit: What is counted, as a plural.
        jobs: What to run; each can be pickled.
        workers: Jobs at once; 0 for one a core.

    Raises:
        typer.Exit: The user interrupted; nothing of the results is left.
    """
    pool = ProcessPoolExecutor(min(len(jobs), workers or os.cpu_count() or 1))
    results = []
    try:
        with counting_bar(console) as bar:
            task = bar.add_task(unit, total=len(jobs))
            for result in pool.map(_call, jobs):
                results.append(result)
                bar.advance(task)
    except KeyboardInterrupt:
        pool.shutdown(wait=False, cancel_futures=True)
        console.print("interrupted: nothing was written")
        raise typer.Exit(EXIT_INTERRUPTED) from None
    pool.shutdown()
    return results


def _call(job: Callable[[], _Result]) -> _Result:
    return job()


@contextmanager
def resumable(console: Console, folder: Path) -> Iterator[None]:
    """Turn Ctrl-C into a sentence on how to resume the work in a folder.

    Raises:
        typer.Exit: The user interrupted, after the sentence.
    """
    try:
        yield
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command with --out {folder} goes on where it stopped", soft_wrap=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextmanager
def counted_progress(console: Console, unit: str, total: int, folder: Path) -> Iterator[Callable[[int, int], None]]:
    """Show a bar with the remaining time during resumable work.

    Args:
        console: Where to draw.
        unit: What is counted, as a plural.
        total: How many there are.
        folder: Where the work stores its results.

    Yields:
        What the work calls with pieces done and in all.

    Raises:
        typer.Exit: The user interrupted.
    """
    with resumable(console, folder), counting_bar(console, TimeRemainingColumn()) as bar:
        task = bar.add_task(unit, total=total)
        yield lambda done, of: bar.update(task, completed=done, total=of)
