"""``export``: write a bag as Parquet, CSV or MATLAB files, or several as one dataset for learning (LeRobot)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import out_option
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.lerobot import DEFAULT_TASK, export_lerobot
from pendulum_rosbag.reader.tables import LEROBOT, export_bag, require_pyarrow

__all__ = ["main"]


def export(
    bags: Annotated[
        list[Path], typer.Argument(help="Folder of a bag, or one .mcap or .db3 file; several for lerobot.")
    ],
    output: Annotated[Path, out_option("Folder to create.")],
    topics: Annotated[list[str] | None, typer.Option("-t", "--topic", help="Topic to export; by default all.")] = None,
    format: Annotated[str, typer.Option(help="parquet, csv, mat, or lerobot (dataset v3.0).")] = "parquet",
    fps: Annotated[
        int | None,
        typer.Option(help="lerobot: frames per second [Hz]; by default those of the slowest plant's states."),
    ] = None,
    task: Annotated[str, typer.Option(help="lerobot: what was to be done.")] = DEFAULT_TASK,
) -> int:
    """Write each topic of a bag to a table of its own (SI units, times in nanoseconds), or bags as one dataset.

    Example: python -m pendulum_rosbag export runs/today/sim -o today_sim --format csv; or python -m pendulum_rosbag
    export runs/today/sim runs/today/hw -o dataset --format lerobot
    """
    if format == LEROBOT:
        require_pyarrow(format)
        files = export_lerobot([read_bag(bag, topics) for bag in bags], output, fps=fps, task=task)
    elif len(bags) > 1:
        raise ParameterError(f"{len(bags)} bags for format {format}; expected one (format {LEROBOT} takes several)")
    elif fps is not None:
        raise ParameterError(f"fps is {fps} Hz for format {format}; expected format {LEROBOT}")
    else:
        files = export_bag(
            read_bag(bags[0], topics),
            output,
            format,
            on_left_out=lambda text: print("left out:", text, file=sys.stderr),
        )
    for path in files:
        print(path)
    return 0


main = command_line(export, "python -m pendulum_rosbag export")
