"""Progress bars of work that is counted in pieces."""

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
    """Return a bar with further columns at its end, removed when done; in a file or a pipe it draws nothing."""
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
    """Return the results of picklable jobs, run in ``workers`` processes (0: one per core), with a progress bar.

    Raises:
        typer.Exit: The user interrupted; no results are left.
    """
    pool = ProcessPoolExecutor(max(1, min(len(jobs), workers or os.cpu_count() or 1)))
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
    except BaseException:
        # A pool that is left to the end of the program writes a traceback of its own now and then.
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()
    return results


def _call(job: Callable[[], _Result]) -> _Result:
    return job()


@contextmanager
def resumable(console: Console, folder: Path) -> Iterator[None]:
    """Turn Ctrl-C into ``typer.Exit``, after a sentence on how to resume the work in a folder."""
    try:
        yield
    except KeyboardInterrupt:
        console.print(f"interrupted: the same command with --out {folder} goes on where it stopped", soft_wrap=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


@contextmanager
def counted_progress(console: Console, unit: str, total: int, folder: Path) -> Iterator[Callable[[int, int], None]]:
    """Show a bar with the remaining time during :func:`resumable` work on ``total`` pieces; ``unit`` is a plural.

    Yields:
        A function of the pieces done and in all.
    """
    with resumable(console, folder), counting_bar(console, TimeRemainingColumn()) as bar:
        task = bar.add_task(unit, total=total)
        yield lambda done, of: bar.update(task, completed=done, total=of)
