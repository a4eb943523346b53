"""Options of every command that reads recordings: how they are mapped, and which part of them counts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_msgs_py.errors import DataError

if TYPE_CHECKING:
    from rich.console import Console

    from pendulum_bags.recordings.reading import Reading

__all__ = ["Dt", "Mappings", "Start", "Stop", "Topics", "WriteMapping", "readings_of", "show_guesses"]

Mappings = Annotated[
    list[str] | None,
    typer.Option(
        "--mapping",
        help="Mapping file, or pendulum, voltage_40hz, servo_log, free_swing, guess; once for all recordings, or once "
        "for each. By default columns are guessed from names and tested by the data.",
    ),
]
WriteMapping = Annotated[
    Path | None, typer.Option("--write-mapping", help="Write what was guessed as a file for --mapping.")
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        help="ROLE=TOPIC or ROLE=COLUMN, such as joint_states=/robot/state, input=/cmd/data.0, time=stamp; several "
        "times if wanted.",
    ),
]
Dt = Annotated[float | None, typer.Option("--dt", help="Time between two rows of files without a time column [s].")]
Start = Annotated[float | None, typer.Option(help="Leave out what comes before, from the recording's beginning [s].")]
Stop = Annotated[float | None, typer.Option(help="Leave out what comes after [s].")]


def readings_of(
    paths: Sequence[Path],
    mappings: Sequence[str | None] | None = None,
    topics: Sequence[str] | None = None,
    dt: float | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> list[Reading]:
    """Return recordings with the user's options; a DataError for one out of domain, or not one mapping for each."""
    from pendulum_bags.recordings.reading import Reading

    given = list(mappings or [])
    if len(given) not in {0, 1, len(paths)}:
        raise DataError(
            f"--mapping is given {len(given)} times for {len(paths)} recordings; expected once for all, or for each"
        )
    if dt is not None and not 0.0 < dt < 1.0:
        raise DataError(f"--dt is {dt:g} s; expected > 0 and < 1 s")
    if start is not None and stop is not None and not stop > start:
        raise DataError(f"--stop is {stop:g} s; expected more than --start, {start:g} s")
    each: list[str | None] = [*given] * len(paths) if len(given) == 1 else [*given] or [None] * len(paths)
    alone = len(paths) == 1 and paths[0] != Path()  # which is the template of several
    return [
        Reading(path, mapping, tuple(topics or ()), dt, start, stop, alone)
        for path, mapping in zip(paths, each, strict=True)
    ]


def show_guesses(console: Console, readings: Sequence[Reading], write_to: Path | None) -> None:
    """Print what was guessed, and write it if requested; a DataError if there is nothing to write."""
    from pendulum_bags.recordings.reading import print_guesses, write_mapping

    files = [reading for reading in readings if reading.was_mapped]
    print_guesses(console, files)
    if write_to is not None and (files or sys.exc_info()[0] is None):
        if not files:
            raise DataError("--write-mapping has nothing to write: the recordings are bags that need no mapping")
        write_mapping(write_to, files)
        console.print(f"mapping {write_to}", highlight=False, soft_wrap=True)
