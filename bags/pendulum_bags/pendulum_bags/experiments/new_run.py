"""The folder of a run while it is recorded: an empty one is removed, and Ctrl-C reports its contents."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console

from pendulum_bags.runs.run_folder import create_run_folder, discard_if_empty
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED

__all__ = ["new_run"]


@contextmanager
def new_run(
    out: Path | None,
    experiment: str,
    console: Console,
    *,
    ended: str = "all programs have ended",
    recorded: str = "what was recorded",
) -> Iterator[Path]:
    """Create the folder of a run, as :func:`create_run_folder` does, and remove it if nothing is recorded into it.

    An interruption by the user prints the texts ``ended`` (what has ended by then) and ``recorded`` (what the folder
    holds), and raises typer.Exit. A BagError if the folder is not empty or cannot be written.
    """
    folder = create_run_folder(out, experiment)
    try:
        yield folder
    except KeyboardInterrupt:
        outcome = "nothing was recorded" if discard_if_empty(folder) else f"{recorded} is in {folder}"
        console.print(f"interrupted: {ended}; {outcome}")
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except PendulumError:
        discard_if_empty(folder)
        raise
